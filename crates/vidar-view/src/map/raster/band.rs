//! Samples of a few rows: what is nearest, and its colour.

use super::{Lens, REACH, SAMPLES, SUBSAMPLE, Vertex};
use crate::canvas::theme;

/// The samples of a few rows.
pub(super) struct Band {
    columns: usize,
    rows: usize,
    /// First sample row in the picture.
    top: usize,
    nearness: Vec<f32>,
    colors: Vec<[u8; 3]>,
}

impl Band {
    pub(super) fn new(width: usize, rows: usize, first_row: usize) -> Self {
        let samples = width * rows * SAMPLES * SAMPLES;
        Self {
            columns: width * SAMPLES,
            rows: rows * SAMPLES,
            top: first_row * SAMPLES,
            nearness: vec![f32::NEG_INFINITY; samples],
            colors: vec![theme::PAPER; samples],
        }
    }

    /// Sets a sample if it is nearer than what is there; among equals the first is kept.
    fn put(&mut self, column: usize, row: usize, nearness: f32, color: impl FnOnce() -> [f32; 3]) {
        let i = row * self.columns + column;
        if nearness > self.nearness[i] {
            self.nearness[i] = nearness;
            self.colors[i] = color().map(|c| (c + 0.5).clamp(0.0, 255.0) as u8);
        }
    }

    /// Samples whose centre lies within the triangle; on an edge, those of top and left edges (so that neighbours
    /// share no sample and leave none out).
    pub(super) fn triangle(&mut self, lens: &Lens, vertices: &[Vertex; 3]) {
        let mut v = *vertices;
        let mut points = v.map(|v| lens.sample_point(&v.place));
        if points.iter().any(|p| !(p.0.abs() < REACH && p.1.abs() < REACH)) {
            return;
        }
        let fixed =
            |p: &(f64, f64, f32)| ((p.0 * SUBSAMPLE).round() as i64, (p.1 * SUBSAMPLE).round() as i64);
        let mut f = [fixed(&points[0]), fixed(&points[1]), fixed(&points[2])];
        let edge = |a: (i64, i64), b: (i64, i64), p: (i64, i64)| {
            (b.0 - a.0) * (p.1 - a.1) - (b.1 - a.1) * (p.0 - a.0)
        };
        let mut area = edge(f[0], f[1], f[2]);
        if area == 0 {
            return;
        }
        if area < 0 {
            f.swap(1, 2);
            points.swap(1, 2);
            v.swap(1, 2);
            area = -area;
        }
        // Opposite to corner i lies the edge from corner i+1 to corner i+2.
        let ends: [_; 3] = std::array::from_fn(|i| (f[(i + 1) % 3], f[(i + 2) % 3]));
        let bias = ends.map(|(a, b)| {
            let is_top_left = (a.1 == b.1 && b.0 > a.0) || b.1 < a.1;
            if is_top_left { 0 } else { -1 }
        });
        let one = SUBSAMPLE as i64;
        let whole = |value: i64| value.div_euclid(one);
        let least = |k: fn(&(i64, i64)) -> i64| k(&f[0]).min(k(&f[1])).min(k(&f[2]));
        let most = |k: fn(&(i64, i64)) -> i64| k(&f[0]).max(k(&f[1])).max(k(&f[2]));
        let columns = whole(least(|p| p.0)).max(0)..(whole(most(|p| p.0)) + 1).min(self.columns as i64);
        let top = self.top as i64;
        let rows = whole(least(|p| p.1)).max(top)..(whole(most(|p| p.1)) + 1).min(top + self.rows as i64);
        let inverse = 1.0 / area as f32;
        for row in rows {
            for column in columns.clone() {
                let center = (column * one + one / 2, row * one + one / 2);
                let w: [i64; 3] = std::array::from_fn(|i| edge(ends[i].0, ends[i].1, center));
                if (0..3).any(|i| w[i] + bias[i] < 0) {
                    continue;
                }
                let share = w.map(|w| w as f32 * inverse);
                let nearness = share[0] * points[0].2 + share[1] * points[1].2 + share[2] * points[2].2;
                self.put(column as usize, (row - top) as usize, nearness, || {
                    // Colours are linear in space, not in the picture: weight by nearness and divide (Blinn 1992).
                    let weight: [f32; 3] = std::array::from_fn(|i| {
                        if lens.is_perspective { share[i] * points[i].2 / nearness } else { share[i] }
                    });
                    std::array::from_fn(|c| (0..3).map(|i| weight[i] * v[i].color[c]).sum())
                });
            }
        }
    }

    pub(super) fn disc(&mut self, (x, y): (f64, f64), radius: f64, nearness: f32, color: [f32; 3]) {
        let top = self.top as f64;
        let first_row = (y - radius - top).floor().max(0.0) as usize;
        let last_row = ((y + radius - top).ceil().max(0.0) as usize).min(self.rows);
        for row in first_row..last_row {
            let dy = row as f64 + 0.5 + top - y;
            let half = (radius * radius - dy * dy).max(0.0).sqrt();
            let first = (x - half - 0.5).ceil().max(0.0) as usize;
            let last = ((x + half - 0.5).floor() + 1.0).clamp(0.0, self.columns as f64) as usize;
            for column in first..last {
                self.put(column, row, nearness, || color);
            }
        }
    }

    /// The mean of each pixel's samples, and the nearest of them.
    pub(super) fn resolved(self) -> (Vec<[u8; 3]>, Vec<f32>) {
        let (width, rows) = (self.columns / SAMPLES, self.rows / SAMPLES);
        let mut colors = Vec::with_capacity(width * rows);
        let mut nearness = Vec::with_capacity(width * rows);
        let count = (SAMPLES * SAMPLES) as u32;
        for y in 0..rows {
            for x in 0..width {
                let (mut sum, mut nearest) = ([0_u32; 3], f32::NEG_INFINITY);
                for row in y * SAMPLES..(y + 1) * SAMPLES {
                    let start = row * self.columns + x * SAMPLES;
                    for i in start..start + SAMPLES {
                        nearest = nearest.max(self.nearness[i]);
                        for (s, &c) in sum.iter_mut().zip(&self.colors[i]) {
                            *s += u32::from(c);
                        }
                    }
                }
                colors.push(sum.map(|s| ((s + count / 2) / count) as u8));
                nearness.push(nearest);
            }
        }
        (colors, nearness)
    }
}
