//! Visual-inertial odometry: images and IMU samples in, metric states, keyframes and covariance out.
//!
//! The modules follow an image through the odometry:
//!
//! - [`frontend`]: image pyramids, feature detection, patch alignment, two-view geometry;
//! - [`imu`]: the buffer of IMU samples, preintegration, propagation of state and covariance;
//! - `gyro_alignment`: clock offset, rolling-shutter readout and camera rotation from tracks and gyroscope;
//! - [`initialization`]: the first metric state, from standstill, in motion, or up to scale without an IMU;
//! - `tracking`: features followed from image to image, seeds, keyframes and the sliding window of frames;
//! - [`backend`]: the fixed-lag smoother that estimates the window's states and landmarks;
//! - [`bundle_adjustment`]: after a recording's end, all states, landmarks and the calibration in one adjustment;
//! - `relocalization`: keyframes that show the same place found again after a loss;
//! - `pipeline`: [`Odometry`], the push machine that connects them and monitors their health.

pub mod backend;
pub mod bundle_adjustment;
pub mod calibration;
mod config;
mod deferred;
mod error;
pub mod frontend;
mod gyro_alignment;
pub mod imu;
pub mod initialization;
mod pipeline;
mod relocalization;
#[cfg(any(test, feature = "simulation"))]
pub mod simulate;
mod stages;
mod tracking;

pub use config::{ImuUse, OdometryConfig};
pub use error::OdometryError;
pub use pipeline::{
    CameraTiming, DivergenceSign, InputCounts, Joined, LossReason, Odometry, OdometryOutput, Status,
    TrackSummary, Tracking,
};
pub use relocalization::SavedMap;
pub use stages::{Stage, StageTimes};
pub use tracking::TrackRecord;

/// Bindings of other languages push from any thread: this does not compile if an odometry is tied to one.
const _: fn() = || {
    fn is_send<T: Send>() {}
    is_send::<Odometry>();
};
