//! Images that have an unknown of their own: stamps that scatter, and stabilised ones.

use super::{Run, evaluate, fly_with, mean};
use nalgebra::Vector3;
use vidar_core::{LieGroup, Se3, So3};
use vidar_odometry::backend::SmootherConfig;
use vidar_odometry::imu::NavState;
use vidar_odometry::simulate::{Simulation, SimulationConfig};

/// The state whose orientation is that of the image: where the lens is shifted, a camera turned as much shows the same.
pub(super) fn of_image(truth: &NavState, settings: &SimulationConfig, secs: f64) -> NavState {
    let (shift, camera) = (settings.lens_at(secs).shift, Simulation::body_from_camera());
    let Se3 { rotation, translation } = truth.world_from_body;
    let turned = rotation * So3::exp(&(camera.rotation * Vector3::new(shift.y, -shift.x, 0.0)));
    let at_camera = translation + rotation * camera.translation;
    NavState { world_from_body: Se3::new(turned, at_camera - turned * camera.translation), ..*truth }
}

#[test]
fn pose_covariance_is_consistent_where_stamps_scatter() {
    let scattering = |seed| SimulationConfig {
        seed,
        tracks: 40,
        camera_rate_hz: 10.0,
        stamp_scatter_secs: 0.004,
        ..Default::default()
    };
    let runs: Vec<Run> =
        (0..20).map(|seed| fly_with(&scattering(seed), 4.0, |c| c.stamp_scatter_ms = 4.0)).collect();
    evaluate(&runs, 0.06);
    // Taken as they are, such stamps contradict the IMU.
    let unaware: Vec<Run> = (0..20).map(|seed| fly_with(&scattering(seed), 4.0, |_| {})).collect();
    let nees = mean(unaware.iter().flat_map(|r| r.nees.iter().copied()));
    assert!(nees > 20.0, "pose NEES {nees:.2}");
}

#[test]
fn pose_covariance_is_consistent_where_images_are_shifted() {
    let stabilised =
        |seed| SimulationConfig { seed, tracks: 40, camera_rate_hz: 10.0, shift: 0.01, ..Default::default() };
    let fly = |aware: bool| -> Vec<Run> {
        let change = |c: &mut SmootherConfig| c.image_shift_deg = if aware { 0.6 } else { 0.0 };
        (0..20).map(|seed| fly_with(&stabilised(seed), 4.0, change)).collect()
    };
    evaluate(&fly(true), 0.1);
    // Taken as they are, such images contradict the gyroscope.
    let nees = mean(fly(false).iter().flat_map(|r| r.nees.iter().copied()));
    assert!(nees > 20.0, "pose NEES {nees:.2}");
}
