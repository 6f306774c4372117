//! When images are taken, and under which stamps they are written.

use crate::config::SynthConfig;
use crate::flight::FlightPath;
use crate::random::{Gaussian, Purpose, stream};
use crate::stamps;
use vidar_core::{Duration, Timestamp};

/// An image that is taken.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Shot {
    /// Time of the middle row at the middle of the exposure, s after the sequence's beginning, on the IMU's clock.
    pub secs: f64,
    /// Stamps under which the image is written: one, and one more for every repetition.
    pub stamps: Vec<Timestamp>,
}

/// The images of the sequence in order; at least one.
pub(crate) fn shots(config: &SynthConfig, path: &FlightPath) -> Vec<Shot> {
    let device = &config.device;
    let count = ((path.duration_secs() * config.camera_rate_hz - 1e-6).ceil().max(1.0)) as usize;
    let delay = Duration::from_secs_f64(device.stamp_delay_secs);
    let mut random = Gaussian::new(stream(config.seed, Purpose::Schedule));
    let mut shots: Vec<Shot> = Vec::with_capacity(count);
    for k in 0..count {
        let (mut time, mut secs) = stamps::stamp(k, config.camera_rate_hz);
        // Each frame draws three numbers, so that one setting does not change what another does.
        let (jitter, drop, repeat) = (random.next(), random.uniform(), random.uniform());
        if device.frame_jitter > 0.0 {
            // Within 0.4 of a period, so that the order stays.
            let periods = (device.frame_jitter * jitter).clamp(-0.4, 0.4);
            let moved = (secs + periods / config.camera_rate_hz).clamp(0.0, path.duration_secs());
            (time, secs) = stamps::stamp_at(moved);
        }
        if k > 0 && drop < device.dropped_frames {
            continue;
        }
        match shots.last_mut() {
            Some(previous) if repeat < device.repeated_frames => previous.stamps.push(time + delay),
            _ => shots.push(Shot { secs, stamps: vec![time + delay] }),
        }
    }
    scatter(config, &mut shots);
    shots
}

/// Share of the variance of a stamp's error that is the image's own, and how long the rest lasts, s.
const OWN_SHARE: f64 = 0.4;
const LASTING_SECS: f64 = 1.0;
/// Stamps rise by this much at least.
const LEAST_STEP: Duration = Duration::from_millis(1);

/// Stamps of when images arrived.
fn scatter(config: &SynthConfig, shots: &mut [Shot]) {
    let sigma = config.device.stamp_scatter_secs;
    if sigma == 0.0 {
        return;
    }
    let mut random = Gaussian::new(stream(config.seed, Purpose::StampErrors));
    let (mut lasting, mut last): (f64, Option<(Timestamp, Timestamp)>) = (random.next(), None);
    for stamp in shots.iter_mut().flat_map(|s| &mut s.stamps) {
        let exact = *stamp;
        if let Some((before, _)) = last {
            let share = (-(exact - before).as_secs_f64() / LASTING_SECS).exp();
            lasting = share * lasting + (1.0 - share * share).sqrt() * random.next();
        }
        let error = OWN_SHARE.sqrt() * random.next() + (1.0 - OWN_SHARE).sqrt() * lasting;
        *stamp = exact + Duration::from_secs_f64(sigma * error);
        if let Some((_, written)) = last {
            *stamp = (*stamp).max(written + LEAST_STEP);
        }
        last = Some((exact, *stamp));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::DeviceConfig;

    fn shots_of(device: DeviceConfig) -> Vec<Shot> {
        let config =
            SynthConfig { duration_secs: 20.0, camera_rate_hz: 30.0, device, ..SynthConfig::default() };
        shots(&config, &FlightPath::built_in(&config).unwrap())
    }

    #[test]
    fn stamps_are_late_by_the_delay_and_times_are_not() {
        let exact = shots_of(DeviceConfig::default());
        let late = shots_of(DeviceConfig { stamp_delay_secs: 0.025, ..Default::default() });
        assert_eq!(exact.len(), 600);
        for (a, b) in exact.iter().zip(&late) {
            assert_eq!(a.secs, b.secs);
            assert_eq!((b.stamps[0] - a.stamps[0]).nanos(), 25_000_000);
            assert_eq!(stamps::secs(a.stamps[0]), a.secs);
        }
    }

    #[test]
    fn stamps_scatter_as_asked_and_times_do_not() {
        let exact = shots_of(DeviceConfig::default());
        let scattered = shots_of(DeviceConfig { stamp_scatter_secs: 0.004, ..Default::default() });
        let off = |(a, b): (&Shot, &Shot)| (b.stamps[0] - a.stamps[0]).as_secs_f64();
        let errors: Vec<f64> = exact.iter().zip(&scattered).map(off).collect();
        assert!(exact.iter().zip(&scattered).all(|(a, b)| a.secs == b.secs));
        assert!(scattered.windows(2).all(|w| w[0].stamps[0] < w[1].stamps[0]), "stamps rise");
        let mean = |values: &mut dyn Iterator<Item = f64>| values.sum::<f64>() / errors.len() as f64;
        let variance = mean(&mut errors.iter().map(|e| e * e));
        assert!((0.0028..0.0052).contains(&variance.sqrt()), "{}", variance.sqrt());
        let correlation = mean(&mut errors.windows(2).map(|w| w[0] * w[1])) / variance;
        assert!((0.3..0.75).contains(&correlation), "{correlation}");
    }

    #[test]
    fn jittered_dropped_and_repeated_frames_have_the_asked_shares_and_rising_stamps() {
        let device = DeviceConfig {
            frame_jitter: 0.1,
            dropped_frames: 0.1,
            repeated_frames: 0.2,
            ..Default::default()
        };
        let shots = shots_of(device);
        let stamps: Vec<Timestamp> = shots.iter().flat_map(|s| s.stamps.clone()).collect();
        assert!(stamps.windows(2).all(|w| w[0] < w[1]), "stamps rise");
        assert!((500..580).contains(&stamps.len()), "{} of 600 frames", stamps.len());
        let repeated = stamps.len() - shots.len();
        assert!((75..145).contains(&repeated), "{repeated} repeated");
        let off: Vec<f64> = shots.iter().map(|s| (s.secs * 30.0 - (s.secs * 30.0).round()).abs()).collect();
        let rms = (off.iter().map(|o| o * o).sum::<f64>() / off.len() as f64).sqrt();
        assert!((0.085..0.115).contains(&rms), "jitter of {rms} periods");
    }
}
