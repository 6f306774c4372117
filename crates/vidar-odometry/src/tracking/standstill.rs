//! Standstill detection from images and from the IMU.

use super::track::Track;
use crate::imu::StepNoise;
use nalgebra::{Vector2, Vector3};
use rustc_hash::FxHashMap;
use vidar_core::{Duration, FrameId, ImuSample, LandmarkId, Timestamp, camera::Pixel};
use vidar_solve::statistics::median_upper;

/// Median motion since the body is thought to stand that is still standing, pixels: along both axes, away from the middle
/// of the tracks and around it. Noise of single tracks cancels.
const STILL_SHIFT_PX: f64 = 0.4;
/// Median length of the motion of single tracks, their noise included, pixels: what moves differently everywhere.
const STILL_PX: f64 = 1.2;
/// How long images must show it, s, and how many of them.
const STILL_SECS: f64 = 0.4;
const STILL_FRAMES: u32 = 4;
/// Tracks that are needed to say so.
const STILL_TRACKS: usize = 10;
/// Standard deviations within which IMU measurements of a resting IMU stay, unless its own noise is stronger, rad/s and m/s².
const STILL_GYRO: f64 = 0.02;
const STILL_ACCEL: f64 = 0.15;

/// Motion of tracks since the body was last seen to move.
///
/// Standstill is evaluated against one image in the past, not from image to image, so that slow motion is detected. When most
/// of that image's tracks have been lost, those that began since join with the place where they are then: a rest does not end with its tracks.
#[derive(Clone, Debug, Default)]
pub(crate) struct ImageMotion {
    reference: FxHashMap<LandmarkId, Pixel>,
    since: Option<Timestamp>,
    frames: u32,
    /// Place before and motion of every track that was there before.
    moved: Vec<(Pixel, Vector2<f64>)>,
    values: Vec<f64>,
}

/// Tracks that `frame` shows, with their places.
pub(crate) fn tracks_in(
    tracks: &[Track],
    frame: FrameId,
) -> impl Iterator<Item = (LandmarkId, Pixel)> + Clone + '_ {
    tracks.iter().filter(move |t| t.last_frame == frame).map(|t| (t.id, t.last_pixel))
}

impl ImageMotion {
    /// Takes the tracks as measured in the image at `time`; whether the images have been still for a while.
    pub fn update(
        &mut self,
        seen: impl Iterator<Item = (LandmarkId, Pixel)> + Clone,
        time: Timestamp,
    ) -> bool {
        self.moved.clear();
        for (id, pixel) in seen.clone() {
            if let Some(before) = self.reference.get(&id) {
                self.moved.push((*before, pixel - before));
            }
        }
        let (Some(since), true) = (self.since, self.stands()) else {
            self.begin(seen, time);
            return false;
        };
        self.renew_reference(seen);
        self.frames += 1;
        self.frames >= STILL_FRAMES && (time - since).as_secs_f64() >= STILL_SECS
    }

    /// The body is known to stand at `time`.
    pub fn stand(&mut self, seen: impl Iterator<Item = (LandmarkId, Pixel)>, time: Timestamp) {
        self.begin(seen, time);
        self.since = Some(time - Duration::from_secs_f64(STILL_SECS));
        self.frames = STILL_FRAMES;
    }

    /// Tracks that are new join the reference once fewer than half of those seen are in it.
    fn renew_reference(&mut self, seen: impl Iterator<Item = (LandmarkId, Pixel)> + Clone) {
        if 2 * self.moved.len() >= seen.clone().count() {
            return;
        }
        let places =
            seen.map(|(id, pixel)| (id, self.reference.get(&id).copied().unwrap_or(pixel))).collect();
        self.reference = places;
    }

    fn begin(&mut self, seen: impl Iterator<Item = (LandmarkId, Pixel)>, time: Timestamp) {
        self.reference.clear();
        self.reference.extend(seen);
        (self.since, self.frames) = (Some(time), 0);
    }

    fn stands(&mut self) -> bool {
        if self.moved.len() < STILL_TRACKS {
            return false;
        }
        let middle = self.moved.iter().map(|m| m.0).sum::<Vector2<f64>>() / self.moved.len() as f64;
        let outward = |(at, _): &(Pixel, Vector2<f64>)| (at - middle).try_normalize(1.0).unwrap_or_default();
        type Measure<'a> = &'a dyn Fn(&(Pixel, Vector2<f64>)) -> f64;
        let around = |m: &(Pixel, Vector2<f64>)| outward(m).perp(&m.1);
        let shifts: [Measure<'_>; 4] = [&|m| m.1.x, &|m| m.1.y, &|m| outward(m).dot(&m.1), &around];
        let (moved, values) = (&self.moved, &mut self.values);
        let mut median = |of: Measure<'_>| {
            values.clear();
            values.extend(moved.iter().map(of));
            // Not empty: as many values as tracks.
            median_upper(values).unwrap_or(f64::INFINITY)
        };
        shifts.into_iter().all(|of| median(of).abs() < STILL_SHIFT_PX) && median(&|m| m.1.norm()) < STILL_PX
    }
}

