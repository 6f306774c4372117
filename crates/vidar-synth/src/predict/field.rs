//! Smooth random fields over an image: sums of a few half waves along rows and columns.
//!
//! The waves are not the bilinear grid by which a depth correction is usually fitted, so that a correction that is
//! tested on them cannot be perfect by construction.

use crate::random::Gaussian;
use rand::Rng;
use std::f64::consts::PI;

/// Amplitudes of `cos(πm(x+½)/w) · cos(πn(y+½)/h)` for m, n = 0…order, without the constant.
#[derive(Clone, Debug)]
pub(super) struct Field {
    order: usize,
    amplitudes: Vec<f64>,
}

impl Field {
    /// A field whose values have variance 1 over images and draws; amplitudes fall as one over the frequency.
    pub(super) fn random<R: Rng>(order: usize, random: &mut Gaussian<R>) -> Self {
        let n = order + 1;
        let spread = |k: usize| {
            let (m, n) = (k % n, k / n);
            if m + n == 0 { 0.0 } else { 1.0 / ((m * m + n * n) as f64).sqrt() }
        };
        // The mean of cos² is ½, that of the constant 1.
        let share =
            |k: usize| [k % n, k / n].iter().map(|&m| if m == 0 { 1.0 } else { 0.5 }).product::<f64>();
        let total: f64 = (0..n * n).map(|k| spread(k) * spread(k) * share(k)).sum();
        let amplitudes = (0..n * n).map(|k| random.next() * spread(k) / total.sqrt()).collect();
        Self { order, amplitudes }
    }

    /// `a · self + b · other`, of one order.
    pub(super) fn mixed(&self, a: f64, other: &Self, b: f64) -> Self {
        let pairs = self.amplitudes.iter().zip(&other.amplitudes);
        Self { order: self.order, amplitudes: pairs.map(|(x, y)| a * x + b * y).collect() }
    }

    /// Values at the pixels, row by row.
    pub(super) fn image(&self, width: usize, height: usize) -> Vec<f32> {
        let n = self.order + 1;
        let waves = |size: usize| -> Vec<f64> {
            let at = |i: usize| (PI * (i % n) as f64 * ((i / n) as f64 + 0.5) / size as f64).cos();
            (0..size * n).map(at).collect()
        };
        let (along, down) = (waves(width), waves(height));
        let mut values = Vec::with_capacity(width * height);
        for y in 0..height {
            let row: Vec<f64> =
                (0..n).map(|m| (0..n).map(|k| self.amplitudes[k * n + m] * down[y * n + k]).sum()).collect();
            let at = |x: usize| -> f64 { (0..n).map(|m| row[m] * along[x * n + m]).sum() };
            values.extend((0..width).map(|x| at(x) as f32));
        }
        values
    }
}

/// Gaussian blur of the finite values, each pixel by those of its neighbours that are finite; others stay as they are.
pub(super) fn blurred(values: &[f32], width: usize, sigma: f64) -> Vec<f32> {
    if sigma <= 0.0 || values.is_empty() {
        return values.to_vec();
    }
    let reach = (3.0 * sigma).ceil() as isize;
    let kernel: Vec<f32> =
        (-reach..=reach).map(|k| (-0.5 * (k as f64 / sigma).powi(2)).exp() as f32).collect();
    let height = values.len() / width;
    let known: Vec<[f32; 2]> =
        values.iter().map(|v| if v.is_finite() { [*v, 1.0] } else { [0.0, 0.0] }).collect();
    let pass = |source: &[[f32; 2]], stride: usize, size: usize, position: fn(usize, usize) -> usize| {
        let at = |i: usize| {
            let here = position(i, width) as isize;
            let mut sum = [0.0_f32; 2];
            for (k, weight) in (-reach..=reach).zip(&kernel) {
                if here + k >= 0 && here + k < size as isize {
                    let [value, count] = source[(i as isize + k * stride as isize) as usize];
                    sum = [sum[0] + weight * value, sum[1] + weight * count];
                }
            }
            sum
        };
        (0..source.len()).map(at).collect::<Vec<[f32; 2]>>()
    };
    let rows = pass(&known, 1, width, |i, w| i % w);
    let both = pass(&rows, width, height, |i, w| i / w);
    both.iter().zip(values).map(|(s, v)| if v.is_finite() { s[0] / s[1] } else { *v }).collect()
}
