//! A start without an IMU: two views give motion and structure up to scale, and the scale is set by convention.

use super::{InitFailure, InitFailureReason, LoggedFrame, TrackObservation};
use crate::backend::{GaugePriorSigmas, Observation, Smoother};
use crate::config::OdometryConfig;
use crate::frontend::{RayPair, TwoViewConfig, TwoViewFailure, TwoViewSolver, triangulate};
use crate::imu::NavState;
use vidar_core::{CameraModel, LieGroup, Se3};

/// Inverse distance to assume of everything, 1/m.
pub(crate) const INITIAL_INVERSE_DISTANCE: f64 = 0.4;

/// Least median parallax between the two views, degrees.
const MIN_PARALLAX_DEG: f64 = 2.0;

/// Tracks that both views must share.
const MIN_SHARED: usize = 40;

/// Error of a ray, pixels.
const RAY_SIGMA_PX: f64 = 0.7;

/// A point is kept when its distance is known to this share.
const MAX_RELATIVE_SIGMA: f64 = 0.3;

/// Tries the newest frame of the log against earlier ones, the oldest that shares enough first.
///
/// The smoother returned holds both frames as keyframes; the median distance is `1 / INITIAL_INVERSE_DISTANCE`.
pub(crate) fn start(
    log: &[LoggedFrame],
    camera: &CameraModel,
    body_from_camera: &Se3,
    config: &OdometryConfig,
) -> Result<Smoother, InitFailure> {
    let fail = |reason, measured, limit| InitFailure { reason, measured, limit };
    let Some((newest, earlier)) = log.split_last() else {
        return Err(fail(InitFailureReason::Frames, 0.0, 2.0));
    };
    let mut most = 0;
    for reference in earlier {
        let shared = shared_tracks(reference, newest);
        most = most.max(shared.len());
        if shared.len() >= MIN_SHARED {
            return between(reference, newest, &shared, camera, body_from_camera, config);
        }
    }
    Err(fail(InitFailureReason::Tracks, most as f64, MIN_SHARED as f64))
}

fn shared_tracks(a: &LoggedFrame, b: &LoggedFrame) -> Vec<(TrackObservation, TrackObservation)> {
    let mut observations: Vec<&TrackObservation> = b.observations.iter().collect();
    observations.sort_unstable_by_key(|s| s.landmark);
    let partner = |s: &TrackObservation| {
        let at = observations.binary_search_by_key(&s.landmark, |o| o.landmark).ok()?;
        Some((*s, *observations[at]))
    };
    a.observations.iter().filter_map(partner).collect()
}

