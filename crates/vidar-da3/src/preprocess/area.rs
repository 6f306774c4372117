//! Shrinking by the mean over the source area, bit-exact to OpenCV's `INTER_AREA` on bytes.
//!
//! When both ratios are whole, blocks are summed in integers. Otherwise the mean is separable: an output pixel weighs
//! the source pixels it covers by the share covered, along rows first and then along columns, in `f32`, in the order
//! of the taps; the result rounds half to even.

use rayon::prelude::*;
use vidar_core::Image;

/// `image` at `width` × `height`, neither larger than it is.
pub fn resize(image: &Image<[u8; 3]>, width: usize, height: usize) -> Image<[u8; 3]> {
    let (sw, sh) = (image.width(), image.height());
    if width == 0 || height == 0 || sw == 0 || sh == 0 {
        return Image::filled(width, height, [0; 3]);
    }
    let mut out = Image::filled(width, height, [0; 3]);
    if sw.is_multiple_of(width) && sh.is_multiple_of(height) {
        mean_of_blocks(image, &mut out);
    } else {
        mean_of_cells(image, &mut out);
    }
    out
}

fn mean_of_blocks(image: &Image<[u8; 3]>, out: &mut Image<[u8; 3]>) {
    let (kx, ky) = (image.width() / out.width(), image.height() / out.height());
    let inverse = 1.0 / (kx * ky) as f32;
    let is_quarter = kx == 2 && ky == 2;
    let width = out.width();
    out.data_mut().par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        for (x, pixel) in row.iter_mut().enumerate() {
            let mut sum = [0u64; 3];
            for source in (y * ky..(y + 1) * ky).map(|sy| &image.row(sy)[x * kx..(x + 1) * kx]) {
                for p in source {
                    sum = [0, 1, 2].map(|c| sum[c] + u64::from(p[c]));
                }
            }
            *pixel = sum.map(|s| if is_quarter { ((s + 2) >> 2) as u8 } else { to_byte(s as f32 * inverse) });
        }
    });
}

fn mean_of_cells(image: &Image<[u8; 3]>, out: &mut Image<[u8; 3]>) {
    let (width, height) = (out.width(), out.height());
    let across = taps(image.width(), width);
    let down = taps(image.height(), height);
    out.data_mut().par_chunks_mut(width).zip(&down).for_each(|(row, down)| {
        let mut sums = vec![[0.0f32; 3]; width];
        for &(sy, weight) in down {
            let source = image.row(sy);
            for (sum, taps) in sums.iter_mut().zip(&across) {
                let mut mean = [0.0f32; 3];
                for &(sx, w) in taps {
                    for c in 0..3 {
                        mean[c] += f32::from(source[sx][c]) * w;
                    }
                }
                for c in 0..3 {
                    sum[c] += mean[c] * weight;
                }
            }
        }
        for (pixel, sum) in row.iter_mut().zip(&sums) {
            *pixel = sum.map(to_byte);
        }
    });
}

fn to_byte(value: f32) -> u8 {
    value.round_ties_even().clamp(0.0, 255.0) as u8
}

/// A sliver below this share of a source pixel does not count (OpenCV's constant).
const SLIVER: f64 = 1e-3;

/// For each of `to` outputs over `from` sources: the sources it covers and their weights.
fn taps(from: usize, to: usize) -> Vec<Vec<(usize, f32)>> {
    let scale = from as f64 / to as f64;
    let one = |i: usize| {
        let begin = i as f64 * scale;
        let end = begin + scale;
        let cell = scale.min(from as f64 - begin);
        let last = (end.floor() as usize).min(from - 1);
        let first = (begin.ceil() as usize).min(last);
        let mut taps = Vec::with_capacity(last - first + 2);
        if first as f64 - begin > SLIVER {
            taps.push((first - 1, ((first as f64 - begin) / cell) as f32));
        }
        taps.extend((first..last).map(|k| (k, (1.0 / cell) as f32)));
        if end - last as f64 > SLIVER {
            taps.push((last, ((end - last as f64).min(1.0).min(cell) / cell) as f32));
        }
        taps
    };
    (0..to).map(one).collect()
}
