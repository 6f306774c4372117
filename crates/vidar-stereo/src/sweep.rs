//! Plane sweep (Collins 1996; Gallup 2007): matching costs of every pixel and inverse depth.
//!
//! The measure is zero-mean normalised cross-correlation over a small square window, which does not change with
//! gain and offset of the exposure. With noise variance σ² added to both variances,
//! `ncc = cov / √((var_r + σ²)(var_n + σ²))` goes to zero where there is no texture, so that noise matches nothing.
//! Costs are `254·clamp(1 − ncc, 0, 1)` in `u8`, and 255 where the window is not visible in a neighbour. The
//! better half of the neighbours is averaged: a surface that is occluded in some of them is mostly visible in others.

use crate::prepare::Level;
use crate::warp::{Warp, sample};
use rayon::prelude::*;

/// Cost of a window that is not visible in a neighbour.
pub(crate) const INVISIBLE: u8 = 255;
/// Cost of no correlation at all.
pub(crate) const WORST: f32 = 254.0;
/// Rows that one task computes; small enough for the strip's costs to stay in the cache.
const STRIP_ROWS: usize = 8;
/// Window radius, pixels.
pub(crate) const RADIUS: usize = 2;

/// A neighbour's image and the warp into it.
#[derive(Clone, Copy)]
pub(crate) struct Source<'a> {
    pub level: &'a Level,
    pub warp: Warp,
}

/// Inverse depths `first + step·k`, k = 0…count−1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Planes {
    pub first: f32,
    pub step: f32,
    pub count: usize,
}

impl Planes {
    /// The inverse depth of a (fractional) plane.
    pub fn rho(&self, plane: f32) -> f32 {
        self.first + self.step * plane
    }
}

/// Costs by row, column, plane (plane fastest): `height·width·planes.count` bytes.
pub(crate) fn sweep(reference: &Level, sources: &[Source<'_>], planes: &Planes, noise_gray: f32) -> Vec<u8> {
    let row_len = reference.width * planes.count;
    let mut volume = vec![INVISIBLE; reference.height * row_len];
    volume.par_chunks_mut(STRIP_ROWS * row_len).enumerate().for_each(|(strip, costs)| {
        Strip::new(reference, strip * STRIP_ROWS, costs.len() / row_len, noise_gray)
            .sweep(sources, planes, costs);
    });
    volume
}

/// A few rows of the reference with the sums of their windows.
struct Strip<'a> {
    reference: &'a Level,
    first_row: usize,
    rows: usize,
    /// Padded by the radius on all sides, borders repeated.
    gray: Vec<f32>,
    mean: Vec<f32>,
    inverse_deviation: Vec<f32>,
    noise_variance: f32,
}

const WINDOW: usize = 2 * RADIUS + 1;
const INVERSE_AREA: f32 = 1.0 / (WINDOW * WINDOW) as f32;

impl<'a> Strip<'a> {
    fn new(reference: &'a Level, first_row: usize, rows: usize, noise_gray: f32) -> Self {
        let (w, h) = (reference.width, reference.height);
        let padded_width = w + 2 * RADIUS;
        let mut gray = vec![0.0; padded_width * (rows + 2 * RADIUS)];
        for (i, row) in gray.chunks_exact_mut(padded_width).enumerate() {
            let y = (first_row + i).saturating_sub(RADIUS).min(h - 1);
            row[RADIUS..RADIUS + w].copy_from_slice(&reference.gray[y * w..][..w]);
            // Centred, so that sums of squares keep their digits.
            row.iter_mut().for_each(|p| *p -= 128.0);
            repeat_borders(row);
        }
        let noise_variance = noise_gray * noise_gray;
        let mut strip = Self {
            reference,
            first_row,
            rows,
            gray,
            mean: vec![0.0; w * rows],
            inverse_deviation: vec![0.0; w * rows],
            noise_variance,
        };
        let mut columns = [vec![0.0; padded_width], vec![0.0; padded_width]];
        for y in 0..rows {
            let [sum, square] = &mut columns;
            sum.fill(0.0);
            square.fill(0.0);
            for j in 0..WINDOW {
                let row = &strip.gray[(y + j) * padded_width..][..padded_width];
                for x in 0..padded_width {
                    sum[x] += row[x];
                    square[x] += row[x] * row[x];
                }
            }
            for x in 0..w {
                let mean = sum[x..x + WINDOW].iter().sum::<f32>() * INVERSE_AREA;
                let variance = square[x..x + WINDOW].iter().sum::<f32>() * INVERSE_AREA - mean * mean;
                strip.mean[y * w + x] = mean;
                strip.inverse_deviation[y * w + x] = 1.0 / (variance.max(0.0) + noise_variance).sqrt();
            }
        }
        strip
    }

