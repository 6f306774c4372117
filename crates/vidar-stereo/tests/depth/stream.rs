//! Chunks of a stream: requested views only, and poses corrected by the images.

use crate::scene::{Scene, WALL, depth, views};
use nalgebra::Vector3;
use std::ops::Range;
use std::sync::atomic::{AtomicUsize, Ordering};
use vidar_core::{
    ChunkId, ChunkViews, FrameId, GeometryModel, LieGroup, ModelError, Se3, So3, Timestamp, ViewGeometry,
};
use vidar_stereo::{StereoConfig, StereoModel};

fn model() -> StereoModel {
    StereoModel::new(StereoConfig::default()).expect("defaults are valid")
}

fn boxed() -> Scene {
    Scene { board: Some((0.45, 1.9)), ..WALL }
}

/// A flight to the side with a little weave.
fn flight(count: usize) -> Vec<Se3> {
    (0..count)
        .map(|i| {
            let x = 0.14 * (i as f64 - 0.5 * count as f64);
            let y = 0.05 * (1.3 * i as f64).sin();
            Se3::new(So3::exp(&Vector3::new(0.02 * y, -0.05 * x, 0.0)), Vector3::new(x, y, 0.0))
        })
        .collect()
}

fn part(all: &ChunkViews, range: Range<usize>) -> ChunkViews {
    ChunkViews { id: ChunkId(range.start as u32), views: all.views[range].to_vec() }
}

fn bits(views: &[ViewGeometry]) -> Vec<u32> {
    let of = |v: &ViewGeometry| -> Vec<u32> {
        let pose = v.chunk_from_camera.matrix().map(|m| m as f32);
        let values = v.depth.image().data().iter().chain(v.confidence.image().data());
        values.chain(pose.iter()).map(|z| z.to_bits()).collect()
    };
    views.iter().flat_map(of).collect()
}

fn ids(views: &[ViewGeometry]) -> Vec<u32> {
    views.iter().map(|v| v.frame_id.0).collect()
}

/// Predicts, and counts the polls of `cancel`: one before each unit of work.
fn counted(
    model: &mut StereoModel,
    chunk: &ChunkViews,
    requested: Range<usize>,
) -> (Vec<ViewGeometry>, usize) {
    let polls = AtomicUsize::new(0);
    let cancel = |_| {
        polls.fetch_add(1, Ordering::Relaxed);
        false
    };
    let prediction = model.predict_views(chunk, requested, &cancel).expect("has parallax");
    (prediction.views, polls.into_inner())
}

#[test]
fn only_requested_views_are_returned_and_few_context_views_are_estimated() {
    let all = views(&boxed(), &flight(12), |_| (1.0, 0.0), 2.0);
    let (found, work) = counted(&mut model(), &all, 3..5);
    assert_eq!(ids(&found), [3, 4]);
    // Twelve probes, the two requested, and two or three more for each to be checked against.
    assert!((12 + 4..=12 + 8).contains(&work), "{work}");
}

#[test]
fn a_prediction_does_not_depend_on_earlier_calls() {
    let all = views(&boxed(), &flight(12), |_| (1.0, 0.0), 2.0);
    let mut streaming = model();
    counted(&mut streaming, &part(&all, 0..8), 0..5);
    let (after, _) = counted(&mut streaming, &part(&all, 4..12), 1..6);
    let (alone, _) = counted(&mut model(), &part(&all, 4..12), 1..6);
    assert_eq!(ids(&after), [5, 6, 7, 8, 9]);
    assert!(bits(&after) == bits(&alone));
    // And once more the chunk before, on one thread.
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("pool");
    let before = pool.install(|| counted(&mut streaming, &part(&all, 0..8), 0..5).0);
    assert!(bits(&before) == bits(&counted(&mut model(), &part(&all, 0..8), 0..5).0));
}

#[test]
fn a_model_keeps_no_state_between_calls() {
    // The same call twice, and the whole chunk in between: the model keeps no state.
    let all = views(&boxed(), &flight(6), |_| (1.0, 0.0), 2.0);
    let mut used = model();
    let first = used.predict_views(&all, 2..3, &|_| false).expect("has parallax");
    used.predict(&all).expect("has parallax");
    let again = used.predict_views(&all, 2..3, &|_| false).expect("has parallax");
    assert!(bits(&first.views) == bits(&again.views));
}

#[test]
fn requested_views_without_parallax_are_omitted_and_cancelling_works() {
    let turns: Vec<Se3> = (0..4)
        .map(|i| Se3::new(So3::exp(&Vector3::new(0.0, 0.05 * i as f64, 0.0)), Vector3::zeros()))
        .collect();
    let chunk = views(&WALL, &turns, |_| (1.0, 0.0), 0.0);
    let prediction = model().predict_views(&chunk, 1..3, &|_| false).expect("no depth is not an error here");
    assert!(prediction.views.is_empty());
    let chunk = views(&WALL, &flight(4), |_| (1.0, 0.0), 0.0);
    assert!(matches!(model().predict_views(&chunk, 1..3, &|_| true), Err(ModelError::Cancelled)));
    // Also in the middle of the work.
    let polls = AtomicUsize::new(0);
    let late = |_| polls.fetch_add(1, Ordering::Relaxed) > 5;
    assert!(matches!(model().predict_views(&chunk, 0..4, &late), Err(ModelError::Cancelled)));
}

/// Share of pixels within 2 % of the truth.
fn right(scene: &Scene, truth_pose: &Se3, view: &ViewGeometry) -> f64 {
    let truth = depth(scene, truth_pose);
    let near = |(z, t): &(&f32, &f32)| ((**z - **t) / **t).abs() < 0.02;
    let right = view.depth.image().data().iter().zip(truth.data()).filter(near).count();
    right as f64 / truth.data().len() as f64
}

#[test]
fn noisy_poses_are_corrected_by_the_images() {
    let true_poses = flight(9);
    let mut chunk = views(&boxed(), &true_poses, |_| (1.0, 0.0), 2.0);
    for (i, view) in chunk.views.iter_mut().enumerate() {
        // Some 5 mm and a quarter of a degree, to and fro.
        let (a, b) = ((2.1 * i as f64).sin(), (3.7 * i as f64 + 1.0).sin());
        let jitter = Se3::new(
            So3::exp(&Vector3::new(0.004 * a, 0.004 * b, -0.003 * a)),
            Vector3::new(0.0, 0.005 * b, 0.0),
        );
        view.world_from_camera = Some(true_poses[i] * jitter);
        view.time = Timestamp::from_nanos(i as i64 * 50_000_000);
    }
    let taken_as_given = StereoConfig { pose_std_deg: 0.0, ..StereoConfig::default() };
    let score = |config: StereoConfig| {
        let mut model = StereoModel::new(config).expect("valid");
        let found = model.predict_views(&chunk, 4..5, &|_| false).expect("has parallax");
        assert_eq!(found.views[0].frame_id, FrameId(4));
        right(&boxed(), &true_poses[4], &found.views[0])
    };
    let (given, corrected) = (score(taken_as_given), score(StereoConfig::default()));
    assert!(corrected > 0.6 && corrected > given + 0.1, "as given {given:.3}, corrected {corrected:.3}");
}
