//! The position embedding that the DualDPT head adds to its maps.
//!
//! A cell's place (u, v) lies on a picture whose half diagonal is 1: `u = ±(a/d)(w−1)/w` at the first and last column
//! with aspect a = W/H and `d = √(a²+1)`, `v` likewise with `1/d`. Each coordinate becomes sines and cosines of
//! frequencies `100^(−j/Q)`, Q a quarter of the channels: `[sin u, cos u, sin v, cos v]`, times 0.1.

use super::map::Map;
use rayon::prelude::*;

const BASE: f64 = 100.0;
const RATIO: f64 = 0.1;

/// The embedding of maps of one size, as its two separable halves.
#[derive(Debug)]
pub(crate) struct Uv {
    /// `[columns, channels/2]`.
    across: Vec<f32>,
    /// `[rows, channels/2]`.
    down: Vec<f32>,
    half: usize,
}

impl Uv {
    /// For maps of `rows` × `columns` × `channels` of a picture with aspect `width / height`.
    pub fn new(rows: usize, columns: usize, channels: usize, aspect: f64) -> Self {
        let diagonal = (aspect * aspect + 1.0).sqrt();
        Self {
            across: waves(&line(columns, aspect / diagonal), channels),
            down: waves(&line(rows, 1.0 / diagonal), channels),
            half: channels / 2,
        }
    }

    /// Adds it to a map of that size.
    pub fn add_to(&self, map: &mut Map) {
        if self.half == 0 || map.data.is_empty() {
            return;
        }
        let line = map.columns * map.channels;
        map.data.par_chunks_mut(line).zip(self.down.par_chunks(self.half)).for_each(|(row, down)| {
            for (pixel, across) in
                row.chunks_exact_mut(2 * self.half).zip(self.across.chunks_exact(self.half))
            {
                let (first, second) = pixel.split_at_mut(self.half);
                first.iter_mut().zip(across).for_each(|(x, e)| *x += e);
                second.iter_mut().zip(down).for_each(|(x, e)| *x += e);
            }
        });
    }
}

/// `count` places from `−side·(n−1)/n` to the opposite of it.
fn line(count: usize, side: f64) -> Vec<f64> {
    let end = side * (count as f64 - 1.0) / count as f64;
    let step = if count > 1 { 2.0 * end / (count - 1) as f64 } else { 0.0 };
    (0..count).map(|i| i as f64 * step - end).collect()
}

fn waves(places: &[f64], channels: usize) -> Vec<f32> {
    let quarter = channels / 4;
    let frequencies: Vec<f64> = (0..quarter).map(|j| BASE.powf(-(j as f64) / quarter as f64)).collect();
    let scaled = |value: f64| (RATIO * value) as f32;
    places
        .iter()
        .flat_map(|p| {
            let sines = frequencies.iter().map(move |f| scaled((p * f).sin()));
            sines.chain(frequencies.iter().map(move |f| scaled((p * f).cos())))
        })
        .collect()
}
