//! Settings of the odometry on tracks.

use crate::backend::SmootherConfig;
use crate::imu::ImuModel;

/// Settings of [`FeatureOdometry`](super::FeatureOdometry).
#[derive(Clone, Debug)]
pub struct FeatureOdometryConfig {
    /// The smoother.
    pub smoother: SmootherConfig,
    /// The IMU model of the smoother.
    pub imu: ImuModel,
    /// Nominal rate of IMU measurements, Hz.
    pub imu_rate_hz: f64,
    /// Keyframes held.
    pub keyframes: usize,
    /// Other frames held.
    pub recent: usize,
    /// Steps of the smoother per frame.
    pub iterations: usize,
    /// Frames from keyframe to keyframe.
    pub keyframe_every: usize,
    /// Least angle between rays of a new landmark, degrees.
    pub min_parallax_deg: f64,
    /// Frames between attempts to start.
    pub attempt_every: usize,
    /// Whether standstill is detected from tracks and IMU measurements, as in the whole odometry; else only
    /// [`FeatureOdometry::push_resting`](super::FeatureOdometry::push_resting) does.
    pub notices_rest: bool,
}

impl FeatureOdometryConfig {
    /// For a simulation's IMU, its white noise inflated by `factor`.
    pub fn new(noise: &vidar_core::ImuNoise, factor: f64) -> Self {
        Self {
            smoother: SmootherConfig::default(),
            imu: ImuModel::from_data_sheet(noise, factor, factor),
            imu_rate_hz: noise.rate_hz,
            keyframes: 10,
            recent: 3,
            iterations: 3,
            keyframe_every: 4,
            min_parallax_deg: 1.0,
            attempt_every: 6,
            notices_rest: true,
        }
    }
}
