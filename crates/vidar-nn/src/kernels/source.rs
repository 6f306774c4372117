//! Rows of A: the rows of a matrix, or the pixels of a map as a convolution sees them.

use std::ops::Range;

use super::scratch::{self, Scratch};
use super::tile::{Multiply, steps_of};

/// The inner dimension: `taps` runs of `group` consecutive numbers.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Inner {
    pub(crate) taps: usize,
    pub(crate) group: usize,
}

impl Inner {
    /// Words of a column: every tap starts with a new one.
    pub(crate) fn words<M: Multiply>(self) -> usize {
        self.taps * steps_of::<M>(self.group)
    }
}

/// How rows of A lie in a prepared buffer. Row m starts at `at(m)`, relative to row 0's start.
pub(crate) struct Geometry {
    pub(crate) inner: Inner,
    /// Offset of each tap from its row's start.
    pub(crate) taps: Vec<usize>,
    /// Rows come in lines; within a line they lie `row_stride` apart, lines lie `line_stride` apart.
    pub(crate) line: usize,
    pub(crate) row_stride: usize,
    pub(crate) line_stride: usize,
}

impl Geometry {
    #[inline(always)]
    pub(crate) fn at(&self, row: usize) -> usize {
        row / self.line * self.line_stride + row % self.line * self.row_stride
    }
}

/// Where the rows of A come from.
#[derive(Clone, Copy)]
pub(crate) enum Source<'a> {
    /// Rows of a dense matrix.
    Flat { x: &'a [f32], rows: usize, inner: usize },
    /// Pixels of a convolution's output.
    Bands(Bands<'a>),
}

/// A convolution over an NHWC map.
#[derive(Clone, Copy)]
pub(crate) struct Bands<'a> {
    pub(crate) fill: Fill<'a>,
    pub(crate) rows: usize,
    pub(crate) cols: usize,
    pub(crate) channels: usize,
    pub(crate) kernel: [usize; 2],
    pub(crate) stride: usize,
    pub(crate) padding: usize,
    pub(crate) out_rows: usize,
    pub(crate) out_cols: usize,
}

/// How the lines of a convolution's input are made.
#[derive(Clone, Copy)]
pub(crate) enum Fill<'a> {
    Copy(&'a [f32]),
    Relu(&'a [f32]),
    /// Resampled and with an embedding added, line by line.
    Resampled(&'a super::resample::Resampled<'a>),
}

/// Numbers beyond the last row that a tile may read (and multiply by zero).
const SLACK: usize = 64;
/// Bytes of prepared rows of a task: a quarter of a second-level cache.
const CHUNK_BYTES: usize = 256 << 10;
/// Rows of a chunk are a multiple of every kernel set's tile height.
const ROWS_UNIT: usize = 12;
/// Chunks are not taller: more tasks even out better.
const MAX_UNITS: usize = 8;
/// Bytes of a band's input lines: what a second-level cache holds beside a panel. Neighbouring bands both make the border
/// lines between them, so bands should not be thin.
const BAND_BYTES: usize = 384 << 10;

impl<'a> Source<'a> {
    pub(crate) fn inner(&self) -> Inner {
        match self {
            Self::Flat { inner, .. } => Inner { taps: 1, group: *inner },
            Self::Bands(b) => Inner { taps: b.kernel[0], group: b.kernel[1] * b.channels },
        }
    }

    fn chunk_rows(&self) -> usize {
        match self {
            Self::Flat { inner, .. } => {
                (CHUNK_BYTES / (4 * inner.max(&1) * ROWS_UNIT)).clamp(1, MAX_UNITS) * ROWS_UNIT
            }
            Self::Bands(b) => b.band_lines() * b.out_cols,
        }
    }

    fn all_rows(&self) -> usize {
        match self {
            Self::Flat { rows, .. } => *rows,
            Self::Bands(b) => b.out_rows * b.out_cols,
        }
    }

    /// Number of chunks that tasks work on.
    pub(crate) fn chunks(&self) -> usize {
        self.all_rows().div_ceil(self.chunk_rows().max(1))
    }

    /// The rows of a chunk.
    pub(crate) fn rows(&self, chunk: usize) -> Range<usize> {
        let first = chunk * self.chunk_rows();
        first..(first + self.chunk_rows()).min(self.all_rows())
    }

    /// How rows lie in what `prepare` gives.
    pub(crate) fn geometry<M: Multiply>(&self) -> Geometry {
        let inner = self.inner();
        match self {
            Self::Flat { x, rows, inner: width } => {
                let row_stride = if m_takes_directly::<M>(x, *width) {
                    *width
                } else {
                    // Pairs stay aligned, and rows do not fall into the same cache sets.
                    width.next_multiple_of(32) + 16
                };
                Geometry {
                    inner,
                    taps: vec![0],
                    line: (*rows).max(1),
                    row_stride,
                    line_stride: row_stride * rows,
                }
            }
            Self::Bands(b) => {
                let pitch = b.pitch();
                Geometry {
                    inner,
                    taps: (0..b.kernel[0]).map(|ky| ky * pitch).collect(),
                    line: b.out_cols.max(1),
                    row_stride: b.stride * b.channels,
                    line_stride: b.stride * pitch,
                }
            }
        }
    }

    /// Numbers of a pixel or row, which a centre has one of each of.
    pub(crate) fn channels(&self) -> usize {
        match self {
            Self::Flat { inner, .. } => *inner,
            Self::Bands(b) => b.channels,
        }
    }

    /// The chunk's rows, from its first one on, in the multiplication's number format and around a centre if there is one.
    #[inline(always)]
    pub(crate) fn prepare<'s, M: Multiply>(
        &'s self,
        m: M,
        geometry: &Geometry,
        chunk: usize,
        centre: Option<&[f32]>,
        scratch: &'s mut Scratch,
    ) -> &'s [M::Number] {
        let rows = self.rows(chunk);
        match self {
            Self::Flat { x, inner, .. } => {
                let x = &x[rows.start * inner..rows.end * inner];
                if m_takes_directly::<M>(x, *inner)
                    && let Some(direct) = M::direct(x)
                {
                    return direct;
                }
                let stride = geometry.row_stride;
                let numbers = rows.len() * stride + SLACK;
                let to = &mut M::numbers(scratch.words(numbers))[..numbers];
                if *inner > 0 {
                    for (x, to) in x.chunks_exact(*inner).zip(to.chunks_exact_mut(stride)) {
                        let (to, rest) = to.split_at_mut(*inner);
                        rest.fill(M::Number::default());
                        round(m, x, centre, to);
                    }
                }
                to
            }
            Self::Bands(b) => b.prepare(m, rows, centre, scratch),
        }
    }
}

