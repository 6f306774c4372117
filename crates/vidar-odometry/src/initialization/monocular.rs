//! A start without an IMU: two views give motion and structure up to scale, and the scale is set by convention.

use super::{InitFailure, InitFailureReason, LoggedFrame, TrackObservation};
use crate::backend::{GaugePriorSigmas, Smoother, SmootherError};
use crate::config::OdometryConfig;
use crate::frontend::{RayPair, TwoViewFailure, TwoViewSolver, triangulate};
use crate::imu::NavState;
use vidar_core::{CameraModel, LieGroup, Se3};
use vidar_solve::statistics::median_upper;

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

/// χ² per degree of freedom of both views' observations beyond which a solution is rejected.
const MAX_CHI2_PER_DOF: f64 = 3.0;

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
    let mut solver = TwoViewSolver::default();
    let found = solver.solve(&pairs, sigma_rad).map_err(|failure| match failure {
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
    let mut inverses: Vec<f64> = points.iter().map(|p| p.2).collect();
    let Some(median) = median_upper(&mut inverses).filter(|_| points.len() >= MIN_SHARED / 2) else {
        return Err(fail(InitFailureReason::Tracks, points.len() as f64, 0.5 * MIN_SHARED as f64));
    };
    let scale = INITIAL_INVERSE_DISTANCE / median;
    let b_from_a = Se3::new(found.b_from_a.rotation, found.b_from_a.translation / scale);
    let mut smoother = build(first, second, &points, scale, &b_from_a, camera, body_from_camera, config)
        .map_err(InitFailure::backend)?;
    let report = smoother.optimise(10);
    for outlier in &report.outliers {
        smoother.remove_landmark(outlier.landmark);
    }
    // A NaN must not pass.
    match report.chi2_per_dof < MAX_CHI2_PER_DOF {
        true => Ok(smoother),
        false => Err(fail(InitFailureReason::ImageChi2, report.chi2_per_dof, MAX_CHI2_PER_DOF)),
    }
}

/// Both views as keyframes of a smoother, with the points as its landmarks.
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
) -> Result<Smoother, SmootherError> {
    let mut smoother = Smoother::new(config.smoother(), camera.clone(), *body_from_camera)?;
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
    smoother.start(first.frame, first.time, state, sigmas)?;
    let camera_motion = *body_from_camera * b_from_a.inverse() * body_from_camera.inverse();
    let next = NavState { world_from_body: world_from_first * camera_motion, ..NavState::REST };
    smoother.add_frame(second.frame, second.time, next, None)?;
    smoother.mark_keyframe(first.frame)?;
    smoother.mark_keyframe(second.frame)?;
    for (a, b, inverse) in points {
        smoother.add_landmark(&a.by(first.frame), inverse * scale)?;
        smoother.add_observation(&b.by(second.frame))?;
    }
    Ok(smoother)
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::{FrameId, Pinhole, Timestamp};

    #[test]
    fn what_the_backend_rejects_is_the_reason_of_the_failure() {
        let frame = |id| LoggedFrame {
            frame: FrameId(id),
            time: Timestamp::from_nanos(1_000_000),
            preintegration: None,
            observations: Vec::new(),
        };
        let camera = CameraModel::Pinhole(Pinhole::new(458.0, 457.0, 367.0, 248.0, 752, 480).unwrap());
        let (still, config) = (Se3::IDENTITY, OdometryConfig::default());
        let error = build(&frame(0), &frame(1), &[], 1.0, &still, &camera, &still, &config).unwrap_err();
        assert!(matches!(error, SmootherError::NotNext { id: FrameId(1), .. }), "{error}");
        let failure = InitFailure::backend(error);
        assert!(failure.to_string().starts_with("backend: frame"), "{failure}");
    }
}
