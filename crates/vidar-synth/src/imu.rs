//! The inertial measurement unit: exact motion plus the noise of its data sheet.
//!
//! Discretisation of the continuous-time model (Kalibr's IMU noise model): white noise of density σ becomes
//! `σ / √dt` per sample, a bias of random walk σ_b moves by `σ_b · √dt` between samples.

use crate::config::SynthConfig;
use crate::device::ImuTiming;
use crate::flight::FlightPath;
use crate::random::{Gaussian, Purpose, stream};
use crate::stamps::{secs, stamp, stamp_at};
use nalgebra::Vector3;
use vidar_core::{AngularRate, ImuSample, SpecificForce, Timestamp};

/// Simulated IMU samples and the biases in them.
#[derive(Clone, Debug, PartialEq)]
pub struct ImuRecord {
    /// Samples from the sequence's beginning to its end; evenly spaced unless `device.imu_timing` says otherwise.
    pub samples: Vec<ImuSample>,
    /// True gyroscope bias of each sample, rad/s.
    pub gyro_bias: Vec<Vector3<f64>>,
    /// True accelerometer bias of each sample, m/s².
    pub accel_bias: Vec<Vector3<f64>>,
}

/// What the IMU of `config` measures on `flight`.
pub fn simulate_imu(flight: &FlightPath, config: &SynthConfig) -> ImuRecord {
    let rate_hz = config.imu_rate_hz;
    let instants = |rate_hz: f64| {
        let n = (flight.duration_secs() * rate_hz + 1e-6).floor() as usize + 1;
        (0..n).map(move |k| stamp(k, rate_hz))
    };
    let record = match config.device.imu_timing {
        ImuTiming::Regular => measure(flight, config, instants(rate_hz), Purpose::Imu),
        ImuTiming::Jittered => {
            let mut random = Gaussian::new(stream(config.seed, Purpose::ImuTiming));
            let jittered = instants(rate_hz).map(|(_, secs)| {
                let periods = (0.05 * random.next()).clamp(-0.2, 0.2);
                stamp_at((secs + periods / rate_hz).clamp(0.0, flight.duration_secs()))
            });
            measure(flight, config, jittered, Purpose::Imu).with_repeated_rows(config)
        }
        ImuTiming::Interleaved => {
            let gyro = measure(flight, config, instants(rate_hz), Purpose::Imu);
            let accel = measure(flight, config, instants(rate_hz * CLOCK_RATIO), Purpose::ImuAccel);
            interleave(&gyro, &accel)
        }
    };
    record.without_gaps(flight, config)
}

/// Ratio of the accelerometer's rate to the gyroscope's where they have clocks of their own.
const CLOCK_RATIO: f64 = 1.003;

/// One row in so many is written twice by a jittered IMU.
const ROWS_PER_REPEAT: usize = 500;

/// Samples at the given instants (stamp, and seconds after the beginning).
fn measure(
    flight: &FlightPath,
    config: &SynthConfig,
    instants: impl Iterator<Item = (Timestamp, f64)>,
    purpose: Purpose,
) -> ImuRecord {
    let mut random = Gaussian::new(stream(config.seed, purpose));
    let scale = config.imu_noise_scale;
    let noise = &config.imu_noise;
    let root_rate = config.imu_rate_hz.sqrt();
    let [gyro_scale, accel_scale] = config.imu_scale();
    let mut record = ImuRecord { samples: Vec::new(), gyro_bias: Vec::new(), accel_bias: Vec::new() };
    let mut gyro_bias = random.vector() * (scale * config.initial_gyro_bias_rad_per_s);
    let mut accel_bias = random.vector() * (scale * config.initial_accel_bias_m_per_s2);
    for (time, secs) in instants {
        let gyro_noise = random.vector() * (scale * noise.gyro_noise_density * root_rate);
        let accel_noise = random.vector() * (scale * noise.accel_noise_density * root_rate);
        let rate = flight.state(secs).angular_rate.component_mul(&gyro_scale);
        let force = flight.specific_force(secs).component_mul(&accel_scale);
        let (gyro, accel) = (rate + gyro_bias + gyro_noise, force + accel_bias + accel_noise);
        record.samples.push(ImuSample { time, gyro: AngularRate(gyro), accel: SpecificForce(accel) });
        record.gyro_bias.push(gyro_bias);
        record.accel_bias.push(accel_bias);
        gyro_bias += random.vector() * (scale * noise.gyro_random_walk / root_rate);
        accel_bias += random.vector() * (scale * noise.accel_random_walk / root_rate);
    }
    record
}

