//! Matrix products with a fused end: the one loop behind linear layers and convolutions.
//!
//! `out = end(A B)`, where B's columns are output channels. A is never gathered: a row of A is addressed by an offset, and
//! the inner dimension is a list of *taps*, each a run of consecutive numbers at a fixed offset from the row's start. A
//! linear layer has one tap; a k×k convolution over an NHWC map has k taps (the k pixels of a kernel row are consecutive),
//! so that no im2col copy exists, only the input band with its border of zeros.
//!
//! Work is split into tasks of row chunks × column ranges; a task walks its columns panel by panel (one panel = the width
//! of a tile), and each panel tile by tile. Every output number is one accumulation over the inner dimension in its order,
//! whatever the split: the bits do not depend on the number of threads.

use rayon::prelude::*;

use super::shared::SharedMut;
use super::simd::Simd;
use super::{Kernel, dispatch, math};
use crate::compute::Compute;

/// What happens to a sum before it is stored, after the bias.
#[derive(Debug, Clone, Copy)]
pub(crate) enum End<'a> {
    Store,
    Gelu,
    Relu,
    /// `out += gamma * sum`
    Accumulate(Option<&'a [f32]>),
    /// `out = other + sum`, `other` laid out as `out`
    Add(&'a [f32]),
    /// Columns come in pairs of panels (gate, value): `out = silu(gate) * value`.
    SwiGlu,
}

/// Where the columns of B come from.
pub(crate) trait Columns: Sync {
    /// Writes column `column` of B (its whole inner dimension) to `out`.
    fn read(&self, column: usize, out: &mut [f32]);
}

/// Where the rows of A come from: chunks, each a buffer that rows are addressed in.
pub(crate) trait Rows: Sync {
    /// How many chunks there are.
    fn chunks(&self) -> usize;
    /// The chunk's numbers; `scratch` may be used to make them.
    fn chunk<'s>(&'s self, chunk: usize, scratch: &'s mut Vec<f32>) -> &'s [f32];
    /// Calls `run` for each run of rows of the chunk that lie at a constant stride.
    fn runs(&self, chunk: usize, run: &mut dyn FnMut(Run));
    /// The taps: offsets from the row's start; each is `group` consecutive numbers.
    fn taps(&self) -> &[usize];
    fn group(&self) -> usize;
    /// Distance between rows of a run in A and in the output.
    fn row_stride(&self) -> usize;
    fn out_stride(&self) -> usize;
}

/// `len` rows that start at `a` in the chunk's numbers and at `out` in the output.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Run {
    pub(crate) a: usize,
    pub(crate) out: usize,
    pub(crate) len: usize,
}

/// `out = end(A B + bias)`.
pub(crate) struct Product<'a> {
    pub(crate) rows: &'a dyn Rows,
    pub(crate) columns: &'a dyn Columns,
    /// Number of columns of B.
    pub(crate) width: usize,
    pub(crate) bias: Option<&'a [f32]>,
    pub(crate) end: End<'a>,
}

/// Rows of a tile. Panels are two vectors wide.
const TILE_ROWS: usize = 4;

impl Product<'_> {
    /// Computes it into `out`.
    pub(crate) fn run(&self, c: &Compute, out: &mut [f32]) {
        if self.width == 0 || self.rows.chunks() == 0 {
            return;
        }
        let isa = c.isa();
        let panel = dispatch(isa, PanelWidth);
        let inner = self.rows.taps().len() * self.rows.group();
        let panels = self.width.div_ceil(panel);
        let mut packed = vec![0.0; panels * panel * inner];
        if inner > 0 {
            packed.par_chunks_mut(panel * inner).enumerate().for_each(|(p, to)| {
                self.pack(p * panel, panel, inner, to);
            });
        }
        let out = SharedMut::new(out);
        (0..self.rows.chunks()).into_par_iter().for_each_init(Vec::new, |scratch, chunk| {
            let a = self.rows.chunk(chunk, scratch);
            dispatch(isa, Task { product: self, a, chunk, packed: &packed, out });
        });
    }

    /// Packs columns `first..first + panel` as [inner][panel], zeros beyond the last column.
    fn pack(&self, first: usize, panel: usize, inner: usize, to: &mut [f32]) {
        let mut column = vec![0.0; inner];
        for j in 0..panel {
            if first + j >= self.width {
                break;
            }
            self.columns.read(first + j, &mut column);
            for (k, value) in column.iter().enumerate() {
                to[k * panel + j] = *value;
            }
        }
    }
}

