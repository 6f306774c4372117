//! Resampling of NHWC maps.

use rayon::prelude::*;

use crate::conv::MapRef;

/// How output pixels map to input pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Corners {
    /// The centres of the corner pixels coincide (`align_corners=True`): source = i (n - 1) / (m - 1).
    Aligned,
    /// The outer edges coincide (`align_corners=False`): source = (i + 0.5) n / m - 0.5, not below 0.
    Edges,
}

/// One output index: two inputs and the weight of the second.
#[derive(Debug, Clone, Copy)]
struct Tap {
    low: usize,
    high: usize,
    t: f32,
}

fn taps(n: usize, m: usize, corners: Corners) -> Vec<Tap> {
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

/// Bilinear resampling of `x` (`[rows, cols, channels]`) to `out` (`[out_rows, out_cols, channels]`).
///
/// # Panics
/// When a slice has another length, or a map without pixels is to be enlarged.
pub fn resize_bilinear(
    x: MapRef<'_>,
    channels: usize,
    out_rows: usize,
    out_cols: usize,
    corners: Corners,
    out: &mut [f32],
) {
    assert_eq!(x.data.len(), x.rows * x.cols * channels, "resize: input");
    assert_eq!(out.len(), out_rows * out_cols * channels, "resize: output");
    if out.is_empty() {
        return;
    }
    assert!(!x.data.is_empty(), "resize: a map without pixels");
    let (ys, xs) = (taps(x.rows, out_rows, corners), taps(x.cols, out_cols, corners));
    let line = x.cols * channels;
    out.par_chunks_mut(out_cols * channels).zip(ys).for_each(|(out, y)| {
        let (top, bottom) = (&x.data[y.low * line..][..line], &x.data[y.high * line..][..line]);
        for (out, tap) in out.chunks_exact_mut(channels).zip(&xs) {
            let (l, r) = (tap.low * channels, tap.high * channels);
            let (tl, tr) = (&top[l..l + channels], &top[r..r + channels]);
            let (bl, br) = (&bottom[l..l + channels], &bottom[r..r + channels]);
            for i in 0..channels {
                let upper = tl[i] + (tr[i] - tl[i]) * tap.t;
                let lower = bl[i] + (br[i] - bl[i]) * tap.t;
                out[i] = upper + (lower - upper) * y.t;
            }
        }
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
