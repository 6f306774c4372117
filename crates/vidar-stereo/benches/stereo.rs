//! Time of one keyframe: `cargo bench -p vidar-stereo`.

#![allow(clippy::expect_used, reason = "a benchmark may stop at the first surprise")]

#[allow(dead_code, reason = "the benchmark needs no exact depth")]
#[path = "../tests/scene/mod.rs"]
mod scene;

use scene::{WALL, poses, views};
use vidar_stereo::{StereoConfig, StereoModel};

fn main() {
    divan::main();
}

/// One reference of 192 × 144 pixels with the estimates of the neighbours it is checked against.
#[divan::bench(sample_count = 10)]
fn one_reference_and_its_checks(bencher: divan::Bencher<'_, '_>) {
    let chunk = views(&WALL, &poses(), |_| (1.0, 0.0), 2.0);
    bencher
        .with_inputs(|| StereoModel::new(StereoConfig::default()).expect("valid"))
        .bench_local_values(|model| model.predict_with(&chunk, &[2], &|_| false).expect("has parallax"));
}