struct PanelWidth;

impl Kernel for PanelWidth {
    type Output = usize;
    #[inline(always)]
    fn run<S: Simd>(self, _: S) -> usize {
        2 * S::LANES
    }
}

struct Task<'a> {
    product: &'a Product<'a>,
    a: &'a [f32],
    chunk: usize,
    packed: &'a [f32],
    out: SharedMut<'a>,
}

impl Kernel for Task<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let rows = self.product.rows;
        let panel = 2 * S::LANES;
        let inner = rows.taps().len() * rows.group();
        let width = self.product.width;
        for first in (0..width).step_by(panel) {
            let b = &self.packed[first * inner..(first + panel) * inner];
            let columns = panel.min(width - first);
            rows.runs(self.chunk, &mut |run: Run| {
                let mut row = 0;
                while row < run.len {
                    let count = TILE_ROWS.min(run.len - row);
                    let at = run.a + row * rows.row_stride();
                    let mut tile = [[s.splat(0.0); 2]; TILE_ROWS];
                    match count {
                        4 => tile_rows::<S, 4>(s, self.a, at, rows, b, &mut tile),
                        3 => tile_rows::<S, 3>(s, self.a, at, rows, b, &mut tile),
                        2 => tile_rows::<S, 2>(s, self.a, at, rows, b, &mut tile),
                        _ => tile_rows::<S, 1>(s, self.a, at, rows, b, &mut tile),
                    }
                    for (i, sums) in tile.iter().enumerate().take(count) {
                        let start = run.out + (row + i) * rows.out_stride() + first;
                        self.end_row(s, *sums, first, columns, start);
                    }
                    row += count;
                }
            });
        }
    }
}

impl Task<'_> {
    /// Bias, end and store of one row of a tile.
    #[inline(always)]
    fn end_row<S: Simd>(&self, s: S, sums: [S::V; 2], first: usize, columns: usize, start: usize) {
        // SAFETY: rows and panels are disjoint between tasks and within one.
        let out = unsafe { self.out.part(start, columns) };
        for (half, sum) in sums.into_iter().enumerate() {
            let from = half * S::LANES;
            if from >= columns {
                return;
            }
            let to = (from + S::LANES).min(columns);
            let mut v = sum;
            if let Some(bias) = self.product.bias {
                v = s.add(v, s.load_part(&bias[first + from..first + to]));
            }
            let out = &mut out[from..to];
            v = match self.product.end {
                End::Store | End::SwiGlu => v,
                End::Gelu => math::gelu(s, v),
                End::Relu => math::relu(s, v),
                End::Accumulate(None) => s.add(s.load_part(out), v),
                End::Accumulate(Some(gamma)) => {
                    s.fma(s.load_part(&gamma[first + from..first + to]), v, s.load_part(out))
                }
                End::Add(other) => s.add(s.load_part(&other[start + from..start + to]), v),
            };
            s.store_part(out, v);
        }
    }
}

#[inline(always)]
fn tile_rows<S: Simd, const R: usize>(
    s: S,
    a: &[f32],
    at: usize,
    rows: &dyn Rows,
    b: &[f32],
    tile: &mut [[S::V; 2]; TILE_ROWS],
) {
    let (group, stride) = (rows.group(), rows.row_stride());
    let mut sums = [[s.splat(0.0); 2]; R];
    for (tap, b) in rows.taps().iter().zip(b.chunks_exact(group * 2 * S::LANES)) {
        let lines: [&[f32]; R] = std::array::from_fn(|r| &a[at + r * stride + tap..][..group]);
        for (k, b) in b.chunks_exact(2 * S::LANES).enumerate() {
            let (left, right) = b.split_at(S::LANES);
            let (left, right) = (s.load(left), s.load(right));
            for r in 0..R {
                let x = s.splat(lines[r][k]);
                sums[r] = [s.fma(x, left, sums[r][0]), s.fma(x, right, sums[r][1])];
            }
        }
    }
    tile[..R].copy_from_slice(&sums);
}
