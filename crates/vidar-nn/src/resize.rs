//! Resampling of NHWC maps.

use rayon::prelude::*;

use crate::compute::Compute;
use crate::conv::MapRef;
use crate::kernels::resample::{Resampled, Tap};
use crate::kernels::simd::Simd;
use crate::kernels::{Kernel, dispatch};

/// How output pixels map to input pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Corners {
    /// The centres of the corner pixels coincide (`align_corners=True`): source = i (n - 1) / (m - 1).
    Aligned,
    /// The outer edges coincide (`align_corners=False`): source = (i + 0.5) n / m - 0.5, not below 0.
    Edges,
}

/// The inputs of each output index.
pub(crate) fn taps(n: usize, m: usize, corners: Corners) -> Vec<Tap> {
    let last = n.saturating_sub(1);
    (0..m)
        .map(|i| {
            let source = match corners {
                Corners::Aligned if m > 1 => i as f32 * (last as f32 / (m - 1) as f32),
                Corners::Aligned => 0.0,
                Corners::Edges => ((i as f32 + 0.5) * (n as f32 / m as f32) - 0.5).max(0.0),
            };
            let low = (source as usize).min(last);
            Tap { low, high: (low + 1).min(last), t: source - low as f32 }
        })
        .collect()
}

/// Rows and columns of a map to be made.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MapSize {
    /// Rows of pixels.
    pub rows: usize,
    /// Pixels of a row.
    pub cols: usize,
}

/// An embedding of the pixel grid that is added to a map: the first half of the channels depends on the column, the second
/// on the row.
#[derive(Debug, Clone, PartialEq)]
pub struct GridEmbedding {
    /// `[cols, channels / 2]`
    pub by_col: Vec<f32>,
    /// `[rows, channels / 2]`
    pub by_row: Vec<f32>,
}

impl GridEmbedding {
    /// The tables, checked.
    pub(crate) fn view(&self, channels: usize, size: MapSize) -> (&[f32], &[f32]) {
        assert_eq!(channels % 2, 0, "an embedded map has an even number of channels");
        assert_eq!(self.by_col.len(), size.cols * (channels / 2), "embedding by column");
        assert_eq!(self.by_row.len(), size.rows * (channels / 2), "embedding by row");
        (&self.by_col, &self.by_row)
    }

    /// Adds it to a map `[rows, cols, channels]` in place.
    ///
    /// # Panics
    /// When a length does not fit.
    pub fn add_to(&self, map: &mut [f32], channels: usize, size: MapSize) {
        assert_eq!(map.len(), size.rows * size.cols * channels, "embedded map");
        let (by_col, by_row) = self.view(channels, size);
        let half = channels / 2;
        if map.is_empty() {
            return;
        }
        map.par_chunks_mut(size.cols * channels).zip(by_row.par_chunks(half)).for_each(|(line, by_row)| {
            for (pixel, by_col) in line.chunks_exact_mut(channels).zip(by_col.chunks_exact(half)) {
                let (first, second) = pixel.split_at_mut(half);
                first.iter_mut().zip(by_col).for_each(|(x, e)| *x += e);
                second.iter_mut().zip(by_row).for_each(|(x, e)| *x += e);
            }
        });
    }
}

struct Line<'a> {
    resampled: &'a Resampled<'a>,
    row: usize,
    out: &'a mut [f32],
}

impl Kernel for Line<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        self.resampled.line(s, self.row, self.out);
    }
}

/// Bilinear resampling of `x` (`[rows, cols, channels]`) to `out` (`[size.rows, size.cols, channels]`).
///
/// # Panics
/// When a slice has another length, or a map without pixels is to be enlarged.
pub fn resize_bilinear(
    c: &Compute,
    x: MapRef<'_>,
    channels: usize,
    size: MapSize,
    corners: Corners,
    out: &mut [f32],
) {
    assert_eq!(x.data.len(), x.rows * x.cols * channels, "resize: input");
    assert_eq!(out.len(), size.rows * size.cols * channels, "resize: output");
    if out.is_empty() {
        return;
    }
    assert!(!x.data.is_empty(), "resize: a map without pixels");
    let (ys, xs) = (taps(x.rows, size.rows, corners), taps(x.cols, size.cols, corners));
    let resampled = Resampled { x: x.data, cols: x.cols, channels, ys: &ys, xs: &xs, embedding: None };
    out.par_chunks_mut(size.cols * channels).enumerate().for_each(|(row, out)| {
        dispatch(c.isa(), Line { resampled: &resampled, row, out });
    });
}

/// Keys' cubic weights with a = -0.75 for the four inputs around a fraction `t`.
fn cubic_weights(t: f32) -> [f32; 4] {
    const A: f32 = -0.75;
    let near = |x: f32| ((A + 2.0) * x - (A + 3.0)) * x * x + 1.0;
    let far = |x: f32| ((A * x - 5.0 * A) * x + 8.0 * A) * x - 4.0 * A;
    [far(t + 1.0), near(t), near(1.0 - t), far(2.0 - t)]
}

/// Bicubic resampling (a = -0.75, no antialiasing, border clamped) with explicit scale factors: output index i reads the
/// input at `(i + 0.5) / scale - 0.5`. DA3's position embedding uses scales that differ from the ratio of the sizes.
///
/// # Panics
/// When a slice has another length, or a map without pixels is to be enlarged.
pub fn resize_bicubic_scaled(
    x: MapRef<'_>,
    channels: usize,
    out_rows: usize,
    out_cols: usize,
    [scale_rows, scale_cols]: [f64; 2],
    out: &mut [f32],
) {
    assert_eq!(x.data.len(), x.rows * x.cols * channels, "resize: input");
    assert_eq!(out.len(), out_rows * out_cols * channels, "resize: output");
    if out.is_empty() {
        return;
    }
    assert!(!x.data.is_empty(), "resize: a map without pixels");
    let taps = |n: usize, m: usize, scale: f64| -> Vec<([usize; 4], [f32; 4])> {
        let step = (1.0 / scale) as f32;
        (0..m)
            .map(|i| {
                let source = (i as f32 + 0.5) * step - 0.5;
                let base = source.floor();
                let at = |k: isize| (base as isize + k).clamp(0, n.cast_signed() - 1).cast_unsigned();
                ([at(-1), at(0), at(1), at(2)], cubic_weights(source - base))
            })
            .collect()
    };
    let (ys, xs) = (taps(x.rows, out_rows, scale_rows), taps(x.cols, out_cols, scale_cols));
    out.par_chunks_mut(out_cols * channels).zip(ys).for_each(|(out, (rows, wy))| {
        for (out, (cols, wx)) in out.chunks_exact_mut(channels).zip(&xs) {
            out.fill(0.0);
            for (row, wy) in rows.iter().zip(wy) {
                for (col, wx) in cols.iter().zip(wx) {
                    let pixel = &x.data[(row * x.cols + col) * channels..][..channels];
                    let w = wy * wx;
                    for (out, p) in out.iter_mut().zip(pixel) {
                        *out += w * p;
                    }
                }
            }
        }
    });
}
