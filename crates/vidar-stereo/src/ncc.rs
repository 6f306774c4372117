//! Matching costs of rows of pixels: zero-mean normalised cross-correlation in small square windows.
//!
//! The measure does not change with gain and offset of the exposure. With noise variance σ² added to both variances,
//! `ncc = cov / √((var_r + σ²)(var_n + σ²))` goes to zero where there is no texture, so that noise matches nothing. The
//! cost is `1 − ncc` in 0…1, and [`HIDDEN`] where the window is not visible in the neighbour.
//!
//! Warped values are rounded to quarters of a grey level, so that window sums are integers below 2²⁴: exact in `f32`, in
//! any order, which lets the sums run down the columns.

use crate::prepare::{GRAY_STEPS, Level};
use crate::warp::{RowSamples, Warp};
use crate::window::{HIDDEN, RADIUS, UNITS};
use vidar_core::simd::kernel;

const WINDOW: usize = 2 * RADIUS + 1;
const INVERSE_AREA: f32 = 1.0 / (WINDOW * WINDOW) as f32;
/// Pixels that are taken at once, in loops whose length the compiler knows: it unrolls others by more than rows are long, and does the rest
/// of each row one by one.
const LANES: usize = 16;
/// Image units per matched unit.
const COARSENING: i32 = GRAY_STEPS / 4;

/// A neighbour's image and the warp into it.
#[derive(Clone, Copy)]
pub(crate) struct Source<'a> {
    pub level: &'a Level,
    pub warp: Warp,
}

/// The reference's image with the statistics of its windows, in matched units.
pub(crate) struct Reference {
    pub width: usize,
    pub height: usize,
    /// `width` and the radius on both sides, and up to a multiple of [`LANES`] zeros.
    stride: usize,
    /// Padded by the radius on all sides, borders repeated.
    gray: Vec<f32>,
    mean: Vec<f32>,
    /// `1/√(var + σ²)`.
    pub inverse_deviation: Vec<f32>,
    noise_variance: f32,
}

kernel! {
    fn with_statistics(level: &Level, noise_gray: f32) -> Reference {
        Reference::with_statistics(level, noise_gray)
    }
}

impl Reference {
    pub fn new(level: &Level, noise_gray: f32) -> Self {
        with_statistics(level, noise_gray)
    }

    #[inline(always)]
    fn with_statistics(level: &Level, noise_gray: f32) -> Self {
        let (width, height) = (level.width, level.height);
        let stride = (width + 2 * RADIUS).next_multiple_of(LANES);
        let mut gray = vec![0.0; stride * (height + 2 * RADIUS)];
        for (i, row) in gray.chunks_exact_mut(stride).enumerate() {
            let y = i.saturating_sub(RADIUS).min(height - 1);
            for (unit, &g) in row[RADIUS..].iter_mut().zip(&level.gray[y * width..][..width]) {
                *unit = ((i32::from(g) + COARSENING / 2) >> COARSENING.trailing_zeros()) as f32;
            }
            repeat_borders(&mut row[..width + 2 * RADIUS]);
        }
        let noise_variance = (UNITS * noise_gray) * (UNITS * noise_gray);
        let (mut mean, mut inverse_deviation) = (vec![0.0; width * height], vec![0.0; width * height]);
        let (mut sum, mut square) = (vec![0.0f32; stride], vec![0.0f32; stride]);
        for y in 0..height {
            sum.fill(0.0);
            square.fill(0.0);
            for row in gray[y * stride..][..WINDOW * stride].chunks_exact(stride) {
                for ((s, q), &v) in sum.iter_mut().zip(&mut square).zip(row) {
                    *s += v;
                    *q += v * v;
                }
            }
            let mean = &mut mean[y * width..][..width];
            let inverse = &mut inverse_deviation[y * width..][..width];
            for x in 0..width {
                let m = window(&sum, x, width) * INVERSE_AREA;
                let variance = window(&square, x, width) * INVERSE_AREA - m * m;
                mean[x] = m;
                inverse[x] = 1.0 / (variance.max(0.0) + noise_variance).sqrt();
            }
        }
        Self { width, height, stride, gray, mean, inverse_deviation, noise_variance }
    }
}

/// Sum of the window's columns around pixel `x`, of column sums that begin `RADIUS` before pixel 0.
#[inline(always)]
fn window(columns: &[f32], x: usize, width: usize) -> f32 {
    let columns = &columns[..width + 2 * RADIUS];
    let mut sum = columns[x];
    for i in 1..WINDOW {
        sum += columns[x + i];
    }
    sum
}

