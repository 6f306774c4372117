//! Whether the camera stands still, told from images and from the IMU.

use super::track::Track;
use crate::imu::StepNoise;
use nalgebra::Vector3;
use rustc_hash::FxHashMap;
use vidar_core::{Duration, FrameId, ImuSample, LandmarkId, Timestamp, camera::Pixel};

/// Median motion since the body is thought to stand, per axis, that is still standing, pixels: noise of
/// single tracks cancels.
const STILL_SHIFT_PX: f64 = 0.4;
/// Median length of the motion of single tracks, their noise included, pixels: motion along the axis of the camera.
const STILL_PX: f64 = 0.8;
/// How long images must show it, s, and how many of them.
const STILL_SECS: f64 = 0.4;
const STILL_FRAMES: u32 = 4;
/// Tracks that are needed to say so.
const STILL_TRACKS: usize = 10;
/// Standard deviations within which readings of a resting IMU stay, unless its own noise is stronger, rad/s and m/s².
const STILL_GYRO: f64 = 0.02;
const STILL_ACCEL: f64 = 0.15;

/// Motion of tracks since the body was last seen to move.
///
/// Standing is judged against one place in the past, not from image to image: what creeps slowly gets away from it.
#[derive(Debug, Default)]
pub(crate) struct ImageMotion {
    reference: FxHashMap<LandmarkId, Pixel>,
    since: Option<Timestamp>,
    frames: u32,
    moved: Vec<[f64; 3]>,
}

impl ImageMotion {
    /// Takes the tracks as measured in `frame` at `time`; whether the images have been still for a while.
    pub fn update(&mut self, tracks: &[Track], frame: FrameId, time: Timestamp) -> bool {
        self.moved.clear();
        for track in tracks.iter().filter(|t| t.last_frame == frame) {
            if let Some(before) = self.reference.get(&track.id) {
                let d = track.last_pixel - before;
                self.moved.push([d.x, d.y, d.norm()]);
            }
        }
        let (Some(since), true) = (self.since, self.stands()) else {
            self.begin(tracks, frame, time);
            return false;
        };
        self.frames += 1;
        self.frames >= STILL_FRAMES && (time - since).as_secs_f64() >= STILL_SECS
    }

    /// The body is known to stand at `frame`.
    pub fn stand(&mut self, tracks: &[Track], frame: FrameId, time: Timestamp) {
        self.begin(tracks, frame, time);
        self.since = Some(time - Duration::from_secs_f64(STILL_SECS));
        self.frames = STILL_FRAMES;
    }

    fn begin(&mut self, tracks: &[Track], frame: FrameId, time: Timestamp) {
        self.reference.clear();
        self.reference.extend(tracks.iter().filter(|t| t.last_frame == frame).map(|t| (t.id, t.last_pixel)));
        (self.since, self.frames) = (Some(time), 0);
    }

    fn stands(&mut self) -> bool {
        if self.moved.len() < STILL_TRACKS {
            return false;
        }
        let middle = self.moved.len() / 2;
        let mut median = |axis: usize| {
            self.moved.select_nth_unstable_by(middle, |a, b| a[axis].total_cmp(&b[axis])).1[axis]
        };
        let [x, y, length] = [median(0), median(1), median(2)];
        x.abs() < STILL_SHIFT_PX && y.abs() < STILL_SHIFT_PX && length < STILL_PX
    }
}

/// Mean and standard deviation of readings over a span.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ImuSpread {
    pub mean_gyro: Vector3<f64>,
    pub mean_accel: Vector3<f64>,
    pub std_gyro: f64,
    pub std_accel: f64,
    pub samples: usize,
}

impl ImuSpread {
    pub fn of<'a>(samples: impl Iterator<Item = &'a ImuSample>) -> Self {
        let (mut n, mut gyro, mut accel) = (0.0_f64, Vector3::zeros(), Vector3::zeros());
        let (mut gyro2, mut accel2) = (0.0, 0.0);
        // Sums about the first reading keep their digits.
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

    /// Whether the readings scatter no more than those of a body at rest.
    pub fn is_still(&self, noise: &StepNoise) -> bool {
        // Standard deviation of the length of three axes of white noise.
        let white = |density: f64| density * (3.0 / noise.period_secs.max(1e-4)).sqrt();
        let gyro = STILL_GYRO.max(white(noise.gyro_density));
        let accel = STILL_ACCEL.max(white(noise.accel_density));
        self.samples >= 10 && self.std_gyro < gyro && self.std_accel < accel
    }
}