/// Mean and standard deviation of IMU measurements over a span.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ImuStatistics {
    pub mean_gyro: Vector3<f64>,
    pub mean_accel: Vector3<f64>,
    pub std_gyro: f64,
    pub std_accel: f64,
    pub samples: usize,
}

impl ImuStatistics {
    pub fn of<'a>(samples: impl Iterator<Item = &'a ImuSample>) -> Self {
        let (mut n, mut gyro, mut accel) = (0.0_f64, Vector3::zeros(), Vector3::zeros());
        let (mut gyro2, mut accel2) = (0.0, 0.0);
        // Sums relative to the first sample keep their precision.
        let mut origin: Option<&ImuSample> = None;
        for sample in samples {
            let first = *origin.get_or_insert(sample);
            let (g, a) = (sample.gyro.0 - first.gyro.0, sample.accel.0 - first.accel.0);
            n += 1.0;
            gyro += g;
            accel += a;
            gyro2 += g.norm_squared();
            accel2 += a.norm_squared();
        }
        let scale = 1.0 / n.max(1.0);
        let (gyro, accel) = (gyro * scale, accel * scale);
        let zero = Vector3::zeros();
        Self {
            mean_gyro: gyro + origin.map_or(zero, |s| s.gyro.0),
            mean_accel: accel + origin.map_or(zero, |s| s.accel.0),
            std_gyro: (gyro2 * scale - gyro.norm_squared()).max(0.0).sqrt(),
            std_accel: (accel2 * scale - accel.norm_squared()).max(0.0).sqrt(),
            samples: n as usize,
        }
    }

    /// Whether the IMU measurements scatter no more than those of a body at rest.
    pub fn is_still(&self, noise: &StepNoise) -> bool {
        // Standard deviation of the length of three axes of white noise.
        let white = |density: f64| density * (3.0 / noise.period_secs.max(1e-4)).sqrt();
        let gyro = STILL_GYRO.max(white(noise.gyro_density));
        let accel = STILL_ACCEL.max(white(noise.accel_density));
        self.samples >= 10 && self.std_gyro < gyro && self.std_accel < accel
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulate::Random;

    /// Whether 60 tracks with noise of `sigma` pixels are reported as still after a second of `motion` (pixels per second at
    /// a place, from the middle).
    fn is_still(sigma: f64, motion: impl Fn(Vector2<f64>) -> Vector2<f64>) -> bool {
        let mut random = Random::new(5);
        let mut images = ImageMotion::default();
        let places: Vec<Vector2<f64>> = (0..60)
            .map(|k| Vector2::new(100.0 * f64::from(k % 10) - 450.0, 80.0 * f64::from(k / 10) - 200.0))
            .collect();
        let mut still = false;
        for frame in 0..21_i64 {
            let secs = frame as f64 * 0.05;
            let seen: Vec<(LandmarkId, Pixel)> = places
                .iter()
                .enumerate()
                .map(|(k, p)| {
                    let noise = Vector2::new(random.normal(), random.normal()) * sigma;
                    (LandmarkId(k as u32), p + motion(*p) * secs + noise)
                })
                .collect();
            still = images.update(seen.into_iter(), Timestamp::from_nanos(frame * 50_000_000));
        }
        still
    }

    #[test]
    fn noise_is_still_and_every_kind_of_motion_is_not() {
        for sigma in [0.1, 0.3, 0.5] {
            assert!(is_still(sigma, |_| Vector2::zeros()), "{sigma}");
            assert!(!is_still(sigma, |_| Vector2::new(3.0, 0.0)), "{sigma} sideways");
            assert!(!is_still(sigma, |p| p * 0.02), "{sigma} ahead");
            assert!(!is_still(sigma, |p| Vector2::new(-p.y, p.x) * 0.02), "{sigma} about the axis");
        }
    }

    #[test]
    fn a_rest_outlasts_its_tracks_and_is_left_as_soon_as_the_body_moves() {
        let (mut random, mut images) = (Random::new(3), ImageMotion::default());
        // Every image loses one of 60 tracks and has a new one: none is in the 61st that was in the first.
        let mut seen_at = |k: u32, shift: f64| {
            let tracks = (k..k + 60).map(|id| {
                let noise = Vector2::new(random.normal(), random.normal()) * 0.3;
                let place = Vector2::new(f64::from(id * 37 % 600), f64::from(id * 91 % 400));
                (LandmarkId(id), place + Vector2::new(shift, 0.0) + noise)
            });
            let seen: Vec<(LandmarkId, Pixel)> = tracks.collect();
            images.update(seen.into_iter(), Timestamp::from_nanos(i64::from(k) * 50_000_000))
        };
        let still: Vec<bool> = (0..200).map(|k| seen_at(k, 0.0)).collect();
        assert!(still[10..].iter().all(|s| *s), "{still:?}");
        assert!((200..210).any(|k| !seen_at(k, 0.1 * f64::from(k - 199))));
    }
}
