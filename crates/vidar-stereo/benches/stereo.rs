//! Time of one keyframe: `cargo bench -p vidar-stereo`.

#![allow(clippy::expect_used, reason = "a benchmark may stop at the first surprise")]

#[allow(dead_code, reason = "the benchmark needs no exact depth")]
#[path = "../tests/depth/scene/mod.rs"]
mod scene;

use scene::{WALL, poses, views};
use vidar_core::{AlignedView, Confidence, FrameId, Image, MetricDepth, Pinhole, Se3, Timestamp};
use vidar_stereo::complete::{Evidence, Spread, complete};
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

/// A view of 480 × 320 pixels, a fine checkerboard of blank and textured squares with stereo on the textured ones.
#[divan::bench(args = [false, true])]
fn completion_of_one_view(bencher: divan::Bencher<'_, '_>, with_network: bool) {
    let (width, height) = (480, 320);
    let k = Pinhole::new(400.0, 400.0, 239.5, 159.5, width, height).expect("valid");
    let is_blank = |x: usize, y: usize| (x / 60 + y / 60).is_multiple_of(2);
    let depth = |x: usize, y: usize| 2.0 + 0.001 * x as f32 + 0.3 * (y as f32 / 40.0).sin();
    let known = |x, y| if is_blank(x, y) { f32::NAN } else { depth(x, y) };
    let texture = |x: usize, y: usize| if is_blank(x, y) { 128 } else { (x * 7919 + y * 104_729) as u8 };
    let view = AlignedView::new(
        FrameId(0),
        Timestamp::default(),
        Se3::IDENTITY,
        k,
        MetricDepth::new(Image::from_fn(width, height, known)),
        Confidence::full(width, height),
    );
    let color = Image::from_fn(width, height, |x, y| [texture(x, y); 3]);
    let view = view.and_then(|v| v.with_color(color)).expect("one size");
    let (map, shape) = (Image::filled(width, height, f32::NAN), Image::from_fn(width, height, depth));
    let evidence = Evidence { map: &map, network: with_network.then_some(&shape) };
    let spread = Spread::default();
    bencher.bench_local(|| complete(&view, &evidence, &spread).expect("one size"));
}
