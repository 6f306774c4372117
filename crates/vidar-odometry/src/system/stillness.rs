//! Whether the camera stands still, told from images and from the IMU.

use super::track::Track;
use nalgebra::Vector3;
use rustc_hash::FxHashMap;
use vidar_core::LandmarkId;
use vidar_core::{FrameId, ImuSample, camera::Pixel};

/// Median motion from frame to frame, per axis, below which an image shows stillness, pixels: noise of single tracks cancels.
const STILL_SHIFT_PX: f64 = 0.15;
/// Median length of the motion of single tracks, their noise included, pixels.
const STILL_PX: f64 = 0.7;
/// Images in a row that must show it.
const STILL_FRAMES: u32 = 8;
/// Tracks that are needed to say so.
const STILL_TRACKS: usize = 10;
/// Standard deviations within which readings of a resting IMU stay.
const STILL_GYRO: f64 = 0.02;
const STILL_ACCEL: f64 = 0.15;

/// Motion of tracks from image to image.
#[derive(Debug, Default)]
pub(crate) struct ImageMotion {
    last: FxHashMap<LandmarkId, Pixel>,
    still_frames: u32,
    moved: Vec<[f64; 3]>,
}

impl ImageMotion {
    /// Takes the tracks as measured in `frame`; whether the images have been still for a while.
    pub fn update(&mut self, tracks: &[Track], frame: FrameId) -> bool {
        self.moved.clear();
        for track in tracks.iter().filter(|t| t.last_frame == frame) {
            if let Some(before) = self.last.get(&track.id) {
                let d = track.last_pixel - before;
                self.moved.push([d.x, d.y, d.norm()]);
            }
        }
        self.last.clear();
        self.last.extend(tracks.iter().filter(|t| t.last_frame == frame).map(|t| (t.id, t.last_pixel)));
        if self.moved.len() < STILL_TRACKS {
            self.still_frames = 0;
            return false;
        }
        let middle = self.moved.len() / 2;
        let mut median = |axis: usize| {
            self.moved.select_nth_unstable_by(middle, |a, b| a[axis].total_cmp(&b[axis])).1[axis]
        };
        let [x, y, length] = [median(0), median(1), median(2)];
        let still = x.abs() < STILL_SHIFT_PX && y.abs() < STILL_SHIFT_PX && length < STILL_PX;
        self.still_frames = if still { self.still_frames + 1 } else { 0 };
        self.still_frames >= STILL_FRAMES
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

    pub fn is_still(&self) -> bool {
        self.samples >= 10 && self.std_gyro < STILL_GYRO && self.std_accel < STILL_ACCEL
    }
}
