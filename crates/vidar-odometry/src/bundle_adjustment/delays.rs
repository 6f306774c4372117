//! How much later than their stamps say images were exposed, where stamps scatter.

use super::log::TrackLog;
use super::problem::Problem;
use vidar_core::{FrameId, Timestamp};

/// Stamps that are farther than this share of the interval from where even spacing has them tell of images that are missing: where one of three is, the
/// others are a third off.
const UNEVEN: f64 = 0.3;
/// And so do stamps that are this far from there, s: four standard deviations of a delay. Of a stream the log keeps the stamps of keyframes alone.
const FARTHEST_SECS: f64 = 0.02;

/// Of every image whose stamp the log has, s; zero where stamps do not scatter. Those that took part have their own. A camera exposes images at even
/// intervals for as long as it takes from one of them to the next, so the instants of those between are spaced evenly; where an image is missing, their
/// delays are between the others'.
pub(super) fn of_images(log: &TrackLog, problem: &Problem, images: &[usize]) -> Vec<f64> {
    if problem.prior.image.delay.is_none() {
        return vec![0.0; log.stamps.len()];
    }
    let adjusted = images.iter().zip(&problem.frames);
    let own: Vec<(FrameId, f64)> =
        adjusted.map(|(image, frame)| (log.images[*image].caller_frame, frame.body.delay_secs)).collect();
    between(&log.stamps, &own)
}

/// `own` are delays of some of the images, in their order.
fn between(stamps: &[(FrameId, Timestamp)], own: &[(FrameId, f64)]) -> Vec<f64> {
    let mut known: Vec<(usize, f64)> = Vec::with_capacity(own.len());
    let mut rest = own.iter().peekable();
    for (k, (frame, _)) in stamps.iter().enumerate() {
        // Not every image that took part has its stamp there.
        while rest.next_if(|(own, _)| own < frame).is_some() {}
        known.extend(rest.next_if(|(own, _)| own == frame).map(|(_, delay)| (k, *delay)));
    }
    let Some((&first, &last)) = known.first().zip(known.last()) else { return vec![0.0; stamps.len()] };
    let mut delays = vec![first.1; stamps.len()];
    delays[last.0..].fill(last.1);
    for pair in known.windows(2) {
        let [(from, delay_from), (until, delay_until)] = [pair[0], pair[1]];
        let secs = |k: usize| (stamps[k].1 - stamps[from].1).as_secs_f64();
        let share = |k: usize| (k - from) as f64 / (until - from) as f64;
        let interval = (secs(until) + delay_until - delay_from) / (until - from) as f64;
        let even = |k: usize| delay_from + interval * (k - from) as f64 - secs(k);
        let linear = |k: usize| delay_from + share(k) * (delay_until - delay_from);
        let most = FARTHEST_SECS.min(UNEVEN * interval);
        let is_even = (from..until).all(|k| (even(k) - linear(k)).abs() < most);
        for k in from..until {
            delays[k] = if is_even { even(k) } else { linear(k) };
        }
    }
    delays
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(millis: &[i64]) -> Vec<(FrameId, Timestamp)> {
        let stamp = |(k, ms): (usize, &i64)| (FrameId(k as u32), Timestamp::from_nanos(ms * 1_000_000));
        millis.iter().enumerate().map(stamp).collect()
    }

    fn is_near(found: &[f64], millis: &[f64]) {
        assert_eq!(found.len(), millis.len());
        assert!(found.iter().zip(millis).all(|(f, ms)| (1e3 * f - ms).abs() < 1e-9), "{found:?}");
    }

    #[test]
    fn images_between_two_whose_delay_is_known_are_spaced_evenly() {
        // Exposed at 0, 30, 60, 90, 120 ms.
        let stamps = at(&[0, 34, 57, 90, 125]);
        let found = between(&stamps, &[(FrameId(0), 0.0), (FrameId(3), 0.0)]);
        is_near(&found, &[0.0, -4.0, 3.0, 0.0, 0.0]);
        let found = between(&stamps, &[(FrameId(1), -0.004), (FrameId(4), -0.005)]);
        is_near(&found, &[-4.0, -4.0, 3.0, 0.0, -5.0]);
    }

    #[test]
    fn where_images_are_missing_delays_lie_between_the_others() {
        // Exposed at 0, 30 and 120 ms: two are missing.
        let found = between(&at(&[0, 30, 120]), &[(FrameId(0), 0.002), (FrameId(2), 0.004)]);
        is_near(&found, &[2.0, 3.0, 4.0]);
        is_near(&between(&at(&[0, 30]), &[]), &[0.0, 0.0]);
        // Keyframes alone, a fifth of a second off an even spacing.
        let found = between(&at(&[0, 500, 1400]), &[(FrameId(0), 0.002), (FrameId(2), 0.004)]);
        is_near(&found, &[2.0, 3.0, 4.0]);
    }

    #[test]
    fn images_whose_stamps_are_not_kept_are_passed_over() {
        let stamps: Vec<_> = at(&[0, 30, 60, 90]).into_iter().filter(|(k, _)| k.0 != 1).collect();
        let own = [(FrameId(1), 0.009), (FrameId(2), 0.002), (FrameId(3), 0.003)];
        is_near(&between(&stamps, &own), &[2.0, 2.0, 3.0]);
    }
}
