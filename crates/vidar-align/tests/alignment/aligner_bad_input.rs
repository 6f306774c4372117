//! Bad input is counted, left out, and does not change the rest.

use crate::flat::*;
use nalgebra::Vector3;
use vidar_align::aligner::RejectionReason;
use vidar_align::streaming::chunk_ranges;
use vidar_align::{Aligner, AlignerConfig, ChunkObservation, ChunkStatus, CouplingMode, Placement};
use vidar_core::{ChunkId, GeometryPrediction, Image, LieGroup, RelativeDepth, Se3, Sim3, So3};

fn new_aligner(mode: CouplingMode) -> Aligner {
    Aligner::new(mode, &AlignerConfig::default()).unwrap()
}

/// Pushes all chunks of a flight, each changed by `corrupt`.
fn run(
    mode: CouplingMode,
    truth: &[Se3],
    odometry: &[Se3],
    overlap: usize,
    mut corrupt: impl FnMut(usize, &mut GeometryPrediction, &mut Noise),
) -> Placement {
    let mut noise = Noise::new(5);
    let mut aligner = new_aligner(mode);
    for (k, range) in chunk_ranges(truth.len(), 12, overlap).unwrap().into_iter().enumerate() {
        let mut prediction = predict(truth, range.frames, k as u32, REAL, &mut noise);
        corrupt(k, &mut prediction, &mut noise);
        aligner.push(observe(prediction, Some(odometry), none)).unwrap();
    }
    aligner.finish()
}

fn all_finite(placement: &Placement) -> bool {
    placement.views.iter().all(|v| v.world_from_camera.is_finite() && v.metres_per_unit.is_finite())
        && placement.chunks.iter().all(|c| c.world_from_chunk.is_finite())
}

fn set_depth(prediction: &mut GeometryPrediction, view: usize, mut f: impl FnMut(usize, usize) -> f32) {
    prediction.views[view].depth = RelativeDepth::new(Image::from_fn(WIDTH, HEIGHT, &mut f));
}

#[test]
fn views_that_are_not_finite_are_left_out_and_counted() {
    let truth = laps(40, 1.0);
    for mode in CouplingMode::ALL {
        let placement = run(mode, &truth, &truth, 4, |k, p, _| {
            if k == 1 {
                set_depth(p, 2, |_, _| f32::NAN);
                p.views[3].chunk_from_camera.translation.x = f64::INFINITY;
                let holed = p.views[5].depth.image().clone();
                set_depth(p, 5, |x, y| if (x + y) % 3 == 0 { f32::INFINITY } else { holed[(x, y)] });
                p.views[6].chunk_from_camera.translation.z = f64::NAN;
            }
        });
        assert_eq!(placement.rejections.of(RejectionReason::ViewNotFinite), 3, "{mode}");
        assert!(all_finite(&placement), "{mode}");
        if mode.uses_pose_priors() {
            assert!(
                absolute_error(&placement, &truth) < 0.06,
                "{mode}: {}",
                absolute_error(&placement, &truth)
            );
        }
        assert!(
            placement.view(vidar_core::FrameId(14)).is_none(),
            "{mode}: a view without depth is not placed"
        );
    }
}

fn make_inconsistent(prediction: &mut GeometryPrediction, noise: &mut Noise) {
    for view in 0..prediction.views.len() {
        set_depth(prediction, view, |_, _| (noise.normal().exp() * 2.0) as f32);
        prediction.views[view].chunk_from_camera = Se3::new(So3::exp(&noise.vector(1.5)), noise.vector(2.0));
    }
}

#[test]
fn an_inconsistent_chunk_is_left_out_and_the_others_are_placed() {
    let truth = laps(60, 1.0);
    for mode in [CouplingMode::Coupled, CouplingMode::Hybrid, CouplingMode::PoseConditioned] {
        let placement = run(mode, &truth, &truth, 4, |k, p, noise| {
            if k == 3 {
                make_inconsistent(p, noise);
            }
        });
        assert!(!placement.chunks[3].status.is_usable(), "{mode}: {:?}", placement.chunks[3]);
        assert!(placement.views.iter().all(|v| v.owner != ChunkId(3)), "{mode}");
        let error = absolute_error(&placement, &truth);
        assert!(error < 0.06, "{mode}: {error}");
        if mode == CouplingMode::Coupled {
            assert_eq!(placement.rejections.of(RejectionReason::InconsistentChunk), 1);
            // Its frames still have poses: odometry went on.
            assert!(placement.keyframes.iter().any(|k| k.frame_id.0 == 30));
        }
    }
    // Without pose priors the chunks after the gap have no place, and are reported so.
    let placement = run(CouplingMode::PoseFree, &truth, &truth, 4, |k, p, noise| {
        if k == 3 {
            make_inconsistent(p, noise);
        }
    });
    assert_eq!(placement.chunks[3].status, ChunkStatus::Rejected);
    assert!(placement.chunks[4..].iter().all(|c| c.status == ChunkStatus::Unplaced));
    assert!(all_finite(&placement) && placement.views.iter().all(|v| v.owner.0 < 3));
}

