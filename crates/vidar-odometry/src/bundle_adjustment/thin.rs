//! Long recordings: as many logged images as the memory of one adjustment takes.

use super::initial::MAX_OBSERVATIONS;
use super::log::{TrackKey, TrackLog};
use super::problem::FRAME_DIM;
use rustc_hash::FxHashMap;
use std::borrow::Cow;
use vidar_core::Duration;

/// Memory of one adjustment, bytes.
const MAX_BYTES: usize = 1 << 29;

/// System, factor and covariance.
const MATRICES: usize = 3;

/// Full rows of the calibration.
const BORDER: usize = 24;

/// An observation with its blocks of the normal equations.
const OBSERVATION_BYTES: usize = 384;

/// Distances between images that are tried, ms. Beyond 1.6 s tracks are too short to be seen three times.
const PERIODS_MS: [i64; 3] = [400, 800, 1600];

/// The log with all its images, or with images so far apart that they fit.
pub(super) fn bounded(log: &TrackLog) -> Cow<'_, TrackLog> {
    within(log, MAX_BYTES)
}

fn within(log: &TrackLog, bytes: usize) -> Cow<'_, TrackLog> {
    if bytes_of(log) <= bytes {
        return Cow::Borrowed(log);
    }
    let mut thinned = log.every(Duration::from_millis(PERIODS_MS[0]));
    for period in &PERIODS_MS[1..] {
        if bytes_of(&thinned) <= bytes {
            break;
        }
        thinned = log.every(Duration::from_millis(*period));
    }
    Cow::Owned(thinned)
}

/// What an adjustment of all logged images takes, about.
fn bytes_of(log: &TrackLog) -> usize {
    // First image and length of the part of each track that is one landmark.
    let mut parts: FxHashMap<TrackKey, (usize, usize)> = FxHashMap::default();
    let (mut states, mut observations) = (0, 0);
    for (k, image) in log.images.iter().enumerate() {
        let mut oldest = k;
        for seen in &image.observations {
            let part = parts.entry(seen.key).or_insert((k, 0));
            if part.1 == MAX_OBSERVATIONS {
                *part = (k, 0);
            }
            part.1 += 1;
            oldest = oldest.min(part.0);
        }
        states += k + 1 - oldest;
        observations += image.observations.len();
    }
    let values = FRAME_DIM * FRAME_DIM * states + BORDER * FRAME_DIM * log.images.len();
    MATRICES * size_of::<f64>() * values + OBSERVATION_BYTES * observations
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bundle_adjustment::log::LoggedState;
    use nalgebra::{Matrix2, Vector2};
    use vidar_core::{FrameId, LandmarkId, Timestamp};

    /// Images every 0.2 s; each track is seen in twenty of them.
    fn log(images: u32) -> TrackLog {
        let mut log = TrackLog::new(200.0);
        for k in 0..images {
            let pixel = Vector2::new(f64::from(k), 1.0);
            let shown = (k..k + 20).map(|track| (LandmarkId(track), &pixel, Matrix2::identity()));
            let stamp = Timestamp::from_nanos(i64::from(k) * 200_000_000);
            log.add_image(FrameId(k), (FrameId(k), stamp), None::<LoggedState>, shown);
        }
        log
    }

    #[test]
    fn a_short_recording_keeps_all_images() {
        let log = log(100);
        assert!(matches!(bounded(&log), Cow::Borrowed(_)));
    }

    #[test]
    fn a_long_one_keeps_images_further_apart_until_it_fits() {
        let log = log(1000);
        let all = bytes_of(&log);
        let half = within(&log, all / 2);
        assert_eq!(half.images.len(), 500);
        assert!(bytes_of(&half) < all / 2);
        let quarter = within(&log, all / 8);
        assert_eq!(quarter.images.len(), 250);
        // What does not fit at all is as thin as tracks allow.
        assert_eq!(within(&log, 1).images.len(), 125);
        assert_eq!(quarter.images[0].stamp, log.images[0].stamp);
    }
}