impl ImuRecord {
    fn push(&mut self, sample: ImuSample, gyro_bias: Vector3<f64>, accel_bias: Vector3<f64>) {
        self.samples.push(sample);
        self.gyro_bias.push(gyro_bias);
        self.accel_bias.push(accel_bias);
    }

    /// The rows for which `copies` is 1 once, those for which it is 2 twice, without those for which it is 0.
    fn copied(&self, mut copies: impl FnMut(&ImuSample) -> usize) -> Self {
        let mut record = Self { samples: Vec::new(), gyro_bias: Vec::new(), accel_bias: Vec::new() };
        for (k, sample) in self.samples.iter().enumerate() {
            for _ in 0..copies(sample) {
                record.push(*sample, self.gyro_bias[k], self.accel_bias[k]);
            }
        }
        record
    }

    fn with_repeated_rows(&self, config: &SynthConfig) -> Self {
        let mut random = Gaussian::new(stream(config.seed, Purpose::ImuRepeats));
        self.copied(|_| if random.uniform() * (ROWS_PER_REPEAT as f64) < 1.0 { 2 } else { 1 })
    }

    /// Leaves out the samples of the gaps that `config` asks for. None begins in the first second.
    fn without_gaps(self, flight: &FlightPath, config: &SynthConfig) -> Self {
        let wanted = (config.device.imu_gaps_per_min * flight.duration_secs() / 60.0).round() as usize;
        let latest = flight.duration_secs() - 0.1;
        if wanted == 0 || latest <= 1.0 {
            return self;
        }
        let mut random = Gaussian::new(stream(config.seed, Purpose::ImuGaps));
        let gaps: Vec<[f64; 2]> = (0..wanted)
            .map(|_| {
                let begin = 1.0 + (latest - 1.0) * random.uniform();
                [begin, begin + 0.02 + 0.03 * random.uniform()]
            })
            .collect();
        let in_gap = |secs: f64| gaps.iter().any(|[begin, end]| (*begin..*end).contains(&secs));
        self.copied(|sample| usize::from(!in_gap(secs(sample.time))))
    }
}

/// A row for every sample of either sensor; the other one is linearly interpolated, and held at the ends.
fn interleave(gyro: &ImuRecord, accel: &ImuRecord) -> ImuRecord {
    let mut record = ImuRecord { samples: Vec::new(), gyro_bias: Vec::new(), accel_bias: Vec::new() };
    let mut times: Vec<Timestamp> = gyro.samples.iter().chain(&accel.samples).map(|s| s.time).collect();
    times.sort_unstable();
    times.dedup();
    let at = |samples: &[ImuSample], time: Timestamp| {
        let later = samples.partition_point(|s| s.time < time).min(samples.len() - 1);
        let earlier = if samples[later].time <= time { later } else { later.saturating_sub(1) };
        let span = (samples[later].time - samples[earlier].time).as_secs_f64();
        let share = if span > 0.0 { (time - samples[earlier].time).as_secs_f64() / span } else { 0.0 };
        (earlier, later, share)
    };
    for time in times {
        let (g0, g1, g) = at(&gyro.samples, time);
        let (a0, a1, a) = at(&accel.samples, time);
        let rate = gyro.samples[g0].gyro.0.lerp(&gyro.samples[g1].gyro.0, g);
        let force = accel.samples[a0].accel.0.lerp(&accel.samples[a1].accel.0, a);
        let sample = ImuSample { time, gyro: AngularRate(rate), accel: SpecificForce(force) };
        record.push(sample, gyro.gyro_bias[g0], accel.accel_bias[a0]);
    }
    record
}
