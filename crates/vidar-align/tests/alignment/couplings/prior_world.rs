//! Chunks in the world of their pose priors.

use crate::flat::*;
use nalgebra::Vector3;
use vidar_align::aligner::{DepthPoint, RejectionReason};
use vidar_align::streaming::chunk_ranges;
use vidar_align::{Aligner, AlignerConfig, ChunkStatus, CouplingMode, Placement};
use vidar_core::model::ChunkFrame;
use vidar_core::{
    FrameId, GeometryPrediction, Image, LieGroup, RelativeDepth, Se3, Sim3, So3, SparseLandmark,
};

/// What a small network that was given the poses may say: too near by a fifth, and bent its own way in each view.
fn rough(truth: &[Se3], range: std::ops::Range<usize>, id: u32, noise: &mut Noise) -> GeometryPrediction {
    let mut prediction = predict(truth, range, id, Model { has_gauge: false, ..EXACT }, noise);
    prediction.frame = ChunkFrame::PriorWorld;
    for view in &mut prediction.views {
        let (offset, across, down) = (0.08 * noise.normal(), 0.25 * noise.normal(), 0.25 * noise.normal());
        let exact = view.depth.image().clone();
        let bent = Image::from_fn(WIDTH, HEIGHT, |x, y| {
            let (x_share, y_share) = (x as f64 / WIDTH as f64 - 0.5, y as f64 / HEIGHT as f64 - 0.5);
            let off = (-0.22 + offset + across * x_share + down * y_share).exp();
            (f64::from(exact[(x, y)]) * off) as f32
        });
        view.depth = RelativeDepth::new(bent);
    }
    prediction
}

/// Middle of |ln| of depth over truth, of a run of rough predictions; landmarks in every `step`-th frame.
fn rough_run(step: usize) -> (f64, Placement) {
    rough_run_sharing(step, 0.0)
}

/// A landmark as a point without a track.
fn untracked(landmark: SparseLandmark) -> DepthPoint {
    let SparseLandmark { id, pixel, inverse_depth, inverse_depth_std } = landmark;
    DepthPoint { number: id.0, pixel, inverse_depth, inverse_depth_std }
}

/// The same with points that have an error in common, where it is above 0.
fn rough_run_sharing(step: usize, shared_std: f64) -> (f64, Placement) {
    let truth = laps(36, 0.7);
    let (mut noise, mut points) = (Noise::new(21), Noise::new(22));
    let mut aligner = Aligner::new(CouplingMode::Coupled, &AlignerConfig::default()).unwrap();
    let mut predictions = Vec::new();
    for (k, range) in chunk_ranges(36, 12, 4).unwrap().into_iter().enumerate() {
        let prediction = rough(&truth, range.frames.clone(), k as u32, &mut noise);
        predictions.push(prediction.clone());
        let seen: Vec<_> = range
            .frames
            .map(|i| {
                let count = if i % step == 0 { 50 } else { 0 };
                (i, landmarks(&truth[i], i, count, 0.02, 0.05, &mut points))
            })
            .collect();
        let of = |i: usize| seen.iter().find(|s| s.0 == i).map_or(Vec::new(), |s| s.1.clone());
        let mut observation = observe(prediction, Some(&truth), of);
        if shared_std > 0.0 {
            for frame in &mut observation.frames {
                frame.points = frame.landmarks.drain(..).map(untracked).collect();
                frame.shared_point_std = shared_std;
            }
        }
        aligner.push(observation).unwrap();
    }
    let placement = aligner.finish();
    let mut off: Vec<f64> = Vec::new();
    for prediction in predictions {
        for view in placement.aligned_views(prediction, &[]).unwrap() {
            let exact = depth(&truth[view.frame_id().index()]);
            let ratios = view.depth().image().data().iter().zip(exact.data()).map(|(d, z)| f64::from(d / z));
            off.extend(ratios.map(|r| r.ln().abs()));
        }
    }
    off.sort_by(f64::total_cmp);
    (off[off.len() / 2], placement)
}

