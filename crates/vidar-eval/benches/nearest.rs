//! Nearest neighbours on a surface: one hundred thousand points to as many.
//!
//! `cargo bench -p vidar-eval --bench nearest`; the comparison with SciPy and Open3D is `bench/nn_vs_scipy.py`.

#![allow(clippy::unwrap_used)] // a benchmark may stop at the first surprise, as a test may

use divan::{Bencher, black_box};
use vidar_eval::{NearestIndex, nearest_distances};

fn main() {
    divan::main();
}

/// A rippled sheet of 8 m × 8 m, as a map's surface is: two dimensions in three, no two coordinates equal.
fn surface(seed: u64, count: usize) -> Vec<[f32; 3]> {
    let mut state = seed;
    let mut next = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1 << 24) as f32
    };
    let ripple = |x: f32, y: f32, noise: f32| 0.3 * (2.0 * x).sin() + 0.2 * (3.0 * y).cos() + 0.01 * noise;
    (0..count)
        .map(|_| {
            let (x, y) = (8.0 * next(), 8.0 * next());
            [x, y, ripple(x, y, next())]
        })
        .collect()
}

const COUNT: usize = 100_000;

#[divan::bench]
fn build(bencher: Bencher<'_, '_>) {
    let points = surface(1, COUNT);
    bencher.bench(|| NearestIndex::build(black_box(&points)));
}

#[divan::bench]
fn query(bencher: Bencher<'_, '_>) {
    let index = NearestIndex::build(&surface(1, COUNT)).unwrap();
    let queries = surface(2, COUNT);
    bencher.bench(|| nearest_distances(black_box(&queries), &index, None));
}

/// The same without the Morton order: what the order of the queries is worth.
#[divan::bench]
fn query_as_given(bencher: Bencher<'_, '_>) {
    let index = NearestIndex::build(&surface(1, COUNT)).unwrap();
    let queries = surface(2, COUNT);
    let answer = |q: &[f32; 3]| index.nearest(q, None).map_or(0.0, |n| n.distance_m);
    bencher.bench(|| black_box(&queries).iter().map(answer).sum::<f64>());
}
