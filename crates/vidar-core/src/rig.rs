//! The rigid set of cameras and the IMU.

use crate::camera::CameraModel;
use crate::id::CameraId;
use crate::lie::Se3;
use crate::time::Duration;
use serde::{Deserialize, Serialize};

/// One camera of the rig.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RigCamera {
    /// How it projects.
    pub model: CameraModel,
    /// Its pose on the body: maps points in the camera frame to the body (IMU) frame.
    pub body_from_camera: Se3,
    /// `t_imu = t_camera + time_offset`, as Kalibr's `timeshift_cam_imu`.
    pub time_offset: Duration,
    /// Nominal frame rate, Hz, where the calibration states it.
    pub rate_hz: Option<f64>,
}

impl RigCamera {
    /// Whether nothing says how it is mounted: its pose is the body's own, which readers assume and no device has.
    pub fn has_no_mount(&self) -> bool {
        self.body_from_camera == Se3::IDENTITY
    }
}

/// Continuous-time noise of an IMU, as Kalibr and EuRoC state it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImuNoise {
    /// Gyroscope white noise, rad/s/√Hz.
    pub gyro_noise_density: f64,
    /// Gyroscope bias random walk, rad/s²/√Hz.
    pub gyro_random_walk: f64,
    /// Accelerometer white noise, m/s²/√Hz.
    pub accel_noise_density: f64,
    /// Accelerometer bias random walk, m/s³/√Hz.
    pub accel_random_walk: f64,
    /// Nominal rate, Hz.
    pub rate_hz: f64,
}

impl ImuNoise {
    /// ADIS16448 as calibrated by EuRoC.
    pub const EUROC: Self = Self {
        gyro_noise_density: 1.6968e-4,
        gyro_random_walk: 1.9393e-5,
        accel_noise_density: 2.0e-3,
        accel_random_walk: 3.0e-3,
        rate_hz: 200.0,
    };
}

/// Cameras and IMU on one rigid body; the body frame is the IMU frame.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Rig {
    /// Cameras, indexed by [`CameraId`].
    pub cameras: Vec<RigCamera>,
    /// IMU noise, where there is an IMU.
    pub imu: Option<ImuNoise>,
}

impl Rig {
    /// The camera of that number, if the rig has it.
    pub fn camera(&self, id: CameraId) -> Option<&RigCamera> {
        self.cameras.get(id.index())
    }
}
