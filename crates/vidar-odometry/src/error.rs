//! Errors of the odometry. A lost track is an outcome, not an error.

use thiserror::Error;
use vidar_core::CameraId;

/// An invalid rig, configuration or event.
#[derive(Clone, Debug, PartialEq, Error)]
#[non_exhaustive]
pub enum OdometryError {
    /// A setting is out of its range.
    #[error("odometry setting {key}: expected {expected}, found {found}")]
    BadConfig {
        /// The field of `OdometryConfig`.
        key: &'static str,
        /// Its domain.
        expected: &'static str,
        /// Its value.
        found: f64,
    },
    /// The rig has no such camera.
    #[error("the rig has no camera {0}")]
    NoSuchCamera(CameraId),
    /// The rig has no IMU although the configuration requires one.
    #[error("the rig has no IMU, and `imu = \"required\"`")]
    NoImu,
    /// The rig's calibration cannot be true.
    #[error("calibration: {what} is {found}, expected {expected}")]
    BadCalibration {
        /// Which value.
        what: &'static str,
        /// What was found.
        found: f64,
        /// What can be.
        expected: &'static str,
    },
    /// An image is not of its camera's size.
    #[error("image is {found_width}x{found_height}, the camera's model is for {width}x{height}")]
    WrongImageSize {
        /// Columns expected.
        width: usize,
        /// Rows expected.
        height: usize,
        /// Columns found.
        found_width: usize,
        /// Rows found.
        found_height: usize,
    },
}
