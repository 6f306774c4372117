//! The engine when the odometry settles its scale on the way.

use super::wall::Wall;
use super::*;
use std::sync::Arc;
use vidar_core::{
    Health, KeyframeId, LandmarkId, NavState, OdometryKeyframe, PoseCovariance, RevisedPose, SparseLandmark,
};

/// Images before this one are told at half their size.
const SETTLED: u32 = 25;

/// As told with image `i`: the newest pose is where it is, lengths are half.
fn told(i: u32) -> Se3 {
    let newest = pose(SETTLED).translation;
    Se3::from_translation(newest + (pose(i).translation - newest) * if i < SETTLED { 0.5 } else { 1.0 })
}

pub(in crate::engine) fn keyframe(i: u32) -> OdometryKeyframe {
    let scale = if i < SETTLED { 0.5 } else { 1.0 };
    OdometryKeyframe {
        id: KeyframeId(i),
        frame_id: FrameId(i),
        segment: 0,
        state: NavState { world_from_body: told(i), ..NavState::at_rest(stamp(i).time) },
        world_from_camera: told(i),
        pose_covariance: PoseCovariance::identity() * 1e-6,
        previous: i.checked_sub(2).map(|before| (KeyframeId(before), PoseCovariance::identity() * 1e-8)),
        gravity_in_world: Vector3::new(0.0, 0.0, -9.81),
        scale_std: if i < SETTLED { 0.5 } else { 0.02 },
        health: Health::Ok,
        landmarks: (0..20)
            .map(|k| SparseLandmark {
                id: LandmarkId(i * 100 + k),
                pixel: nalgebra::Vector2::new(3.0 * f64::from(k), 24.0),
                inverse_depth: 1.0 / (2.0 * scale),
                inverse_depth_std: 0.01 / scale,
            })
            .collect(),
        lens: vidar_core::LensMotion::NONE,
    }
}

/// Half as long until the scale is settled; every other image is a keyframe of the odometry.
fn settled_late(stamp: &FrameStamp) -> PoseReport {
    let FrameStamp { frame_id, time, .. } = *stamp;
    let i = frame_id.0;
    let settled = |k| RevisedPose { id: KeyframeId(k), world_from_camera: pose(k), is_final: true };
    PoseReport::Posed {
        state: FrameState { frame_id, time, segment: 0, world_from_camera: told(i) },
        keyframe: i.is_multiple_of(2).then(|| Box::new(keyframe(i))),
        revised: Vec::new(),
        settled: if i == SETTLED { (0..SETTLED).step_by(2).map(settled).collect() } else { Vec::new() },
        joined: None,
    }
}

#[test]
fn what_was_mapped_before_the_scale_was_settled_moves_with_its_keyframes() {
    let mut config = config();
    config.output.live_map = true;
    config.keyframes.min_translation_m = 0.02;
    let (ended, events, during) =
        run_with(&config, Box::new(Scripted(settled_late)), None, &mut Wall::new(&[]));
    ended.unwrap();
    assert!(degradations(&events).is_empty());
    let placements: Vec<&Arc<vidar_align::Placement>> = events
        .iter()
        .filter_map(|e| {
            if let MapEvent::PlacementsRevised { placement, .. } = e { Some(placement) } else { None }
        })
        .collect();
    let last = placements.last().unwrap();
    assert_eq!(last.views.len(), FRAMES as usize);
    for view in &last.views {
        let off = (view.world_from_camera.translation - pose(view.frame_id.0).translation).norm();
        assert!(off < 2e-3, "{view:?}");
        // Three chunks of six, each with two keyframes after it, were there before.
        let scale = if view.frame_id.0 < 18 { 2.0 } else { 1.0f64 };
        assert!((view.metres_per_unit / scale).ln().abs() < 0.01, "{view:?}");
    }
    // The wall is where it is in the map, and in what is shown as soon as a chunk was added since.
    let on_wall = |surface: &Surface| surface.mesh.positions.iter().all(|p| (p[2] - 2.0).abs() < 0.06);
    assert!(on_wall(surface(&events)));
    let shown: Vec<bool> = events[..during]
        .iter()
        .filter_map(|e| match e {
            MapEvent::SurfaceChanged { surface, .. } => Some(on_wall(surface)),
            _ => None,
        })
        .collect();
    assert!(!shown[0] && *shown.last().unwrap(), "{shown:?}");
    let width = |mesh: &vidar_core::TriangleMesh| {
        let x = mesh.positions.iter().map(|p| p[0]);
        x.clone().fold(f32::MIN, f32::max) - x.fold(f32::MAX, f32::min)
    };
    // 39 steps and what a view of 64 pixels sees at 2 m.
    let seen = 39.0 * STEP_M + 2.0 * 63.0 / 40.0;
    assert!((f64::from(width(&surface(&events).mesh)) - seen).abs() < 0.2);
}
