//! Start from standstill: gyroscope bias and inclination are read off, velocity is zero.

use super::failure::{InitFailure, InitFailureReason};
use crate::backend::GaugePriorSigmas;
use crate::imu::{Bias, NavState};
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use vidar_core::{GRAVITY_MPS2, ImuSample, LieGroup, Se3, So3};

/// What counts as standing still.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct StaticInitConfig {
    /// Most scatter (standard deviation) of the gyroscope per axis, rad/s, 0.001…0.5.
    pub max_gyro_std: f64,
    /// Most scatter of the accelerometer per axis, m/s², 0.01…5.
    pub max_accel_std: f64,
    /// Most mean motion in the image between frames, px, 0.05…5.
    pub max_image_motion_px: f64,
    /// Fewest seconds of IMU measurements, 0.1…10.
    pub min_secs: f64,
    /// Strength of gravity, m/s², 9.5…10.
    pub gravity_mps2: f64,
}

impl Default for StaticInitConfig {
    fn default() -> Self {
        Self {
            max_gyro_std: 0.02,
            max_accel_std: 0.15,
            max_image_motion_px: 0.3,
            min_secs: 0.5,
            gravity_mps2: GRAVITY_MPS2,
        }
    }
}

/// A body at rest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StaticState {
    /// At the origin, level, heading zero, without velocity; gyroscope bias as read.
    pub state: NavState,
    /// How well that is known.
    pub sigmas: GaugePriorSigmas,
}

/// How far the mean specific force may lie from gravity before a bias is suspected, m/s².
const SUSPICIOUS_FORCE: f64 = 0.3;

/// How far it may lie at all.
const IMPOSSIBLE_FORCE: f64 = 1.5;

/// Reads the state of a body at rest from `IMU measurements`, if it is at rest. `image_motion_px` is the mean motion of tracks
/// between frames, where there are any.
///
/// # Errors
/// What shows that the body is not at rest, with the measured value.
pub fn initialize_static(
    samples: &[ImuSample],
    image_motion_px: Option<f64>,
    config: &StaticInitConfig,
) -> Result<StaticState, InitFailure> {
    let span = match (samples.first(), samples.last()) {
        (Some(first), Some(last)) => (last.time - first.time).as_secs_f64(),
        _ => 0.0,
    };
    if !(span >= config.min_secs) {
        return Err(InitFailure::new(InitFailureReason::Seconds, span, config.min_secs));
    }
    let n = samples.len() as f64;
    let mean = |of: fn(&ImuSample) -> Vector3<f64>| samples.iter().map(of).sum::<Vector3<f64>>() / n;
    let (gyro, accel) = (mean(|s| s.gyro.0), mean(|s| s.accel.0));
    let std = |of: fn(&ImuSample) -> Vector3<f64>, mean: Vector3<f64>| {
        let squares = samples.iter().map(|s| (of(s) - mean).component_mul(&(of(s) - mean)));
        (squares.sum::<Vector3<f64>>() / n).max().sqrt()
    };
    let checks = [
        (InitFailureReason::GyroStd, std(|s| s.gyro.0, gyro), config.max_gyro_std),
        (InitFailureReason::AccelStd, std(|s| s.accel.0, accel), config.max_accel_std),
        (InitFailureReason::ImageMotion, image_motion_px.unwrap_or(0.0), config.max_image_motion_px),
        (InitFailureReason::SpecificForce, (accel.norm() - config.gravity_mps2).abs(), IMPOSSIBLE_FORCE),
    ];
    // A NaN must not pass.
    if let Some((reason, measured, limit)) = checks.into_iter().find(|(_, m, limit)| !(m <= limit)) {
        return Err(InitFailure::new(reason, measured, limit));
    }
    let suspicious = (accel.norm() - config.gravity_mps2).abs() > SUSPICIOUS_FORCE;
    let accel_sigma = if suspicious { 0.3 } else { 0.1 };
    let state = NavState {
        world_from_body: Se3::new(leveled(&accel), Vector3::zeros()),
        velocity: Vector3::zeros(),
        bias: Bias { gyro, accel: Vector3::zeros() },
    };
    let sigmas = GaugePriorSigmas {
        position_m: 1e-3,
        yaw_rad: 1e-3,
        // A horizontal accelerometer bias reads as inclination.
        tilt_rad: accel_sigma / config.gravity_mps2,
        velocity_mps: 0.02,
        gyro_bias: (5e-3 / n.sqrt()).max(5e-4),
        accel_bias: accel_sigma,
    };
    Ok(StaticState { state, sigmas })
}