    fn sweep(&self, sources: &[Source<'_>], planes: &Planes, costs: &mut [u8]) {
        let w = self.reference.width;
        let padded = (w + 2 * RADIUS) * (self.rows + 2 * RADIUS);
        let mut warped = vec![0.0f32; padded];
        let mut scratch = Scratch::new(w + 2 * RADIUS);
        let mut per_source = vec![vec![INVISIBLE; w * self.rows]; sources.len()];
        let mut merged = vec![INVISIBLE; w * self.rows];
        for plane in 0..planes.count {
            let rho = planes.rho(plane as f32);
            for (source, out) in sources.iter().zip(&mut per_source) {
                self.warp(source, rho, &mut warped);
                self.correlate(&warped, &mut scratch, out);
            }
            merge_better_half(&mut per_source, &mut merged);
            for (pixel, cost) in merged.iter().enumerate() {
                costs[pixel * planes.count + plane] = *cost;
            }
        }
    }

    /// The neighbour's image warped to the reference by the plane at inverse depth `rho`; NaN = not visible.
    fn warp(&self, source: &Source<'_>, rho: f32, warped: &mut [f32]) {
        let (w, h) = (self.reference.width, self.reference.height);
        let (a, b) = (&source.warp.a, &source.warp.b);
        let level = source.level;
        for (i, row) in warped.chunks_exact_mut(w + 2 * RADIUS).enumerate() {
            let y = (self.first_row + i).saturating_sub(RADIUS).min(h - 1) as f32;
            let base = [0, 1, 2].map(|r| a[r][1] * y + a[r][2] + rho * b[r]);
            for x in 0..w {
                let fx = x as f32;
                let depth_ratio = base[2] + a[2][0] * fx;
                let inverse =
                    if depth_ratio > crate::warp::MIN_DEPTH_RATIO { 1.0 / depth_ratio } else { f32::NAN };
                let (u, v) = ((base[0] + a[0][0] * fx) * inverse, (base[1] + a[1][0] * fx) * inverse);
                row[RADIUS + x] = sample(&level.gray, level.width, level.height, u, v) - 128.0;
            }
            repeat_borders(row);
        }
    }

    fn correlate(&self, warped: &[f32], scratch: &mut Scratch, out: &mut [u8]) {
        let w = self.reference.width;
        let padded_width = w + 2 * RADIUS;
        let rows_of = |data: &'_ [f32], y: usize| -> [std::ops::Range<usize>; WINDOW] {
            debug_assert!(data.len() >= (y + WINDOW) * padded_width);
            std::array::from_fn(|j| (y + j) * padded_width..(y + j + 1) * padded_width)
        };
        for y in 0..self.rows {
            let ranges = rows_of(warped, y);
            let n: [&[f32]; WINDOW] = std::array::from_fn(|j| &warped[ranges[j].clone()][..padded_width]);
            let r: [&[f32]; WINDOW] = std::array::from_fn(|j| &self.gray[ranges[j].clone()][..padded_width]);
            let (sum, square, cross) = scratch.split(padded_width);
            for x in 0..padded_width {
                let (mut s, mut q, mut c) = (0.0f32, 0.0f32, 0.0f32);
                for j in 0..WINDOW {
                    let value = n[j][x];
                    s += value;
                    q += value * value;
                    c += value * r[j][x];
                }
                (sum[x], square[x], cross[x]) = (s, q, c);
            }
            let mean_r = &self.mean[y * w..][..w];
            let inverse_r = &self.inverse_deviation[y * w..][..w];
            let out = &mut out[y * w..][..w];
            for x in 0..w {
                let (mut s, mut q, mut c) = (0.0f32, 0.0f32, 0.0f32);
                for i in 0..WINDOW {
                    s += sum[x + i];
                    q += square[x + i];
                    c += cross[x + i];
                }
                let mean = s * INVERSE_AREA;
                let variance = (q * INVERSE_AREA - mean * mean).max(0.0) + self.noise_variance;
                let covariance = c * INVERSE_AREA - mean * mean_r[x];
                let cost = WORST * (1.0 - covariance * inverse_r[x] / variance.sqrt());
                // `max`/`min` would swallow the NaN that marks an invisible pixel.
                out[x] = if s.is_nan() { INVISIBLE } else { cost.clamp(0.0, WORST) as u8 };
            }
        }
    }
}

/// Column sums of one row of windows.
struct Scratch(Vec<f32>);

impl Scratch {
    fn new(padded_width: usize) -> Self {
        Self(vec![0.0; 3 * padded_width])
    }

    fn split(&mut self, padded_width: usize) -> (&mut [f32], &mut [f32], &mut [f32]) {
        let (sum, rest) = self.0.split_at_mut(padded_width);
        let (square, cross) = rest.split_at_mut(padded_width);
        (sum, square, cross)
    }
}

fn repeat_borders(row: &mut [f32]) {
    let last = row.len() - RADIUS - 1;
    for i in 0..RADIUS {
        row[i] = row[RADIUS];
        row[last + 1 + i] = row[last];
    }
}

/// Sorts the neighbours' costs at each pixel (a compare-exchange network over whole rows, so that it vectorises) and
/// averages the better half of all neighbours; an invisible one in that half repeats the best visible one.
pub(crate) fn merge_better_half(per_source: &mut [Vec<u8>], merged: &mut [u8]) {
    let n = per_source.len();
    for pass in 0..n {
        for i in (0..n - 1 - pass.min(n - 1)).filter(|i| i + 1 < n) {
            let (left, right) = per_source.split_at_mut(i + 1);
            for (a, b) in left[i].iter_mut().zip(right[0].iter_mut()) {
                (*a, *b) = ((*a).min(*b), (*a).max(*b));
            }
        }
    }
    let half = n.div_ceil(2);
    for (pixel, out) in merged.iter_mut().enumerate() {
        let best = per_source[0][pixel];
        let mut sum = 0u32;
        for costs in &per_source[..half] {
            let cost = costs[pixel];
            sum += u32::from(if cost == INVISIBLE { best } else { cost });
        }
        *out = (sum / half as u32) as u8;
    }
}