fn repeat_borders(row: &mut [f32]) {
    let last = row.len() - RADIUS - 1;
    for i in 0..RADIUS {
        row[i] = row[RADIUS];
        row[last + 1 + i] = row[last];
    }
}

/// An inverse depth at each pixel, 1/m: rows of `stride`, or one row for all with `stride` 0.
#[derive(Clone, Copy)]
pub(crate) struct Surface<'a> {
    pub rho: &'a [f32],
    pub stride: usize,
}

/// Rows of the reference that are matched together, with the memory that this takes.
pub(crate) struct Strip<'a> {
    reference: &'a Reference,
    first_row: usize,
    rows: usize,
    /// The neighbour's rows, warped to the reference, padded like it.
    warped: Vec<f32>,
    /// 0 where the window's centre is visible, [`HIDDEN`] elsewhere.
    hidden: Vec<f32>,
    samples: RowSamples,
    /// Column sums of the neighbour, of its squares, and of its products with the reference.
    columns: [Vec<f32>; 3],
    per_source: Vec<Vec<f32>>,
}

impl<'a> Strip<'a> {
    pub fn new(reference: &'a Reference, first_row: usize, rows: usize, sources: usize) -> Self {
        let (width, stride) = (reference.width, reference.stride);
        Self {
            reference,
            first_row,
            rows,
            warped: vec![0.0; stride * (rows + 2 * RADIUS)],
            hidden: vec![0.0; width * (rows + 2 * RADIUS)],
            samples: RowSamples::new(width),
            columns: std::array::from_fn(|_| vec![0.0; stride]),
            per_source: vec![vec![0.0; width * rows]; sources],
        }
    }

    /// Costs of `surface` moved by `shift`: the mean of the better half of the sources, because a surface that is
    /// occluded in some of them is mostly visible in others. `HIDDEN` where no source sees it.
    pub fn costs(&mut self, sources: &[Source<'_>], surface: Surface<'_>, shift: f32, merged: &mut [f32]) {
        merged_costs(self, sources, surface, shift, merged);
    }

    #[inline(always)]
    fn warp(&mut self, source: &Source<'_>, surface: Surface<'_>, shift: f32) {
        let (width, height, stride) = (self.reference.width, self.reference.height, self.reference.stride);
        let rows = self.warped.chunks_exact_mut(stride).zip(self.hidden.chunks_exact_mut(width));
        for (i, (row, hidden)) in rows.enumerate() {
            let y = (self.first_row + i).saturating_sub(RADIUS).min(height - 1);
            let rho = &surface.rho[y * surface.stride..][..width];
            let level = source.level;
            self.samples.locate(&source.warp, level, y, rho, shift, hidden);
            self.samples.hide_masked(level, hidden);
            self.samples.fetch(level);
            self.samples.blend(&mut row[RADIUS..RADIUS + width]);
            repeat_borders(&mut row[..width + 2 * RADIUS]);
        }
    }

    /// The costs of one source, whose rows have been warped.
    #[inline(always)]
    fn correlate(&mut self, source: usize) {
        let r = self.reference;
        let (width, stride) = (r.width, r.stride);
        let own = &r.gray[self.first_row * stride..][..self.warped.len()];
        let [sum, square, cross] = &mut self.columns;
        let (sum, square, cross) = (&mut sum[..stride], &mut square[..stride], &mut cross[..stride]);
        sum.fill(0.0);
        square.fill(0.0);
        cross.fill(0.0);
        let row = |data: &'_ [f32], i: usize| -> std::ops::Range<usize> {
            debug_assert!(data.len() >= (i + 1) * stride);
            i * stride..(i + 1) * stride
        };
        for i in 0..self.rows + 2 * RADIUS {
            let (n, o) = (&self.warped[row(&self.warped, i)], &own[row(own, i)]);
            let [n, o] = [n, o].map(|row| row.as_chunks::<LANES>().0);
            let sums = sum.as_chunks_mut::<LANES>().0.iter_mut();
            let sums = sums.zip(square.as_chunks_mut::<LANES>().0).zip(cross.as_chunks_mut::<LANES>().0);
            if i < WINDOW {
                for (((s, q), c), (n, o)) in sums.zip(n.iter().zip(o)) {
                    for x in 0..LANES {
                        s[x] += n[x];
                        q[x] += n[x] * n[x];
                        c[x] += n[x] * o[x];
                    }
                }
            } else {
                let gone = self.warped[row(&self.warped, i - WINDOW)].as_chunks::<LANES>().0;
                let gone_o = own[row(own, i - WINDOW)].as_chunks::<LANES>().0;
                for ((((s, q), c), (n, o)), (gone, gone_o)) in
                    sums.zip(n.iter().zip(o)).zip(gone.iter().zip(gone_o))
                {
                    for x in 0..LANES {
                        s[x] += n[x] - gone[x];
                        q[x] += n[x] * n[x] - gone[x] * gone[x];
                        c[x] += n[x] * o[x] - gone[x] * gone_o[x];
                    }
                }
            }
            if i + 1 < WINDOW {
                continue;
            }
            let y = i + 1 - WINDOW;
            let mean = &r.mean[(self.first_row + y) * width..][..width];
            let inverse = &r.inverse_deviation[(self.first_row + y) * width..][..width];
            let hidden = &self.hidden[(y + RADIUS) * width..][..width];
            let out = &mut self.per_source[source][y * width..][..width];
            let windows = WindowRow { columns: [sum, square, cross], mean, inverse, hidden };
            // The last pixels once more where the row is no multiple; a narrow row pixel by pixel.
            let Some(last) = width.checked_sub(LANES) else {
                (0..width).for_each(|x| windows.costs::<1>(r.noise_variance, x, out));
                continue;
            };
            for block in 0..width.div_ceil(LANES) {
                windows.costs::<LANES>(r.noise_variance, (block * LANES).min(last), out);
            }
        }
    }
}

