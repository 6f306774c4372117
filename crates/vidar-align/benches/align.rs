//! Time of an overlap of 60 frames, of one iteration of the coupled graph, of a search among places.

#![allow(clippy::expect_used)] // a benchmark may stop at the first surprise, as a test may

use divan::Bencher;
use divan::counter::ItemsCount;
use nalgebra::{Matrix6, Vector3, Vector6};
use vidar_align::coupled::{
    Attachment, CoupledConfig, CoupledState, Factor, Kernel, RelativeChunk, inflation, solve,
};
use vidar_align::overlap::{OverlapConfig, SampledView, fit_overlap, pair_views, shared_views};
use vidar_align::place_recognition::PlaceIndex;
use vidar_core::{
    Confidence, FrameId, Image, LieGroup, Pinhole, RelativeDepth, Se3, Sim3, So3, Timestamp, ViewGeometry,
};

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

/// 500 keyframes, 25 chunks that overlap by 5, 16 loops.
fn graph() -> (CoupledState, Vec<Factor>) {
    let (n, chunks) = (500_usize, 25_usize);
    let truth: Vec<Se3> = (0..n)
        .map(|i| {
            let a = 6.0 * std::f64::consts::TAU * i as f64 / n as f64;
            let turn =
                So3::from_axis_angle(&Vector3::z(), a) * So3::exp(&Vector3::new(0.1 * a.sin(), 0.2, 0.0));
            Se3::new(turn, Vector3::new(3.0 * a.cos(), 3.0 * a.sin(), 0.3 * (2.0 * a).sin()))
        })
        .collect();
    let wave = |i: usize, k: f64| (i as f64 * k).sin();
    let bent = |i: usize| truth[i].plus(&Vector6::from_fn(|r, _| 0.004 * wave(i, 12.9898 + r as f64)));
    let gauges: Vec<Sim3> = (0..chunks)
        .map(|k| {
            let turn = So3::exp(&Vector3::new(wave(k, 3.1), wave(k, 5.3), wave(k, 7.7)));
            Sim3::new(turn, Vector3::new(wave(k, 1.3), wave(k, 2.9), 0.5), (0.3 * wave(k, 9.1)).exp())
                .expect("a similarity")
        })
        .collect();
    let mut factors = vec![Factor::Anchor {
        i: 0,
        world_from_camera: truth[0],
        position_std_m: 1e-3,
        heading_std_rad: 1e-3,
    }];
    for i in 1..n {
        let whitening = Box::new(Matrix6::identity() * 300.0);
        factors.push(Factor::Odometry {
            i: i - 1,
            j: i,
            i_from_j: bent(i - 1).inverse() * bent(i),
            whitening,
        });
    }
    for (k, gauge) in gauges.iter().enumerate() {
        for i in (k * 20)..(k * 20 + 25).min(n) {
            factors.push(Factor::Attachment(Attachment {
                i,
                k,
                chunk_from_camera: gauge.inverse().transform_pose(&truth[i]),
                rotation_std_rad: inflation(25) * 0.008,
                position_std_m: inflation(25) * 0.012,
                kernel: Kernel::Cauchy { k: 3.0 },
                moves_keyframe: true,
            }));
        }
        let link = |l: usize, kernel| {
            let relative = gauges[l].inverse() * *gauge;
            Factor::Relative(RelativeChunk::from_stds(k, l, relative, [0.02, 0.05, 0.015], kernel))
        };
        if k > 0 {
            factors.push(link(k - 1, Kernel::Cauchy { k: 3.0 }));
        }
        if k >= 9 {
            factors.push(link(k - 8, Kernel::GemanMcClure { k: 4.0 }));
        }
    }
    let start = CoupledState { keyframes: (0..n).map(bent).collect(), chunks: gauges };
    (start, factors)
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