#[test]
fn a_rough_depth_in_the_world_of_its_priors_is_scaled_to_landmarks_and_its_poses_stay() {
    let (error, placement) = rough_run(1);
    assert_eq!(placement.rejections.of(RejectionReason::DepthRescaled), placement.chunks.len());
    assert_eq!(
        placement.rejections.of(RejectionReason::OdometryDownweighted)
            + placement.rejections.of(RejectionReason::InconsistentChunk),
        0
    );
    assert_eq!(placement.views.len(), 36);
    let moved = absolute_error(&placement, &laps(36, 0.7));
    assert!(moved < 0.02, "{moved}");
    // Uncorrected it is off by more than a fifth.
    assert!(error < 0.04, "{error}");
}

/// Chunks with true poses given, every other one seen at `factor` times its size.
fn with_given_poses(mode: CouplingMode, factor: f32) -> Placement {
    let truth = laps(36, 0.7);
    let mut noise = Noise::new(31);
    let mut aligner = Aligner::new(mode, &AlignerConfig::default()).unwrap();
    for (k, range) in chunk_ranges(36, 12, 4).unwrap().into_iter().enumerate() {
        let model = Model { has_gauge: false, ..EXACT };
        let mut prediction = predict(&truth, range.frames, k as u32, model, &mut noise);
        prediction.frame = ChunkFrame::PriorWorld;
        let seen = if k % 2 == 1 { factor } else { 1.0 };
        for view in &mut prediction.views {
            view.depth = RelativeDepth::new(view.depth.image().map(|z| z * seen));
        }
        aligner.push(observe(prediction, Some(&truth), none)).unwrap();
    }
    aligner.finish()
}

#[test]
fn chunks_in_the_world_of_their_priors_keep_their_scale_whatever_the_scale_of_their_overlap() {
    let placement = with_given_poses(CouplingMode::PoseConditioned, 0.67);
    assert!(placement.rejections.of(RejectionReason::ScaleOutOfRange) >= 2, "{:?}", placement.rejections);
    for chunk in &placement.chunks {
        assert!((chunk.world_from_chunk.scale - 1.0).abs() < 1e-12, "{}", chunk.world_from_chunk.scale);
    }
}

#[test]
fn given_poses_do_not_make_a_depth_metric_that_its_neighbours_contradict() {
    for mode in [CouplingMode::PoseConditioned, CouplingMode::Coupled] {
        let known_to = |factor: f32| {
            let chunks = with_given_poses(mode, factor).chunks;
            chunks.iter().map(|c| c.log_scale_std).fold(0.0, f64::max)
        };
        assert!(known_to(1.0) < 0.006, "{mode}: {}", known_to(1.0));
        assert!(known_to(0.8) > 0.05, "{mode}: {}", known_to(0.8));
    }
}

#[test]
fn no_number_of_landmarks_lowers_sigma_below_their_shared_error() {
    let (alone, shared) = (rough_run(1).1, rough_run_sharing(1, 0.02).1);
    for (alone, shared) in alone.chunks.iter().zip(&shared.chunks) {
        assert!(alone.log_scale_std < 0.01, "{}", alone.log_scale_std);
        assert!((shared.log_scale_std - alone.log_scale_std.hypot(0.02)).abs() < 1e-12);
        // It is known of, not acted on.
        assert_eq!(alone.world_from_chunk, shared.world_from_chunk);
    }
}

#[test]
fn views_without_landmarks_are_corrected_by_their_neighbours() {
    let (error, placement) = rough_run(3);
    assert!(placement.views.iter().all(|v| v.field.is_some()));
    assert!(error < 0.06, "{error}");
}