#[test]
fn chunks_that_share_nothing_are_placed_by_their_priors_or_not_at_all() {
    let truth = laps(48, 1.0);
    let coupled = run(CouplingMode::Coupled, &truth, &truth, 0, |_, _, _| {});
    assert_eq!(coupled.rejections.of(RejectionReason::NoOverlap), 3);
    assert_eq!(coupled.views.len(), 48);
    assert!(absolute_error(&coupled, &truth) < 0.05, "{}", absolute_error(&coupled, &truth));
    let hybrid = run(CouplingMode::Hybrid, &truth, &truth, 0, |_, _, _| {});
    assert!(hybrid.is_metric && absolute_error(&hybrid, &truth) < 0.1);
    let free = run(CouplingMode::PoseFree, &truth, &truth, 0, |_, _, _| {});
    assert_eq!(free.chunks.iter().filter(|c| c.status == ChunkStatus::Unplaced).count(), 3);
    assert_eq!(free.views.len(), 12);
}

#[test]
fn nothing_one_frame_and_one_chunk_are_answered() {
    let truth = laps(8, 0.2);
    let mut noise = Noise::new(1);
    for mode in CouplingMode::ALL {
        let nothing = new_aligner(mode).finish();
        assert!(nothing.views.is_empty() && nothing.chunks.is_empty());
        let mut one = new_aligner(mode);
        let report =
            one.push(observe(predict(&truth, 0..1, 0, REAL, &mut noise), Some(&truth), none)).unwrap();
        assert_eq!(report.chunk_id, ChunkId(0));
        assert!(all_finite(&one.finish()), "{mode}");
        let mut chunk = new_aligner(mode);
        chunk.push(observe(predict(&truth, 0..8, 0, REAL, &mut noise), Some(&truth), none)).unwrap();
        assert!(chunk.push(observe(predict(&truth, 0..8, 0, REAL, &mut noise), None, none)).is_err());
        let placement = chunk.finish();
        assert!(all_finite(&placement) && placement.views.len() == 8, "{mode}");
        let mut empty = new_aligner(mode);
        let mut prediction = predict(&truth, 0..3, 0, REAL, &mut noise);
        prediction.views.clear();
        let report = empty.push(ChunkObservation { prediction, frames: Vec::new() }).unwrap();
        assert_eq!(
            (report.status, report.rejections),
            (ChunkStatus::Rejected, vec![RejectionReason::InconsistentChunk])
        );
        assert!(empty.finish().views.is_empty());
    }
}

#[test]
fn a_straight_line_is_identity_in_the_papers_modes_and_a_map_in_the_coupled_one() {
    let truth: Vec<Se3> =
        (0..36).map(|i| look(Vector3::new(-2.0 + 0.1 * f64::from(i), 1.0, 1.2), 0.3, 0.05)).collect();
    let run = |mode| {
        let mut noise = Noise::new(2);
        let mut aligner = new_aligner(mode);
        for (k, range) in chunk_ranges(36, 12, 4).unwrap().into_iter().enumerate() {
            let prediction = predict(&truth, range.frames, k as u32, EXACT, &mut noise);
            aligner.push(observe(prediction, Some(&truth), none)).unwrap();
        }
        aligner.finish()
    };
    let conditioned = run(CouplingMode::PoseConditioned);
    assert!(conditioned.rejections.of(RejectionReason::RankDeficient) >= 1 && conditioned.views.is_empty());
    assert!(conditioned.chunks.iter().all(|c| c.world_from_chunk == Sim3::IDENTITY));
    let coupled = run(CouplingMode::Coupled);
    assert_eq!(coupled.views.len(), 36);
    assert!(absolute_error(&coupled, &truth) < 1e-3, "{}", absolute_error(&coupled, &truth));
    assert!(all_finite(&run(CouplingMode::Hybrid)));
}

