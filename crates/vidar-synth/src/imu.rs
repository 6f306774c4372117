//! The inertial measurement unit: exact motion plus the noise of its data sheet.
//!
//! Discretisation of the continuous-time model (Kalibr's IMU noise model): white noise of density σ becomes
//! `σ / √dt` per sample, a bias of random walk σ_b moves by `σ_b · √dt` between samples.

use crate::config::SynthConfig;
use crate::flight::FlightPath;
use crate::layout::stamp;
use crate::random::{Gaussian, Purpose, stream};
use nalgebra::Vector3;
use vidar_core::{AngularRate, ImuSample, SpecificForce};

/// Simulated readings and the biases in them.
#[derive(Clone, Debug, PartialEq)]
pub struct ImuRecord {
    /// Readings at the IMU's rate, from the sequence's beginning to its end.
    pub samples: Vec<ImuSample>,
    /// True gyroscope bias of each reading, rad/s.
    pub gyro_bias: Vec<Vector3<f64>>,
    /// True accelerometer bias of each reading, m/s².
    pub accel_bias: Vec<Vector3<f64>>,
}

/// What the IMU of `config` reads on `flight`.
pub fn simulate_imu(flight: &FlightPath, config: &SynthConfig) -> ImuRecord {
    let mut random = Gaussian::new(stream(config.seed, Purpose::Imu));
    let scale = config.imu_noise_scale;
    let noise = &config.imu_noise;
    let root_rate = config.imu_rate_hz.sqrt();
    let n = (flight.duration_secs() * config.imu_rate_hz + 1e-6).floor() as usize + 1;
    let mut record = ImuRecord { samples: Vec::new(), gyro_bias: Vec::new(), accel_bias: Vec::new() };
    let mut gyro_bias = random.vector() * (scale * config.initial_gyro_bias_rad_per_s);
    let mut accel_bias = random.vector() * (scale * config.initial_accel_bias_m_per_s2);
    for k in 0..n {
        let (time, secs) = stamp(k, config.imu_rate_hz);
        let gyro_noise = random.vector() * (scale * noise.gyro_noise_density * root_rate);
        let accel_noise = random.vector() * (scale * noise.accel_noise_density * root_rate);
        let gyro = flight.state(secs).angular_rate + gyro_bias + gyro_noise;
        let accel = flight.specific_force(secs) + accel_bias + accel_noise;
        record.samples.push(ImuSample { time, gyro: AngularRate(gyro), accel: SpecificForce(accel) });
        record.gyro_bias.push(gyro_bias);
        record.accel_bias.push(accel_bias);
        gyro_bias += random.vector() * (scale * noise.gyro_random_walk / root_rate);
        accel_bias += random.vector() * (scale * noise.accel_random_walk / root_rate);
    }
    record
}
