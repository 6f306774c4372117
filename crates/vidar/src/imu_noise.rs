//! What is believed of the IMU's noise: what a file states, unless the samples contradict it.
//!
//! Publishers inflate noise ten- or a hundredfold so that some filter holds, and loggers state none. An odometry that believes an inflated
//! noise throws the scale away: rendered slow phones with three times their noise had two to five times the error, with ten times no start.

use vidar_core::{ImuNoise, Warning};
use vidar_dataset::Recording;
use vidar_odometry::calibration::{SensorNoise, sensor_noise};

/// Bias walks, which half a minute does not show: those of consumer sensors.
const GYRO_RANDOM_WALK: f64 = 2e-5;
const ACCEL_RANDOM_WALK: f64 = 1e-3;
/// What is taken where the accelerometer's noise cannot be seen, m/s²/√Hz.
const UNSEEN_ACCEL_NOISE: f64 = 5e-3;
/// Bounds of what is believed of the data: no sensor in a hand is better, none that works is worse.
const GYRO_NOISE: (f64, f64) = (1e-4, 1e-2);
const ACCEL_NOISE: (f64, f64) = (1e-3, 0.1);

/// A file is contradicted above this multiple of what the samples show, and below one over it. EuRoC's MH_01, TUM-VI's rooms and rendered phones show 0.7 to 1.4 times
/// what their files state.
const CONTRADICTED: f64 = 2.0;
/// Walks above this multiple of a consumer sensor's are those of no sensor.
const MOST_WALK: f64 = 10.0;

/// Warnings of the readers where nobody states the noise, and of this module where the samples' is used instead.
const GUESSED: &str = "imu-noise";
const FROM_SAMPLES: &str = "imu-noise-from-samples";

/// Whether nobody states the noise.
pub(crate) fn is_guessed(dataset: &Recording) -> bool {
    dataset.warnings.iter().any(|w| [GUESSED, FROM_SAMPLES].contains(&w.kind.as_str()))
}

/// The noise that the samples show, and consumer sensors' bias walks.
pub(crate) fn believed_noise(seen: Option<SensorNoise>) -> ImuNoise {
    let (gyro, accel) = seen.map_or((GYRO_NOISE.0, 0.0), |n| (n.gyro, n.accel));
    let accel = if accel > 0.0 { accel } else { UNSEEN_ACCEL_NOISE };
    ImuNoise {
        gyro_noise_density: gyro.clamp(GYRO_NOISE.0, GYRO_NOISE.1),
        gyro_random_walk: GYRO_RANDOM_WALK,
        accel_noise_density: accel.clamp(ACCEL_NOISE.0, ACCEL_NOISE.1),
        accel_random_walk: ACCEL_RANDOM_WALK,
        rate_hz: seen.map_or(200.0, |n| n.rate_hz),
    }
}

/// Replaces noise that nobody stated, and noise that the samples contradict; warnings say so. Returns what the samples show.
pub(crate) fn settle(dataset: &mut Recording) -> Option<SensorNoise> {
    let seen = sensor_noise(&dataset.imu)?;
    settle_with(dataset, seen)
}

/// The same from the beginning of a recording, up to [`vidar_dataset::OPENING`] after its first image.
pub(crate) fn settle_of_opening(dataset: &mut Recording) -> Option<SensorNoise> {
    let until = dataset.images.first().map(|i| i.time + vidar_dataset::OPENING);
    let count = dataset.imu.partition_point(|s| until.is_none_or(|t| s.time <= t));
    let seen = sensor_noise(&dataset.imu[..count])?;
    settle_with(dataset, seen)
}

fn settle_with(dataset: &mut Recording, seen: SensorNoise) -> Option<SensorNoise> {
    if let Some(stated) = dataset.rig.imu {
        replace(dataset, &stated, seen);
    }
    Some(seen)
}

fn replace(dataset: &mut Recording, stated: &ImuNoise, seen: SensorNoise) {
    let shown = believed_noise(Some(seen));
    if is_guessed(dataset) {
        // What it said is used is not.
        dataset.warnings.retain(|w| w.kind != GUESSED);
        dataset.rig.imu = Some(ImuNoise { rate_hz: stated.rate_hz, ..shown });
        let message = format!("no noise of the IMU is stated; its samples show {}", densities(&shown));
        let warning = Warning::new(FROM_SAMPLES, message);
        dataset.warnings.push(warning.hint("a calibration of the IMU: --calibration imu.yaml (Kalibr)"));
        return;
    }
    let (settled, contradicted) = bounded(stated, &shown);
    if contradicted.is_empty() {
        return;
    }
    dataset.rig.imu = Some(settled);
    let message = format!(
        "the stated noise of the IMU is not that of its samples ({}): {}",
        densities(&shown),
        contradicted.join(", ")
    );
    dataset.warnings.push(Warning::new("imu-noise-contradicted", message).hint(
        "odometry.gyro_noise_factor and odometry.accel_noise_factor raise it where vibration is expected",
    ));
}

fn densities(noise: &ImuNoise) -> String {
    format!("{:.1e} rad/s/√Hz, {:.1e} m/s²/√Hz", noise.gyro_noise_density, noise.accel_noise_density)
}

/// The stated noise within what is believed, and what was changed.
fn bounded(stated: &ImuNoise, shown: &ImuNoise) -> (ImuNoise, Vec<String>) {
    let mut settled = *stated;
    let mut contradicted = Vec::new();
    let mut within = |value: &mut f64, [least, most]: [f64; 2], then: f64, what: &str| {
        if *value > most || *value < least {
            contradicted.push(format!("{what} {value:.1e} is taken as {then:.1e}"));
            *value = then;
        }
    };
    let mut density = |value: &mut f64, shown: f64, what: &str| {
        within(value, [shown / CONTRADICTED, shown * CONTRADICTED], shown, what);
    };
    density(&mut settled.gyro_noise_density, shown.gyro_noise_density, "gyroscope");
    density(&mut settled.accel_noise_density, shown.accel_noise_density, "accelerometer");
    let mut walk = |value: &mut f64, most: f64, what: &str| within(value, [0.0, most], most, what);
    walk(&mut settled.gyro_random_walk, MOST_WALK * GYRO_RANDOM_WALK, "bias walk of the gyroscope");
    walk(&mut settled.accel_random_walk, MOST_WALK * ACCEL_RANDOM_WALK, "bias walk of the accelerometer");
    (settled, contradicted)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn noise_that_the_samples_contradict_is_replaced_and_plausible_noise_stays() {
        let shown = believed_noise(Some(SensorNoise { gyro: 5e-4, accel: 5e-3, rate_hz: 200.0 }));
        let plausible = ImuNoise { gyro_noise_density: 9e-4, accel_noise_density: 3e-3, ..shown };
        assert_eq!(bounded(&plausible, &shown), (plausible, Vec::new()));
        let inflated = ImuNoise { accel_noise_density: 0.18, gyro_random_walk: 2e-3, ..plausible };
        let (settled, contradicted) = bounded(&inflated, &shown);
        let expected = ImuNoise { accel_noise_density: 5e-3, gyro_random_walk: 2e-4, ..plausible };
        assert_eq!((settled, contradicted.len()), (expected, 2), "{contradicted:?}");
        assert!(contradicted[0].contains("accelerometer 1.8e-1 is taken as 5.0e-3"), "{contradicted:?}");
        let optimistic = ImuNoise { gyro_noise_density: 1e-4, ..plausible };
        let (settled, contradicted) = bounded(&optimistic, &shown);
        assert_eq!((settled.gyro_noise_density, contradicted.len()), (5e-4, 1), "{contradicted:?}");
    }
}
