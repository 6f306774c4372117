use super::*;
use crate::config::{SceneKind, SynthConfig};
use crate::predict::{TruePlace, true_views};
use crate::rig::euroc_body_from_camera;
use crate::simulation::Simulation;
use std::sync::OnceLock;
use vidar_core::{FrameId, Pinhole};

const N: usize = 40;

fn views() -> &'static [TrueView] {
    static VIEWS: OnceLock<Vec<TrueView>> = OnceLock::new();
    VIEWS.get_or_init(|| {
        let config = SynthConfig { clutter: 12, scene: SceneKind::Room, ..SynthConfig::default() };
        let simulation = Simulation::new(&config, None).unwrap();
        let place = |k: usize| {
            let time = simulation.frame_time(2 * k);
            let world_from_camera = simulation.world_from_camera(time).unwrap();
            TruePlace { frame_id: FrameId(2 * k as u32), time, world_from_camera }
        };
        let intrinsics = Pinhole::new(62.0, 62.0, 39.5, 25.5, 80, 52).unwrap();
        true_views(simulation.world(), &(0..N).map(place).collect::<Vec<_>>(), &intrinsics)
    })
}

fn keyframes(errors: &OdometryErrors, seed: u64) -> Vec<OdometryKeyframe> {
    simulate_odometry(views(), &euroc_body_from_camera(), errors, seed).unwrap()
}

#[test]
fn without_errors_keyframes_are_true_and_landmarks_lie_on_surfaces() {
    let errors = OdometryErrors {
        factor: 0.0,
        landmark_sigma: 0.0,
        landmark_frame_sigma: 0.0,
        landmark_outliers: 0.0,
        ..OdometryErrors::default()
    };
    for (keyframe, view) in keyframes(&errors, 1).iter().zip(views()) {
        assert!((keyframe.world_from_camera.matrix() - view.world_from_camera.matrix()).amax() < 1e-9);
        assert_eq!((keyframe.frame_id, keyframe.state.time), (view.frame_id, view.time));
        assert!(keyframe.landmarks.len() > 100, "{} landmarks", keyframe.landmarks.len());
        for landmark in &keyframe.landmarks {
            let pixel = landmark.pixel.map(|v| v.round() as usize);
            let z = f64::from(view.depth.image()[(pixel.x, pixel.y)]);
            assert!((z * landmark.inverse_depth - 1.0).abs() < 0.021);
        }
    }
}

#[test]
fn landmarks_are_seen_again_by_the_same_name() {
    let all = keyframes(&OdometryErrors::default(), 1);
    let mut kept = Vec::new();
    for pair in all.windows(2) {
        let before: Vec<_> = pair[0].landmarks.iter().map(|l| l.id).collect();
        assert!(before.windows(2).all(|w| w[0] < w[1]), "each is seen once");
        kept.push(pair[1].landmarks.iter().filter(|l| before.contains(&l.id)).count());
    }
    kept.sort_unstable();
    assert!(kept[kept.len() / 2] > 60, "{kept:?}");
}

#[test]
fn steps_are_as_uncertain_as_stated_and_three_times_worse_at_factor_three() {
    let mut ends = [0.0, 0.0];
    for (which, factor) in [1.0, 3.0].into_iter().enumerate() {
        let errors = OdometryErrors { factor, landmarks: 0, ..OdometryErrors::default() };
        let (mut sum, mut count) = (0.0, 0);
        for seed in 0..30 {
            let all = keyframes(&errors, seed);
            for (pair, truth) in all.windows(2).zip(views().windows(2)) {
                let reported = pair[0].state.world_from_body.inverse() * pair[1].state.world_from_body;
                let camera_from_body = euroc_body_from_camera().inverse();
                let body = |v: &TrueView| v.world_from_camera * camera_from_body;
                let true_step = body(&truth[0]).inverse() * body(&truth[1]);
                // previous_from_this · exp(δ)
                let delta = (true_step.inverse() * reported).log();
                let covariance = pair[1].previous.unwrap().1;
                sum += (delta.transpose() * covariance.try_inverse().unwrap() * delta)[0];
                count += 6;
            }
            let end = all[N - 1].world_from_camera.translation - views()[N - 1].world_from_camera.translation;
            ends[which] += end.norm_squared() / 30.0;
        }
        let per_dof = sum / f64::from(count);
        assert!((0.85..1.25).contains(&per_dof), "NEES per degree of freedom {per_dof}");
    }
    let ratio = (ends[1] / ends[0]).sqrt();
    assert!((2.5..3.5).contains(&ratio), "drift grows by {ratio}");
}

#[test]
fn pose_covariance_predicts_the_error_at_the_end() {
    // Without the scale, which is common to all steps and not part of the chain.
    let errors =
        OdometryErrors { landmarks: 0, scale_sigma: 0.0, scale_walk: 0.0, ..OdometryErrors::default() };
    let (mut sum, seeds) = (0.0, 60);
    let camera_from_body = euroc_body_from_camera().inverse();
    for seed in 0..seeds {
        let last = keyframes(&errors, seed).pop().unwrap();
        let truth = views()[N - 1].world_from_camera * camera_from_body;
        let turn = (truth.rotation.inverse() * last.state.world_from_body.rotation).log();
        let shift = last.state.world_from_body.translation - truth.translation;
        let delta = tangent(&turn, &shift);
        sum += (delta.transpose() * last.pose_covariance.try_inverse().unwrap() * delta)[0];
    }
    let per_dof = sum / (6.0 * seeds as f64);
    assert!((0.75..1.3).contains(&per_dof), "NEES per degree of freedom {per_dof}");
}

fn tangent(turn: &Vector3<f64>, shift: &Vector3<f64>) -> nalgebra::Vector6<f64> {
    nalgebra::Vector6::new(turn.x, turn.y, turn.z, shift.x, shift.y, shift.z)
}

#[test]
fn gravity_holds_roll_and_pitch_and_yaw_drifts() {
    let errors = OdometryErrors { factor: 3.0, landmarks: 0, ..OdometryErrors::default() };
    let (mut tilt, mut yaw) = (0.0_f64, 0.0_f64);
    for seed in 0..20 {
        let last = keyframes(&errors, seed).pop().unwrap();
        let error = last.world_from_camera.rotation * views()[N - 1].world_from_camera.rotation.inverse();
        let turn = error.log();
        tilt += turn.x.hypot(turn.y).powi(2) / 20.0;
        yaw += turn.z.powi(2) / 20.0;
    }
    let (tilt, yaw) = (tilt.sqrt().to_degrees(), yaw.sqrt().to_degrees());
    assert!(tilt < 0.5 && yaw > 2.0 * tilt, "tilt {tilt}°, yaw {yaw}°");
}

#[test]
fn the_same_seed_gives_the_same_keyframes_and_another_seed_others() {
    let errors = OdometryErrors::default();
    assert_eq!(keyframes(&errors, 4), keyframes(&errors, 4));
    assert_ne!(keyframes(&errors, 4), keyframes(&errors, 5));
    assert!(simulate_odometry(&[], &Se3::IDENTITY, &errors, 4).unwrap().is_empty());
    let one = simulate_odometry(&views()[..1], &Se3::IDENTITY, &errors, 4).unwrap();
    assert!(one[0].previous.is_none() && one[0].state.is_finite());
    let bad = OdometryErrors { landmark_outliers: 2.0, ..errors };
    let refused = simulate_odometry(&[], &Se3::IDENTITY, &bad, 4).unwrap_err();
    assert!(refused.to_string().contains("odometry.landmark_outliers"));
}
