//! Time of an overlap of 60 frames, of one iteration of the coupled graph, of a search among places.

#![allow(clippy::expect_used)] // a benchmark may stop at the first surprise, as a test may

use divan::Bencher;
use divan::counter::ItemsCount;
use nalgebra::Vector3;
use vidar_align::coupled::{CoupledConfig, solve};
use vidar_align::overlap::{OverlapConfig, SampledView, fit_overlap, pair_views, shared_views};
use vidar_align::place_recognition::PlaceIndex;
use vidar_core::{
    Confidence, FrameId, Image, LieGroup, Pinhole, RelativeDepth, Se3, Sim3, So3, Timestamp, ViewGeometry,
};

mod graph;
use graph::graph;

fn main() {
    divan::main();
}

/// Frames of a slow turn before a wavy wall, in a gauge.
fn views(count: u32, gauge: &Sim3) -> Vec<ViewGeometry> {
    let (w, h) = (504, 322);
    let intrinsics = Pinhole::new(420.0, 420.0, 251.5, 160.5, w, h).expect("valid intrinsics");
    (0..count)
        .map(|i| {
            let turn = So3::exp(&Vector3::new(0.0, 0.01 * f64::from(i), 0.0));
            let pose = Se3::new(turn, Vector3::new(0.05 * f64::from(i), 0.0, 0.0));
            let depth = Image::from_fn(w, h, |x, y| {
                let wave = (0.02 * x as f64 + 0.1 * f64::from(i)).sin() + (0.03 * y as f64).cos();
                ((3.0 + 0.6 * wave) / gauge.scale) as f32
            });
            ViewGeometry {
                frame_id: FrameId(i),
                chunk_from_camera: gauge.inverse().transform_pose(&pose),
                intrinsics,
                depth: RelativeDepth::new(depth),
                confidence: Confidence::full(w, h),
            }
        })
        .collect()
}

fn sampled(views: &[ViewGeometry]) -> Vec<SampledView> {
    views.iter().map(|v| SampledView::new(v, OverlapConfig::default().samples_per_view)).collect()
}

/// Both sides sampled from full depth, paired and fitted: 60 × 504 × 322.
#[divan::bench(sample_count = 15)]
fn overlap_of_sixty_frames(bencher: Bencher<'_, '_>) {
    let gauge = Sim3::new(So3::exp(&Vector3::new(0.1, 0.7, -0.2)), Vector3::new(1.0, 2.0, 3.0), 1.3)
        .expect("a similarity");
    let (earlier, later) = (views(60, &Sim3::IDENTITY), views(60, &gauge));
    let config = OverlapConfig::default();
    bencher.bench_local(|| {
        let (a, b) = (sampled(&earlier), sampled(&later));
        let pairs = pair_views(&shared_views(a.iter(), b.iter()), config.max_pairs);
        fit_overlap(&pairs, &config).expect("a fit")
    });
}

/// A whole solve; the items that are counted are its iterations.
#[divan::bench(sample_count = 15)]
fn graph_of_500_keyframes_per_iteration(bencher: Bencher<'_, '_>) {
    let (start, factors) = graph();
    let config = CoupledConfig { max_iterations: 4, tolerance: 0.0, ..Default::default() };
    let iterations = solve(&start, &factors, &config).expect("a solution").iterations;
    bencher
        .counter(ItemsCount::new(iterations))
        .bench_local(|| solve(&start, &factors, &config).expect("a solution"));
}

/// One query among 50 000 places of 512 numbers.
#[divan::bench(sample_count = 15)]
fn search_among_50_000_places(bencher: Bencher<'_, '_>) {
    let mut index = PlaceIndex::default();
    let place =
        |i: usize| -> Vec<f32> { (0..512).map(|k| ((i * 7 + k * 13) as f32 * 0.37).sin() / 16.0).collect() };
    (0..50_000).for_each(|i| {
        index.add(FrameId(i as u32), Timestamp::from_nanos(i as i64), i as f64, &place(i % 997));
    });
    let query = place(123);
    bencher.bench_local(|| index.search(Timestamp::from_nanos(i64::MAX / 2), 1e9, &query, 5, 10.0, 3.0));
}