/// Whether rows of a matrix are used where they are: in their own format, unless their distance is a multiple of 4 KiB,
/// where the rows of a tile would compete for the same cache sets.
fn m_takes_directly<M: Multiply>(x: &[f32], width: usize) -> bool {
    M::direct(x).is_some() && !(width > 0 && width.is_multiple_of(1024))
}

impl Bands<'_> {
    /// Distance of lines in a prepared band.
    fn pitch(&self) -> usize {
        (self.cols + 2 * self.padding) * self.channels
    }

    fn band_lines(&self) -> usize {
        let lines = BAND_BYTES / (4 * self.pitch()).max(1);
        (lines.saturating_sub(self.kernel[0] - 1) / self.stride).clamp(1, self.out_rows.max(1))
    }

    #[inline(always)]
    pub(crate) fn prepare<'s, M: Multiply>(
        &self,
        m: M,
        rows: Range<usize>,
        centre: Option<&[f32]>,
        scratch: &'s mut Scratch,
    ) -> &'s [M::Number] {
        let lines = rows.start / self.out_cols..rows.end / self.out_cols;
        let pitch = self.pitch();
        let needed = (lines.len() - 1) * self.stride + self.kernel[0];
        let width = self.cols * self.channels;
        let border = self.padding * self.channels;
        let numbers = needed * pitch + SLACK;
        let temporary = width.next_multiple_of(16);
        let (line, words) = scratch.words(temporary + numbers).split_at_mut(temporary);
        let line = &mut scratch::as_floats_mut(line)[..width];
        let to = &mut M::numbers(words)[..numbers];
        for i in 0..needed {
            let to = &mut to[i * pitch..(i + 1) * pitch];
            let row =
                (lines.start * self.stride + i).checked_sub(self.padding).filter(|row| *row < self.rows);
            let Some(row) = row else {
                round_zeros(m, centre, to);
                continue;
            };
            round_zeros(m, centre, &mut to[..border]);
            round_zeros(m, centre, &mut to[border + width..]);
            let to = &mut to[border..border + width];
            match self.fill {
                Fill::Copy(x) => round(m, &x[row * width..(row + 1) * width], centre, to),
                Fill::Relu(x) => {
                    for (line, x) in line.iter_mut().zip(&x[row * width..(row + 1) * width]) {
                        *line = if *x < 0.0 { 0.0 } else { *x }; // NaN stays NaN
                    }
                    round(m, line, centre, to);
                }
                Fill::Resampled(resampled) => {
                    resampled.line(m.simd(), row, line);
                    round(m, line, centre, to);
                }
            }
        }
        to[needed * pitch..].fill(M::Number::default());
        to
    }
}

/// Rounds whole pixels (or a row) around a centre, repeated as often as needed.
#[inline(always)]
fn round<M: Multiply>(m: M, x: &[f32], centre: Option<&[f32]>, to: &mut [M::Number]) {
    let Some(centre) = centre.filter(|centre| !centre.is_empty()) else {
        return m.convert(x, to);
    };
    for (x, to) in x.chunks(centre.len()).zip(to.chunks_mut(centre.len())) {
        m.convert_around(x, &centre[..x.len()], to);
    }
}

/// Whole pixels outside of a map.
#[inline(always)]
fn round_zeros<M: Multiply>(m: M, centre: Option<&[f32]>, to: &mut [M::Number]) {
    const ZEROS: [f32; 256] = [0.0; 256];
    let Some(centre) = centre.filter(|centre| !centre.is_empty()) else {
        return to.fill(M::Number::default());
    };
    for to in to.chunks_mut(centre.len()) {
        let centre = &centre[..to.len()];
        for (centre, to) in centre.chunks(ZEROS.len()).zip(to.chunks_mut(ZEROS.len())) {
            m.convert_around(&ZEROS[..centre.len()], centre, to);
        }
    }
}
