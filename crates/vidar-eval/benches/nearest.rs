//! Nearest neighbours on a surface: our index against kiddo's, one hundred thousand points to as many.
//!
//! `cargo bench -p vidar-eval --bench nearest`; the comparison with SciPy and Open3D is `bench/nn_vs_scipy.py`.

#![allow(clippy::unwrap_used)] // a benchmark may stop at the first surprise, as a test may

use divan::{Bencher, black_box};
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use rayon::prelude::*;
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

#[divan::bench]
fn kiddo_build(bencher: Bencher<'_, '_>) {
    let points = surface(1, COUNT);
    bencher.bench(|| ImmutableKdTree::<f32, 3>::new_from_slice(black_box(&points)).unwrap());
}

#[divan::bench]
fn kiddo_query(bencher: Bencher<'_, '_>) {
    let tree: ImmutableKdTree<f32, 3> = ImmutableKdTree::new_from_slice(&surface(1, COUNT)).unwrap();
    let queries = surface(2, COUNT);
    bencher.bench(|| -> f32 {
        black_box(&queries)
            .par_iter()
            .map(|q| tree.query(q).nearest_one::<SquaredEuclidean<f32>>().execute().distance.sqrt())
            .sum()
    });
}
