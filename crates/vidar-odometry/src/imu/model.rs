//! The model of an IMU: biases, noise, and the limits of its ranges.

use nalgebra::Vector3;
use vidar_core::{GRAVITY_MPS2, ImuNoise};

/// Biases of an IMU.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Bias {
    /// Gyroscope, rad/s.
    pub gyro: Vector3<f64>,
    /// Accelerometer, m/s².
    pub accel: Vector3<f64>,
}

impl Bias {
    /// None at all.
    pub const ZERO: Self = Self { gyro: Vector3::new(0.0, 0.0, 0.0), accel: Vector3::new(0.0, 0.0, 0.0) };
}

/// White noise to assume while integrating.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepNoise {
    /// Gyroscope, rad/s/√Hz.
    pub gyro_density: f64,
    /// Accelerometer, m/s²/√Hz.
    pub accel_density: f64,
    /// Nominal time between IMU measurements, s; longer steps are gaps.
    pub period_secs: f64,
}

/// The IMU model of the estimator: densities as inflated for vibration, and the limits of its ranges.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImuModel {
    /// White noise.
    pub noise: StepNoise,
    /// Standard deviation of the gyroscope's gain per axis, relative.
    pub gyro_gain_std: f64,
    /// Gyroscope bias random walk, rad/s²/√Hz.
    pub gyro_walk: f64,
    /// Accelerometer bias random walk, m/s³/√Hz.
    pub accel_walk: f64,
    /// Rate at which the gyroscope saturates, rad/s.
    pub gyro_limit: f64,
    /// Specific force at which the accelerometer saturates, m/s².
    pub accel_limit: f64,
    /// Strength of gravity where the IMU is, m/s².
    pub gravity_mps2: f64,
}

/// Random walks below these are not realistic for a MEMS IMU.
const MIN_GYRO_WALK: f64 = 1e-5;
const MIN_ACCEL_WALK: f64 = 1e-3;

impl ImuModel {
    /// From a data sheet, white noise times `gyro_factor` and `accel_factor` (vibration, scale errors), walks floored.
    pub fn from_data_sheet(sheet: &ImuNoise, gyro_factor: f64, accel_factor: f64) -> Self {
        Self {
            noise: StepNoise {
                gyro_density: sheet.gyro_noise_density * gyro_factor,
                accel_density: sheet.accel_noise_density * accel_factor,
                period_secs: 1.0 / sheet.rate_hz.max(1.0),
            },
            gyro_gain_std: 0.0,
            gyro_walk: sheet.gyro_random_walk.max(MIN_GYRO_WALK),
            accel_walk: sheet.accel_random_walk.max(MIN_ACCEL_WALK),
            gyro_limit: 17.0,
            accel_limit: 170.0,
            gravity_mps2: GRAVITY_MPS2,
        }
    }

    /// The same with a gyroscope whose gain is uncertain by `std`, relative.
    #[must_use]
    pub const fn with_gyro_gain_std(self, std: f64) -> Self {
        Self { gyro_gain_std: std, ..self }
    }

    /// The same where gravity is `gravity_mps2` strong.
    #[must_use]
    pub const fn with_gravity(self, gravity_mps2: f64) -> Self {
        Self { gravity_mps2, ..self }
    }

    /// Gravity in the world, m/s².
    pub(crate) const fn gravity(&self) -> Vector3<f64> {
        Vector3::new(0.0, 0.0, -self.gravity_mps2)
    }
}
