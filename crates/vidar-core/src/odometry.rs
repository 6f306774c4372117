//! Outputs of a metric odometry per frame and per keyframe.
//!
//! The error state of a frame is `[δθ, δp, δv, δb_gyro, δb_accel]`, three numbers each: `R · exp(δθ)` in the body
//! frame, `p + δp` and `v + δv` in the world frame, additive biases. Covariances have the same order and units.

use crate::camera::{LensMotion, Pixel};
use crate::id::{FrameId, KeyframeId, LandmarkId};
use crate::lie::Se3;
use crate::time::Timestamp;
use nalgebra::{SMatrix, Vector3};
use serde::{Deserialize, Serialize};
use std::fmt;

/// Covariance of a frame's error state: rotation, position, velocity, gyroscope bias, accelerometer bias.
pub type NavCovariance = SMatrix<f64, 15, 15>;

/// Covariance of a pose: rotation in the body (rad), position in the world (m).
pub type PoseCovariance = SMatrix<f64, 6, 6>;

/// Navigation state: pose, velocity and IMU biases.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct NavState {
    /// Time of the state, in the clock of the images.
    pub time: Timestamp,
    /// Pose of the body (IMU) in a world whose z axis points up.
    pub world_from_body: Se3,
    /// Velocity of the body in the world, m/s.
    pub velocity_in_world: Vector3<f64>,
    /// Bias of the gyroscope, rad/s: subtract it from measurements.
    pub gyro_bias: Vector3<f64>,
    /// Bias of the accelerometer, m/s²: subtract it from measurements.
    pub accel_bias: Vector3<f64>,
}

impl NavState {
    /// At rest at the origin, biases zero.
    pub fn at_rest(time: Timestamp) -> Self {
        let zero = Vector3::zeros();
        Self {
            time,
            world_from_body: Se3::IDENTITY,
            velocity_in_world: zero,
            gyro_bias: zero,
            accel_bias: zero,
        }
    }

    /// Whether every number is finite.
    pub fn is_finite(&self) -> bool {
        let vectors = [&self.velocity_in_world, &self.gyro_bias, &self.accel_bias];
        self.world_from_body.is_finite() && vectors.iter().all(|v| v.iter().all(|c| c.is_finite()))
    }
}

/// Tracking health of a frame; greater is worse, and the worst condition that holds is reported.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Health {
    /// No condition below holds.
    Ok,
    /// Metric, but the scale's standard deviation is still above two percent.
    ScaleConverging,
    /// Up to scale: there is no IMU, or the scale is not observable yet. Lengths are not metres.
    ScaleUnknown,
    /// Few landmarks are observed.
    LowFeatures,
    /// No image measurement was used; the state is propagated by the IMU alone.
    Degraded,
    /// Measurements contradict the state.
    Suspect,
    /// No state is estimated.
    Lost,
}

impl Health {
    /// The name used in files.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::ScaleConverging => "scale-converging",
            Self::ScaleUnknown => "scale-unknown",
            Self::LowFeatures => "low-features",
            Self::Degraded => "degraded",
            Self::Suspect => "suspect",
            Self::Lost => "lost",
        }
    }

    /// Whether lengths are metres and images support the state: the condition for fusion into a metric map.
    pub fn is_metric(self) -> bool {
        matches!(self, Self::Ok | Self::ScaleConverging | Self::LowFeatures)
    }
}

impl fmt::Display for Health {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

/// A landmark as observed in one keyframe.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct SparseLandmark {
    /// The landmark; the same in every keyframe that observes it.
    pub id: LandmarkId,
    /// Its position in the keyframe's image.
    pub pixel: Pixel,
    /// Inverse of its z-depth in the keyframe's camera, 1/m (1/unit while the scale is unknown).
    pub inverse_depth: f64,
    /// Standard deviation of `inverse_depth`.
    pub inverse_depth_std: f64,
}

/// A keyframe of the odometry, input of dense reconstruction.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct OdometryKeyframe {
    /// Its number, counted from the first of the sequence.
    pub id: KeyframeId,
    /// The frame it was made from.
    pub frame_id: FrameId,
    /// Its segment: poses of different segments have no common world frame.
    pub segment: u32,
    /// Its state; `state.time` is the frame's.
    pub state: NavState,
    /// Pose of its camera.
    pub world_from_camera: Se3,
    /// Covariance of its pose, relative to the first pose of the segment.
    pub pose_covariance: PoseCovariance,
    /// The keyframe before it, and the covariance of `previous_from_this · exp(δ)`: rotation, translation, both in
    /// this keyframe's body axes (vidar-core's tangent).
    pub previous: Option<(KeyframeId, PoseCovariance)>,
    /// Gravity in the world, m/s².
    pub gravity_in_world: Vector3<f64>,
    /// Standard deviation of ln(scale); infinite while the scale is not observable.
    pub scale_std: f64,
    /// Tracking health when it was created.
    pub health: Health,
    /// How the lens had moved when its image was taken; [`LensMotion::NONE`] where one calibration holds for all images.
    pub lens: LensMotion,
    /// The landmarks it observes.
    pub landmarks: Vec<SparseLandmark>,
}

/// A keyframe's pose, re-estimated with later frames.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RevisedPose {
    /// Which keyframe.
    pub id: KeyframeId,
    /// Its present pose.
    pub world_from_camera: Se3,
    /// Whether the window has let go of the keyframe. Only a scale that is settled later revises it after that.
    pub is_final: bool,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_metric_states_with_images_may_be_fused() {
        let all = [
            Health::Ok,
            Health::ScaleConverging,
            Health::ScaleUnknown,
            Health::LowFeatures,
            Health::Degraded,
            Health::Suspect,
            Health::Lost,
        ];
        let metric: Vec<&str> = all.iter().filter(|h| h.is_metric()).map(|h| h.as_str()).collect();
        assert_eq!(metric, ["ok", "scale-converging", "low-features"]);
        assert!(all.windows(2).all(|w| w[0] < w[1]), "the worst condition is the greatest");
    }

    #[test]
    fn a_state_with_one_number_missing_is_not_finite() {
        let mut state = NavState::at_rest(Timestamp::from_nanos(5));
        assert!(state.is_finite());
        state.accel_bias.y = f64::NAN;
        assert!(!state.is_finite());
    }
}