fn between(
    first: &LoggedFrame,
    second: &LoggedFrame,
    shared: &[(TrackObservation, TrackObservation)],
    camera: &CameraModel,
    body_from_camera: &Se3,
    config: &OdometryConfig,
) -> Result<Smoother, InitFailure> {
    let fail = |reason, measured, limit| InitFailure { reason, measured, limit };
    let sigma_rad = RAY_SIGMA_PX / camera.intrinsics().fx;
    let ray = |s: &TrackObservation| camera.unproject(&s.pixel);
    let with_rays: Vec<(TrackObservation, TrackObservation, RayPair)> =
        shared.iter().filter_map(|(a, b)| Some((*a, *b, RayPair { a: ray(a)?, b: ray(b)? }))).collect();
    let pairs: Vec<RayPair> = with_rays.iter().map(|w| w.2).collect();
    let mut solver = TwoViewSolver::new(TwoViewConfig::default());
    let found = solver.without_rotation(&pairs, sigma_rad).map_err(|failure| match failure {
        TwoViewFailure::NoParallax { median_rad, .. } => {
            fail(InitFailureReason::Parallax, median_rad.to_degrees(), MIN_PARALLAX_DEG)
        }
        TwoViewFailure::NoConsensus { inliers, needed } => {
            fail(InitFailureReason::Tracks, inliers as f64, needed as f64)
        }
        TwoViewFailure::TooFewPairs { found, needed } => {
            fail(InitFailureReason::Tracks, found as f64, needed as f64)
        }
    })?;
    let parallax_deg = found.median_parallax_rad.to_degrees();
    if parallax_deg < MIN_PARALLAX_DEG {
        return Err(fail(InitFailureReason::Parallax, parallax_deg, MIN_PARALLAX_DEG));
    }
    let mut points: Vec<(TrackObservation, TrackObservation, f64)> = Vec::new();
    for ((a, b, pair), inlier) in with_rays.iter().zip(solver.inliers()) {
        let Some(point) = triangulate(pair, &found.b_from_a, sigma_rad).filter(|_| *inlier) else { continue };
        if point.inverse_distance > 0.0 && point.sigma < MAX_RELATIVE_SIGMA * point.inverse_distance {
            points.push((*a, *b, point.inverse_distance));
        }
    }
    if points.len() < MIN_SHARED / 2 {
        return Err(fail(InitFailureReason::Tracks, points.len() as f64, 0.5 * MIN_SHARED as f64));
    }
    let mut inverses: Vec<f64> = points.iter().map(|p| p.2).collect();
    inverses.sort_unstable_by(f64::total_cmp);
    let scale = INITIAL_INVERSE_DISTANCE / inverses[inverses.len() / 2];
    let b_from_a = Se3::new(found.b_from_a.rotation, found.b_from_a.translation / scale);
    build(first, second, &points, scale, &b_from_a, camera, body_from_camera, config)
        .ok_or_else(|| fail(InitFailureReason::ImageChi2, f64::INFINITY, 3.0))
}

#[allow(clippy::too_many_arguments)] // the end of one function, kept apart for its length only
fn build(
    first: &LoggedFrame,
    second: &LoggedFrame,
    points: &[(TrackObservation, TrackObservation, f64)],
    scale: f64,
    b_from_a: &Se3,
    camera: &CameraModel,
    body_from_camera: &Se3,
    config: &OdometryConfig,
) -> Option<Smoother> {
    let mut smoother = Smoother::new(config.smoother(), camera.clone(), *body_from_camera).ok()?;
    // Without an IMU nothing is vertical: the world is the first camera's, its y axis down.
    let world_from_first = Se3::new(
        vidar_core::So3::exp(&nalgebra::Vector3::new(-std::f64::consts::FRAC_PI_2, 0.0, 0.0)),
        nalgebra::Vector3::zeros(),
    ) * body_from_camera.inverse();
    let state = NavState { world_from_body: world_from_first, ..NavState::REST };
    let sigmas = GaugePriorSigmas {
        position_m: 1e-3,
        yaw_rad: 1e-3,
        tilt_rad: 1e-3,
        velocity_mps: 1.0,
        gyro_bias: 1.0,
        accel_bias: 1.0,
    };
    smoother.start(first.frame, first.time, state, sigmas).ok()?;
    let camera_motion = *body_from_camera * b_from_a.inverse() * body_from_camera.inverse();
    let next = NavState { world_from_body: world_from_first * camera_motion, ..NavState::REST };
    smoother.add_frame(second.frame, second.time, next, None).ok()?;
    smoother.mark_keyframe(first.frame).ok()?;
    smoother.mark_keyframe(second.frame).ok()?;
    for (a, b, inverse) in points {
        let observation = |frame, observations: &TrackObservation| Observation {
            frame,
            landmark: observations.landmark,
            pixel: observations.pixel,
            covariance: observations.covariance,
        };
        smoother.add_landmark(&observation(first.frame, a), inverse * scale).ok()?;
        smoother.add_observation(&observation(second.frame, b)).ok()?;
    }
    let report = smoother.optimise(10);
    for outlier in &report.outliers {
        smoother.remove_landmark(outlier.landmark);
    }
    (report.chi2_per_dof < 3.0).then_some(smoother)
}