#[test]
fn a_chunk_in_the_world_of_its_priors_keeps_its_metres_though_its_cameras_are_beside_them() {
    // As where the trajectory is of another sensor of the rig: every camera 3 cm beside its pose prior, on a short path.
    let truth = laps(120, 0.5);
    let beside = Se3::new(So3::IDENTITY, Vector3::new(-0.025, 0.012, 0.01));
    let priors: Vec<Se3> = truth.iter().map(|t| *t * beside).collect();
    let mut aligner = Aligner::new(CouplingMode::Coupled, &AlignerConfig::default()).unwrap();
    for (k, start) in [0, 12, 24].into_iter().enumerate() {
        let mut noise = Noise::new(3);
        let mut prediction = predict(&truth, start..start + 12, k as u32, EXACT, &mut noise);
        prediction.frame = ChunkFrame::PriorWorld;
        for view in &mut prediction.views {
            let pose = truth[view.frame_id.index()];
            view.chunk_from_camera = pose;
            view.depth = RelativeDepth::new(depth(&pose));
        }
        aligner.push(observe(prediction, Some(&priors), none)).unwrap();
    }
    let placement = aligner.finish();
    assert_eq!(placement.views.len(), 36);
    for chunk in &placement.chunks {
        assert!((chunk.world_from_chunk.scale.ln()).abs() < 2e-3, "{:?}", chunk.world_from_chunk);
        assert!(chunk.log_scale_std < 0.006, "{}", chunk.log_scale_std);
    }
}

#[test]
fn a_chunk_in_the_world_of_its_priors_is_checked_against_them_and_not_moved() {
    let truth = laps(12, 0.2);
    let far: Vec<Se3> = truth.iter().map(|t| Se3::from_translation(Vector3::x() * 2.0) * *t).collect();
    for (priors, expected) in [(&truth, ChunkStatus::PriorWorld), (&far, ChunkStatus::Inconsistent)] {
        let model = Model { has_gauge: false, ..EXACT };
        let mut prediction = predict(&truth, 0..12, 0, model, &mut Noise::new(1));
        prediction.frame = ChunkFrame::PriorWorld;
        let mut aligner = Aligner::new(CouplingMode::PoseConditioned, &AlignerConfig::default()).unwrap();
        let report = aligner.push(observe(prediction, Some(priors), none)).unwrap();
        assert_eq!(report.status, expected);
        assert_eq!(report.world_from_chunk, Some(Sim3::IDENTITY));
    }
}

#[test]
fn what_images_changed_of_given_poses_is_told_as_a_share_of_their_path() {
    let truth = laps(24, 0.2);
    for sigma in [0.0, 0.002, 0.02] {
        let mut noise = Noise::new(5);
        let given: Vec<Se3> = truth.iter().map(|t| *t * Se3::from_translation(noise.vector(sigma))).collect();
        let mut aligner = Aligner::new(CouplingMode::GroundTruth, &AlignerConfig::default()).unwrap();
        let ranges = [0..12, 12..24];
        for (id, range) in ranges.iter().enumerate() {
            let model = Model { has_gauge: false, ..EXACT };
            let mut prediction = predict(&truth, range.clone(), id as u32, model, &mut noise);
            prediction.frame = ChunkFrame::PriorWorld;
            aligner.push(observe(prediction, Some(&given), none)).unwrap();
        }
        let correction = aligner.finish().drift.pose_correction.unwrap();
        let expected = 3f64.sqrt() * sigma;
        let off = (correction.center_rms_m - expected).abs();
        assert!(off <= 0.2 * expected + 1e-12, "{correction:?}, expected {expected}");
        let radius = |range: &std::ops::Range<usize>| {
            let centres = given[range.clone()].iter().map(|p| p.translation);
            let mean = centres.clone().sum::<Vector3<f64>>() / range.len() as f64;
            (centres.map(|c| (c - mean).norm_squared()).sum::<f64>() / range.len() as f64).sqrt()
        };
        let share = correction.center_rms_m / radius(&ranges[0]).min(radius(&ranges[1]));
        assert!(
            correction.center_share <= 1.3 * share + 1e-12 && correction.center_share >= 0.5 * share,
            "{correction:?}, {share}"
        );
        assert!((correction.log_scale_std - correction.center_share / 2f64.sqrt()).abs() < 1e-12);
        assert!(correction.rotation_rms_rad < 1e-9);
    }
}