/// What the costs of a row are computed from: sums over the columns of its windows, of the neighbour, its squares, and its products with
/// the reference; of the reference the mean and the inverse deviation; and what is hidden.
struct WindowRow<'a> {
    columns: [&'a [f32]; 3],
    mean: &'a [f32],
    inverse: &'a [f32],
    hidden: &'a [f32],
}

impl WindowRow<'_> {
    /// The costs of `N` pixels from `x` on.
    #[inline(always)]
    fn costs<const N: usize>(&self, noise_variance: f32, x: usize, out: &mut [f32]) {
        let [sum, square, cross] = self.columns.map(|columns| &columns[x..x + N + 2 * RADIUS]);
        let (mean, inverse) = (&self.mean[x..x + N], &self.inverse[x..x + N]);
        let (hidden, out) = (&self.hidden[x..x + N], &mut out[x..x + N]);
        for x in 0..N {
            let m = window(sum, x, N) * INVERSE_AREA;
            let variance = (window(square, x, N) * INVERSE_AREA - m * m).max(0.0) + noise_variance;
            let covariance = window(cross, x, N) * INVERSE_AREA - m * mean[x];
            let cost = 1.0 - covariance * inverse[x] / variance.sqrt();
            // A visible window has 0…1 here, a hidden one exactly HIDDEN.
            let cost = if cost < 1.0 { cost } else { 1.0 };
            out[x] = if cost > hidden[x] { cost } else { hidden[x] };
        }
    }
}

