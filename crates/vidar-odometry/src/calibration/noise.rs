//! White noise of the sensors from the recording itself.
//!
//! Third differences of means over 10 ms leave of a hand's motion next to nothing (of 2 Hz two thousandths, of 5 Hz three
//! hundredths) and of white noise a known multiple. Means over 10 ms are used because some recordings write interpolated
//! rows, whose neighbours differ by less than the sensor's noise. The quiet quarter of all half seconds counts: impacts and
//! vibration are no noise of the sensor. What an estimator has to reckon with is the loud tenth.

use nalgebra::Vector3;
use vidar_core::ImuSample;

/// Length of a mean, s.
const BLOCK_SECS: f64 = 0.01;
/// Third differences of a stretch.
const STRETCH: usize = 50;
/// Which stretch counts, of all in the order of their noise: for the sensor's own, and with vibration.
const QUIET: f64 = 0.25;
const LOUD: f64 = 0.9;
/// Stretches that an answer needs: two seconds.
const MIN_STRETCHES: usize = 4;
/// Variance of a third difference of white noise, in units of its variance: 1 + 9 + 9 + 1.
const GAIN: f64 = 20.0;

/// Noise densities as the data show them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SensorNoise {
    /// Gyroscope, rad/s/√Hz.
    pub gyro: f64,
    /// Accelerometer, m/s²/√Hz; zero where its samples do not change.
    pub accel: f64,
    /// Samples per second.
    pub rate_hz: f64,
}

/// Noise of both sensors. `None` for less than two seconds of samples, or times that do not increase.
pub fn sensor_noise(samples: &[ImuSample]) -> Option<SensorNoise> {
    noise_of(samples, QUIET)
}

/// The same with vibration: nine tenths of the half seconds have less.
pub(crate) fn loud_noise(samples: &[ImuSample]) -> Option<SensorNoise> {
    noise_of(samples, LOUD)
}

fn noise_of(samples: &[ImuSample], quantile: f64) -> Option<SensorNoise> {
    let (first, last) = (samples.first()?.time, samples.last()?.time);
    let span = (last - first).as_secs_f64();
    let rate_hz = (samples.len() - 1) as f64 / span;
    if !(rate_hz.is_finite() && rate_hz > 5.0) {
        return None;
    }
    // At low rates a block is a single sample.
    let per_block = (BLOCK_SECS * rate_hz).round().max(1.0) as usize;
    let block_secs = per_block as f64 / rate_hz;
    let density = |value: fn(&ImuSample) -> Vector3<f64>| {
        let blocks: Vec<Vector3<f64>> = samples
            .chunks_exact(per_block)
            .map(|c| c.iter().map(value).sum::<Vector3<f64>>() / per_block as f64)
            .collect();
        let differences: Vec<f64> = blocks
            .windows(4)
            .map(|b| (b[3] - 3.0 * b[2] + 3.0 * b[1] - b[0]).norm_squared() / (3.0 * GAIN))
            .collect();
        let mut variances: Vec<f64> = differences
            .chunks_exact(STRETCH)
            .map(|s| s.iter().sum::<f64>() / STRETCH as f64)
            .filter(|v| v.is_finite())
            .collect();
        variances.sort_by(f64::total_cmp);
        let chosen = *variances.get((quantile * variances.len() as f64) as usize)?;
        (variances.len() >= MIN_STRETCHES).then(|| (chosen * block_secs).sqrt())
    };
    let accel = density(|s| s.accel.0)?;
    // Rounding of sums is no noise.
    let accel = if accel > 1e-9 { accel } else { 0.0 };
    Some(SensorNoise { gyro: density(|s| s.gyro.0)?, accel, rate_hz })
}