#[test]
fn standing_still_leaves_the_scale_unobservable_without_landmarks() {
    let mut noise = Noise::new(3);
    let truth: Vec<Se3> = (0..36)
        .map(|_| {
            let place = Vector3::new(1.5, 0.8, 1.2) + noise.vector(0.0005);
            look(place, 0.4 + 0.001 * noise.normal(), 0.1)
        })
        .collect();
    let run = |with_landmarks: bool| {
        let (mut noise, mut points) = (Noise::new(4), Noise::new(5));
        let mut aligner = new_aligner(CouplingMode::Coupled);
        let mut gauges = Vec::new();
        for (k, range) in chunk_ranges(36, 12, 4).unwrap().into_iter().enumerate() {
            let mut peek = Noise(noise.0.clone());
            gauges.push(peek.gauge());
            let prediction = predict(&truth, range.frames.clone(), k as u32, REAL, &mut noise);
            let mut seen: Vec<_> =
                range.frames.map(|i| (i, landmarks(&truth[i], i, 30, 0.04, 0.1, &mut points))).collect();
            if !with_landmarks {
                seen.clear();
            }
            let of = |i: usize| seen.iter().find(|s| s.0 == i).map_or(Vec::new(), |s| s.1.clone());
            aligner.push(observe(prediction, Some(&truth), of)).unwrap();
        }
        (aligner.finish(), gauges)
    };
    let (blind, _) = run(false);
    assert!(all_finite(&blind) && blind.rejections.of(RejectionReason::ScaleUnobservable) >= 1);
    assert!(blind.chunks.iter().all(|c| c.log_scale_std > 0.03), "{:?}", blind.chunks);
    assert!(absolute_error(&blind, &truth) < 0.02);
    let (seen, gauges) = run(true);
    for (chunk, gauge) in seen.chunks.iter().zip(&gauges) {
        let error = (chunk.world_from_chunk.scale / gauge.scale).ln().abs();
        assert!(error < 0.02 && chunk.log_scale_std < 0.02, "{error} {}", chunk.log_scale_std);
    }
}

#[test]
fn a_chunk_whose_unit_jumps_by_a_third_is_no_other_map() {
    let truth = laps(60, 1.0);
    let corrupt = |k: usize, p: &mut GeometryPrediction| {
        let factor = [1.0, 1.3, 0.7, 1.3, 1.0, 0.7, 1.3, 1.0][k % 8];
        for v in 0..p.views.len() {
            p.views[v].chunk_from_camera.translation *= factor;
            let depth = p.views[v].depth.image().clone();
            set_depth(p, v, |x, y| depth[(x, y)] * factor as f32);
        }
    };
    for mode in [CouplingMode::Coupled, CouplingMode::PoseConditioned, CouplingMode::Hybrid] {
        let plain = run(mode, &truth, &truth, 4, |_, _, _| {});
        let jumping = run(mode, &truth, &truth, 4, |k, p, _| corrupt(k, p));
        let difference = plain
            .views
            .iter()
            .zip(&jumping.views)
            .map(|(a, b)| (a.world_from_camera.translation - b.world_from_camera.translation).norm())
            .fold(0.0, f64::max);
        assert!(difference < 5e-3, "{mode}: {difference}");
        assert_eq!(jumping.views.len(), 60);
    }
}

#[test]
fn an_odometry_that_flies_away_half_way_does_not_take_the_map_along() {
    let truth = laps(60, 1.0);
    let mut diverged = drifting(&truth, 1.0, &mut Noise::new(8));
    // From frame 30 on: an acceleration bias that is not seen, 4 m off after thirty frames, and a heading that turns.
    let broken: Vec<Se3> = diverged
        .iter()
        .enumerate()
        .map(|(i, pose)| {
            let t = (i as f64 - 30.0).max(0.0) / 30.0;
            let shift = Se3::new(
                So3::exp(&Vector3::new(0.0, 0.0, 0.8 * t * t)),
                Vector3::new(4.0, -2.0, 1.0) * (t * t),
            );
            shift * *pose
        })
        .collect();
    diverged = broken;
    let placement = run(CouplingMode::Coupled, &truth, &diverged, 4, |_, _, _| {});
    assert!(
        placement.rejections.of(RejectionReason::OdometryDownweighted) >= 1,
        "{:?}",
        placement.rejections
    );
    let error = absolute_error(&placement, &truth);
    let odometry_error = {
        let squares: f64 =
            diverged.iter().zip(&truth).map(|(a, b)| (a.translation - b.translation).norm_squared()).sum();
        (squares / 60.0).sqrt()
    };
    assert!(odometry_error > 1.0);
    assert!(
        error < 0.25 * odometry_error,
        "{error} m against {odometry_error} m; {:?}",
        placement.rejections
    );
    let early: f64 = placement.views[..24]
        .iter()
        .map(|v| (v.world_from_camera.translation - truth[v.frame_id.index()].translation).norm())
        .fold(0.0, f64::max);
    assert!(early < 0.08, "{early}");
}
