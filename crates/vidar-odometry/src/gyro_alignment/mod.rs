//! What consumer recordings leave unsaid about time and rotation: the camera's clock offset, the rolling shutter's
//! readout time and the rotation of the camera on the body, from feature tracks and gyroscope samples.
//!
//! [`GyroAlignmentLog`] collects both while the odometry runs and is asked for the problem from time to time, whose solution is an [`Alignment`].
//! [`RollingShutter`] applies the readout time to pixels.

mod path;
mod shutter;
mod solver;
#[cfg(test)]
mod tests;
mod translation;

pub(crate) use path::RateSample;
pub(crate) use shutter::RollingShutter;
pub(crate) use solver::{Alignment, ImageFeatures, common};

use nalgebra::Vector3;
use solver::Problem;
use std::collections::VecDeque;
use vidar_core::{CameraModel, ImuSample, LandmarkId, So3, Timestamp, camera::Pixel};

/// Images nearer in time than this add little and cost as much, s.
const IMAGE_SPACING_SECS: f64 = 0.045;
/// Longest stretch of images that is used, s.
const SPAN_SECS: f64 = 5.0;
/// Shortest stretch that is tried, s; a hand that turns as fast as [`LIVELY_RATE_RMS`] shows its clock in the shorter one.
const MIN_SPAN_SECS: f64 = 1.5;
const MIN_LIVELY_SPAN_SECS: f64 = 0.7;
/// Root mean square of the angular rate about its mean, rad/s, that the shorter stretch needs.
const LIVELY_RATE_RMS: f64 = 0.25;
/// Gyroscope samples this far beyond an image must be there: the largest offset that is searched, and half a readout.
const LOOKAHEAD_SECS: f64 = 0.19;
/// Root mean square of the angular rate about its mean that a solution needs, rad/s: below it, a clock offset of 50 ms
/// moves pixels by less than two.
const MIN_RATE_RMS: f64 = 0.08;
/// Fewest pairs of images.
const MIN_PAIRS: usize = 12;

/// What is known or assumed before a solution.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Guess {
    pub body_from_camera: So3,
    /// `t_imu = stamp + offset`, s.
    pub offset_secs: f64,
    /// Time from the first to the last row, s.
    pub readout_secs: f64,
    /// Try all clock offsets rather than those near `offset_secs`.
    pub search: bool,
}

/// Feature tracks and gyroscope samples of the last seconds.
#[derive(Debug, Default)]
pub(crate) struct GyroAlignmentLog {
    images: VecDeque<(Timestamp, Vec<(LandmarkId, Pixel)>)>,
    gyro: VecDeque<(Timestamp, Vector3<f64>)>,
    last_attempt: Option<Timestamp>,
}

impl GyroAlignmentLog {
    /// Takes a gyroscope sample; samples come in the order of time.
    pub fn add_gyro(&mut self, sample: &ImuSample) {
        self.gyro.push_back((sample.time, sample.gyro.0));
        while self.gyro.len() > 2
            && (sample.time - self.gyro[1].0).as_secs_f64() > SPAN_SECS + 4.0 * LOOKAHEAD_SECS
        {
            self.gyro.pop_front();
        }
    }

    /// Takes the features of an image with its own stamp, no clock offset added.
    pub fn add_image(&mut self, stamp: Timestamp, features: impl Iterator<Item = (LandmarkId, Pixel)>) {
        if self.images.back().is_some_and(|(last, _)| (stamp - *last).as_secs_f64() < IMAGE_SPACING_SECS) {
            return;
        }
        let mut features: Vec<(LandmarkId, Pixel)> = features.collect();
        features.sort_unstable_by_key(|f| f.0);
        self.images.push_back((stamp, features));
        while self.images.front().is_some_and(|(first, _)| (stamp - *first).as_secs_f64() > SPAN_SECS) {
            self.images.pop_front();
        }
    }

    /// The last image of the newest problem.
    pub fn last_attempt(&self) -> Option<Timestamp> {
        self.last_attempt
    }

    /// Forgets features: they show no point of the world.
    pub fn leave_out(&mut self, features: &[LandmarkId]) {
        for (_, seen) in self.images.iter_mut().filter(|_| !features.is_empty()) {
            seen.retain(|(id, _)| !features.contains(id));
        }
    }

    /// Forgets the images, for when features are named anew.
    pub fn forget_images(&mut self) {
        self.images.clear();
    }

    /// The problem as it is now, if at least `pause_secs` of images came since the last one. `hurries`: a shorter stretch will do where
    /// motion is lively.
    pub fn next_problem(
        &mut self,
        camera: &CameraModel,
        guess: &Guess,
        pause_secs: f64,
        hurries: bool,
    ) -> Option<AlignmentProblem> {
        let (newest, origin) = (self.gyro.back()?.0, self.images.front()?.0);
        let last_image = self.images.back()?.0;
        if self.last_attempt.is_some_and(|t| (last_image - t).as_secs_f64() < pause_secs) {
            return None;
        }
        let images: Vec<ImageFeatures> = self
            .images
            .iter()
            .filter(|(stamp, _)| (newest - *stamp).as_secs_f64() > LOOKAHEAD_SECS)
            .map(|(stamp, f)| ImageFeatures { secs: (*stamp - origin).as_secs_f64(), features: f.clone() })
            .collect();
        let span_secs = images.last()?.secs;
        if span_secs < if hurries { MIN_LIVELY_SPAN_SECS } else { MIN_SPAN_SECS } {
            return None;
        }
        let samples: Vec<RateSample> = self
            .gyro
            .iter()
            .map(|(time, rate)| RateSample { secs: (*time - origin).as_secs_f64(), rate: *rate })
            .collect();
        let covered = samples.first().is_some_and(|s| s.secs < -LOOKAHEAD_SECS) || samples.len() > 50;
        let rate_rms = rate_rms(&samples);
        if span_secs < MIN_SPAN_SECS && rate_rms < LIVELY_RATE_RMS {
            return None;
        }
        self.last_attempt = Some(last_image);
        if !covered || rate_rms < MIN_RATE_RMS {
            return None;
        }
        Some(AlignmentProblem { camera: camera.clone(), guess: *guess, images, samples, span_secs })
    }
}

/// What an alignment is solved from.
#[derive(Debug)]
pub(crate) struct AlignmentProblem {
    camera: CameraModel,
    guess: Guess,
    images: Vec<ImageFeatures>,
    samples: Vec<RateSample>,
    span_secs: f64,
}

impl AlignmentProblem {
    /// Whether it has the shorter stretch of images, and so the fewer.
    pub fn is_short(&self) -> bool {
        self.span_secs < MIN_SPAN_SECS
    }

    /// `None` where too few images share features, or nothing determines the alignment.
    pub fn solve(&self) -> Option<Alignment> {
        let guess = &self.guess;
        let mut problem = Problem::new(&self.camera, guess.body_from_camera, &self.images, &self.samples);
        if problem.pair_count() < MIN_PAIRS {
            return None;
        }
        problem.solve((guess.offset_secs, guess.readout_secs), guess.search)
    }
}

/// Root mean square of the rates about their mean, rad/s.
fn rate_rms(samples: &[RateSample]) -> f64 {
    let n = samples.len().max(1) as f64;
    let mean = samples.iter().map(|s| s.rate).sum::<Vector3<f64>>() / n;
    (samples.iter().map(|s| (s.rate - mean).norm_squared()).sum::<f64>() / n).sqrt()
}