/// Standard deviation of the velocity of a body whose images show no parallax for a second, m/s: a degree at 5 m.
const SLOW_VELOCITY_MPS: f64 = 0.1;
/// Most change of velocity within that time beside a steady one, m/s. Of 24 rendered hand-held recordings, the calm hands change theirs
/// by at most 0.21, the lively ones by 0.5 to 0.7: their images show no parallax where what they see is far away.
const MOST_CHANGE_MPS: f64 = 0.3;
/// Standard deviation of a gyroscope bias that was fitted to images.
const FITTED_GYRO_BIAS: f64 = 5e-3;

/// Reads the state of a body that hardly moves, though it does not stand still, from a second or more of `samples`: level by the
/// mean specific force in the axes of the last sample, no velocity. None where the mean specific force is not gravity, or the force
/// about its mean moves the body.
pub(crate) fn initialize_slow(
    samples: &[ImuSample],
    gyro_bias: &Vector3<f64>,
    gravity_mps2: f64,
) -> Option<StaticState> {
    let (first, last) = (samples.first()?, samples.last()?);
    let mut last_from_sample = So3::IDENTITY;
    // Latest first: the time until the next later sample, and the force in the axes of the last.
    let mut forces = vec![(0.0, last.accel.0)];
    for pair in samples.windows(2).rev() {
        let secs = (pair[1].time - pair[0].time).as_secs_f64();
        let rate = 0.5 * (pair[0].gyro.0 + pair[1].gyro.0) - gyro_bias;
        last_from_sample = last_from_sample * So3::exp(&(-rate * secs));
        forces.push((secs, last_from_sample.act(&pair[0].accel.0)));
    }
    let mean = forces.iter().map(|(_, force)| force).sum::<Vector3<f64>>() / samples.len() as f64;
    let off = (mean.norm() - gravity_mps2).abs();
    let mut change = Vector3::zeros();
    let is_slow = forces.iter().all(|(secs, force)| {
        change += (force - mean) * *secs;
        change.norm() <= MOST_CHANGE_MPS
    });
    if !(off <= IMPOSSIBLE_FORCE && is_slow) {
        return None;
    }
    let accel_sigma = if off > SUSPICIOUS_FORCE { 0.3 } else { 0.1 };
    let secs = (last.time - first.time).as_secs_f64().max(0.1);
    // What the mean force holds beside gravity is a change of velocity over its time.
    let tilt_mps2 = f64::hypot(accel_sigma, SLOW_VELOCITY_MPS * std::f64::consts::SQRT_2 / secs);
    let state = NavState {
        world_from_body: Se3::new(leveled(&mean), Vector3::zeros()),
        velocity: Vector3::zeros(),
        bias: Bias { gyro: *gyro_bias, accel: Vector3::zeros() },
    };
    let sigmas = GaugePriorSigmas {
        position_m: 1e-3,
        yaw_rad: 1e-3,
        tilt_rad: tilt_mps2 / gravity_mps2,
        velocity_mps: SLOW_VELOCITY_MPS,
        gyro_bias: FITTED_GYRO_BIAS,
        accel_bias: accel_sigma,
    };
    Some(StaticState { state, sigmas })
}

/// The rotation world_from_body of least angle that makes `up_in_body` vertical.
pub(crate) fn leveled(up_in_body: &Vector3<f64>) -> So3 {
    let axis = up_in_body.cross(&Vector3::z());
    let angle = axis.norm().atan2(up_in_body.z);
    match axis.try_normalize(1e-12 * up_in_body.norm()) {
        Some(axis) => So3::exp(&(axis * angle)),
        // Upside down, any horizontal axis will do.
        None if up_in_body.z < 0.0 => So3::exp(&(Vector3::x() * std::f64::consts::PI)),
        None => So3::IDENTITY,
    }
}
