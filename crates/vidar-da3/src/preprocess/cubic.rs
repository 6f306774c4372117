//! Enlarging with Keys' cubic (a = −0.75) and replicated borders, as OpenCV's `INTER_CUBIC` on bytes, correctly rounded.
//!
//! Weights and sums are `f64` and the result rounds half to even. There is no single official result to match: on x86 OpenCV
//! calls Intel's closed primitives (IPP), whose `f32` sums differ with the instruction set, so that a value within 3e-5 of a
//! tie may round either way. On an image of 320 × 240 enlarged to 504 × 378 (571 536 bytes), OpenCV 4.11 with AVX2 differs
//! from the recording of the official code in 4 bytes, with SSE4.2 in 4 others, and this file in 5, each by one grey level.
//! OpenCV without IPP (`OPENCV_IPP=disabled`, ARM) uses 11-bit weights and differs from the recording in 24 915 bytes.

use rayon::prelude::*;
use vidar_core::Image;

const A: f64 = -0.75;

/// `image` at `width` × `height`.
pub fn resize(image: &Image<[u8; 3]>, width: usize, height: usize) -> Image<[u8; 3]> {
    if width == 0 || height == 0 || image.width() == 0 || image.height() == 0 {
        return Image::filled(width, height, [0; 3]);
    }
    let across = taps(image.width(), width);
    let down = taps(image.height(), height);
    let rows: Vec<Vec<[f64; 3]>> = (0..image.height())
        .into_par_iter()
        .map(|y| {
            let row = image.row(y);
            across.iter().map(|taps| weigh(taps, |x| row[x].map(f64::from))).collect()
        })
        .collect();
    let mut out = Image::filled(width, height, [0; 3]);
    out.data_mut().par_chunks_mut(width).zip(&down).for_each(|(row, taps)| {
        for (x, pixel) in row.iter_mut().enumerate() {
            *pixel = weigh(taps, |y| rows[y][x]).map(|v| v.round_ties_even().clamp(0.0, 255.0) as u8);
        }
    });
    out
}

fn weigh(taps: &[(usize, f64); 4], pixel: impl Fn(usize) -> [f64; 3]) -> [f64; 3] {
    taps.iter().fold([0.0; 3], |sum, &(i, w)| {
        let p = pixel(i);
        [0, 1, 2].map(|c| sum[c] + p[c] * w)
    })
}

/// For each of `to` outputs: four sources (clamped to the image) and their weights.
fn taps(from: usize, to: usize) -> Vec<[(usize, f64); 4]> {
    let scale = from as f64 / to as f64;
    let one = |i: usize| {
        let at = (i as f64 + 0.5) * scale - 0.5;
        let base = at.floor();
        let weights = weights(at - base);
        std::array::from_fn(|k| {
            let source = (base as i64 + k as i64 - 1).clamp(0, from as i64 - 1);
            (source as usize, weights[k])
        })
    };
    (0..to).map(one).collect()
}

/// Keys' kernel at distances 1+t, t, 1−t, 2−t.
fn weights(t: f64) -> [f64; 4] {
    let near = |x: f64| ((A + 2.0) * x - (A + 3.0)) * x * x + 1.0;
    let far = |x: f64| ((A * x - 5.0 * A) * x + 8.0 * A) * x - 4.0 * A;
    [far(1.0 + t), near(t), near(1.0 - t), far(2.0 - t)]
}