kernel! {
    fn merged_costs(
        strip: &mut Strip<'_>,
        sources: &[Source<'_>],
        surface: Surface<'_>,
        shift: f32,
        merged: &mut [f32],
    ) {
        for (i, source) in sources.iter().enumerate() {
            strip.warp(source, surface, shift);
            strip.correlate(i);
        }
        merge_better_half(&strip.per_source[..sources.len()], merged);
    }
}

/// The mean of the better half of the sources at each pixel; a hidden one in that half repeats the best.
#[inline(always)]
fn merge_better_half(per_source: &[Vec<f32>], merged: &mut [f32]) {
    match per_source {
        [a] => merge([a], merged),
        [a, b] => merge([a, b], merged),
        [a, b, c] => merge([a, b, c], merged),
        [a, b, c, d] => merge([a, b, c, d], merged),
        [a, b, c, d, e] => merge([a, b, c, d, e], merged),
        [a, b, c, d, e, f] => merge([a, b, c, d, e, f], merged),
        [a, b, c, d, e, f, g] => merge([a, b, c, d, e, f, g], merged),
        [a, b, c, d, e, f, g, h, ..] => merge([a, b, c, d, e, f, g, h], merged),
        [] => merged.fill(HIDDEN),
    }
}

#[inline(always)]
fn merge<const N: usize>(per_source: [&Vec<f32>; N], merged: &mut [f32]) {
    let half = N.div_ceil(2);
    let per_source = per_source.map(|costs| &costs[..merged.len()]);
    for x in 0..merged.len() {
        let mut costs: [f32; N] = std::array::from_fn(|i| per_source[i][x]);
        // Each pass moves the least of the rest to its place.
        for pass in 0..half {
            for i in (pass..N - 1).rev() {
                let (a, b) = (costs[i], costs[i + 1]);
                (costs[i], costs[i + 1]) = if b < a { (b, a) } else { (a, b) };
            }
        }
        let mut sum = costs[0];
        for &cost in &costs[1..half] {
            sum += if cost > 1.0 { costs[0] } else { cost };
        }
        merged[x] = sum * (1.0 / half as f32);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::Pinhole;

    fn level(width: usize, height: usize, seed: usize) -> Level {
        let gray =
            (0..width * height).map(|i| ((i * 7919 + seed * 104_729) % 1021) as i16 * 4 - 2048).collect();
        let intrinsics = Pinhole::new(20.0, 20.0, 10.0, 8.0, width, height).expect("valid");
        Level { width, height, gray, intrinsics, hidden: Vec::new() }
    }

    /// Moves by whole pixels: two to the right per unit of inverse depth.
    fn shift() -> Warp {
        Warp { a: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]], b: [2.0, 0.0, 0.0] }
    }

    fn costs_of(reference: &Level, other: &Level, rho: f32) -> Vec<f32> {
        let windows = Reference::new(reference, 1.0);
        let source = Source { level: other, warp: shift() };
        let flat = vec![rho; reference.width];
        let mut strip = Strip::new(&windows, 0, reference.height, 1);
        let mut costs = vec![0.0; reference.width * reference.height];
        strip.costs(&[source], Surface { rho: &flat, stride: 0 }, 0.0, &mut costs);
        costs
    }

    #[test]
    fn costs_are_those_of_the_definition_at_every_row_of_the_running_sums() {
        // A row that is no multiple of the pixels taken at once, and one narrower than they are.
        [24, 13].into_iter().for_each(costs_are_those_of_the_definition);
    }

    fn costs_are_those_of_the_definition(w: usize) {
        let h = 19;
        let (reference, other) = (level(w, h, 1), level(w, h, 2));
        let found = costs_of(&reference, &other, 1.0);
        let gray = |level: &Level, x: usize, y: usize| f64::from((level.gray[y * w + x] + 2) >> 2);
        for (x, y) in (2..w - 2).flat_map(|x| (2..h - 3).map(move |y| (x, y))) {
            if x + 4 >= w {
                assert_eq!(found[y * w + x], HIDDEN, "{x} {y}");
                continue;
            }
            let window: Vec<(f64, f64)> = (y - 2..=y + 2)
                .flat_map(|v| (x - 2..=x + 2).map(move |u| (u, v)))
                .map(|(u, v)| (gray(&reference, u, v), gray(&other, (u + 2).min(w - 1), v)))
                .collect();
            let mean = |of: fn(&(f64, f64)) -> f64| window.iter().map(of).sum::<f64>() / 25.0;
            let (a, b) = (mean(|p| p.0), mean(|p| p.1));
            let (var_a, var_b) = (mean(|p| p.0 * p.0) - a * a, mean(|p| p.1 * p.1) - b * b);
            let covariance = mean(|p| p.0 * p.1) - a * b;
            let expected = 1.0 - covariance / ((var_a + 16.0) * (var_b + 16.0)).sqrt();
            // Samples of the last row and column mix in a 64th of those before.
            if x + 5 < w {
                let expected = expected.clamp(0.0, 1.0);
                assert!((f64::from(found[y * w + x]) - expected).abs() < 1e-4, "{x} {y}: {expected}");
            }
        }
    }

    #[test]
    fn the_better_half_is_averaged_and_hidden_sources_repeat_the_best() {
        let of = |costs: &[f32]| {
            let per_source: Vec<Vec<f32>> = costs.iter().map(|&c| vec![c]).collect();
            let mut merged = [9.0];
            merge_better_half(&per_source, &mut merged);
            merged[0]
        };
        assert!((of(&[0.5, 0.1, 0.9, 0.3, 0.2]) - 0.2).abs() < 1e-6);
        assert!((of(&[HIDDEN, 0.4, HIDDEN, HIDDEN]) - 0.4).abs() < 1e-6);
        assert!(of(&[HIDDEN, HIDDEN, HIDDEN]) > 1.0);
    }
}
