//! The position embedding that the DualDPT head adds to its maps.
//!
//! A cell's position (u, v) lies on an image whose half diagonal is 1: `u = ±(a/d)(w−1)/w` at the first and last column
//! with aspect a = W/H and `d = √(a²+1)`, `v` likewise with `1/d`. Each coordinate becomes sines and cosines of
//! frequencies `100^(−j/Q)`, Q a quarter of the channels: `[sin u, cos u, sin v, cos v]`, times 0.1.

use vidar_nn::GridEmbedding;

const BASE: f64 = 100.0;
const RATIO: f64 = 0.1;

/// The embedding of maps of `rows` × `columns` × `channels` of an image with aspect `width / height`, as its two
/// separable halves.
pub(crate) fn embedding(rows: usize, columns: usize, channels: usize, aspect: f64) -> GridEmbedding {
    let diagonal = (aspect * aspect + 1.0).sqrt();
    GridEmbedding {
        by_col: waves(&line(columns, aspect / diagonal), channels),
        by_row: waves(&line(rows, 1.0 / diagonal), channels),
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