/// As a start whose scale is settled late: what came before was told at half the size, turned and elsewhere.
fn settled_late(mode: CouplingMode, frame: ChunkFrame) -> Placement {
    let truth = laps(36, 0.7);
    let (mut noise, mut points) = (Noise::new(41), Noise::new(42));
    let told_from_true =
        Sim3::new(So3::exp(&(Vector3::z() * 0.4)), Vector3::new(1.0, -2.0, 0.3), 0.5).unwrap();
    let told: Vec<Se3> = truth.iter().map(|t| told_from_true.transform_pose(t)).collect();
    let has_gauge = frame == ChunkFrame::ModelNative;
    let mut aligner = Aligner::new(mode, &AlignerConfig::default()).unwrap();
    let ranges: Vec<_> = chunk_ranges(36, 12, 4).unwrap();
    for (k, range) in ranges.into_iter().enumerate() {
        let is_told = k < 2;
        let model = Model { has_gauge, ..EXACT };
        let mut prediction = predict(&truth, range.frames.clone(), k as u32, model, &mut noise);
        prediction.frame = frame;
        let seen: Vec<Vec<SparseLandmark>> =
            (0..36).map(|i| landmarks(&truth[i], i, 50, 0.002, 0.0, &mut points)).collect();
        let of = |i: usize| -> Vec<SparseLandmark> {
            let scale = if is_told { told_from_true.scale } else { 1.0 };
            let told = |l: &SparseLandmark| SparseLandmark {
                inverse_depth: l.inverse_depth / scale,
                inverse_depth_std: l.inverse_depth_std / scale,
                ..*l
            };
            seen[i].iter().map(told).collect()
        };
        if is_told && !has_gauge {
            for view in &mut prediction.views {
                view.chunk_from_camera = told[view.frame_id.index()];
                view.depth = RelativeDepth::new(view.depth.image().map(|z| z * told_from_true.scale as f32));
            }
        }
        aligner.push(observe(prediction, Some(if is_told { &told } else { &truth }), of)).unwrap();
        if k == 1 {
            let before = aligner.provisional_placement();
            assert!(absolute_error(&before, &truth) > 0.3);
            let poses: Vec<_> = (0..36).map(|i| (FrameId(i), truth[i as usize])).collect();
            aligner.revise(&poses);
            let after = absolute_error(&aligner.provisional_placement(), &truth);
            assert!(after < 2e-3, "{mode}: {after}");
        }
    }
    aligner.finish()
}

#[test]
fn chunks_move_with_the_cameras_whose_scale_is_settled_later() {
    let truth = laps(36, 0.7);
    for mode in [CouplingMode::PoseConditioned, CouplingMode::Hybrid, CouplingMode::Coupled] {
        for frame in [ChunkFrame::PriorWorld, ChunkFrame::ModelNative] {
            // A chain knows nothing of the world of the priors.
            if (mode, frame) == (CouplingMode::Hybrid, ChunkFrame::PriorWorld) {
                continue;
            }
            let placement = settled_late(mode, frame);
            assert!(placement.chunks.iter().all(|c| c.status.is_usable()), "{mode}: {:?}", placement.chunks);
            let error = absolute_error(&placement, &truth);
            assert!(error < 2e-3, "{mode} {frame:?}: {error}");
            if frame == ChunkFrame::PriorWorld {
                let scales: Vec<f64> = placement.chunks.iter().map(|c| c.world_from_chunk.scale).collect();
                for (k, scale) in scales.iter().enumerate() {
                    let expected = if k < 2 { 2.0 } else { 1.0f64 };
                    assert!((scale / expected).ln().abs() < 2e-3, "{mode}: {scales:?}");
                }
            }
        }
    }
}
