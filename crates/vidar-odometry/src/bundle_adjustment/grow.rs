//! From the adjusted part of a recording outward: images before the start, after the end, and between segments.
//!
//! States are carried by the IMU for a second at a time; tracks that run through then correct them in an adjustment of the
//! last seconds. A later segment of the odometry is taken over as it is, turned about the vertical and moved to where the
//! IMU arrives, since both are metric and levelled.

use super::initial::{self, Guess, MIN_OBSERVATIONS};
use super::problem::CalibrationPrior;
use super::progress::Watch;
use super::{AdjustmentError, Measurements, Work, optimise};
use crate::imu::NavState;
use vidar_core::{Duration, Timestamp};

/// Stretch that the IMU carries before tracks correct it, s: at 0.05 m/s² of accelerometer error 25 mm.
const STEP_SECS: f64 = 1.0;

/// Known states that take part in correcting new ones, s.
const SUPPORT_SECS: f64 = 5.0;

/// Longest stretch between logged images, s.
const MAX_GAP_SECS: f64 = 2.0;

/// Longest stretch whose images show too little to correct the IMU, s.
const MAX_BLIND_SECS: f64 = 3.0;

/// Fewest observations of landmarks in an image that shows enough.
const MIN_SEEN: usize = 8;

/// A segment of the odometry is taken over when it is at least this long, s; shorter ones were often lost for a reason.
const MIN_SEGMENT_SECS: f64 = 3.0;

/// The states of `work`, and those of all images that can be reached from them.
pub(super) fn outward(
    recording: &Measurements<'_>,
    work: &Work,
    watch: &mut Watch<'_>,
) -> Result<Guess, AdjustmentError> {
    let mut grown = Grown { recording, work, guess: work.guess.clone(), blind_secs: 0.0 };
    while grown.forward(watch)? {}
    grown.blind_secs = 0.0;
    while grown.backward(watch)? {}
    Ok(grown.guess)
}

struct Grown<'a> {
    recording: &'a Measurements<'a>,
    work: &'a Work,
    guess: Guess,
    /// Length of the newest stretch that shows too little.
    blind_secs: f64,
}

impl Grown<'_> {
    fn time(&self, image: usize) -> Timestamp {
        self.recording.log.images[image].stamp + self.work.clock_offset
    }

    /// A second more at the end; whether anything more could be reached.
    fn forward(&mut self, watch: &mut Watch<'_>) -> Result<bool, AdjustmentError> {
        let Measurements { log, imu, model } = *self.recording;
        let known = self.guess.images.len();
        let (Some(last), Some(&end)) = (self.guess.images.last(), self.guess.times.last()) else {
            return Ok(false);
        };
        let first = last + 1;
        for image in first..log.images.len() {
            let (time, newest) = (self.time(image), self.guess.times.last().copied().unwrap_or(end));
            if (time - newest).as_secs_f64() > MAX_GAP_SECS || (time - end).as_secs_f64() > STEP_SECS {
                break;
            }
            let Some(arrived) = self.guess.carried_to(time, imu, model) else { break };
            if let Some(logged) = self.whole_segment(image) {
                let placed = initial::onto(&logged.world_from_body, &arrived.world_from_body);
                self.guess.take_segment(log, imu, model, self.work.clock_offset, image, placed);
                break;
            }
            self.guess.push(image, time, arrived);
        }
        let added = self.guess.images.len() - known;
        if added == 0 {
            return Ok(false);
        }
        let support = (0..known).rev().find(|k| (end - self.guess.times[*k]).as_secs_f64() > SUPPORT_SECS);
        let from = support.unwrap_or(0);
        let until = self.until(known, STEP_SECS);
        let seen = self.settle(from, until, from, known..until, watch)?;
        Ok(self.evaluate(seen, (self.guess.times[until - 1] - end).as_secs_f64()))
    }

    /// A second more at the beginning.
    fn backward(&mut self, watch: &mut Watch<'_>) -> Result<bool, AdjustmentError> {
        let Measurements { imu, model, .. } = *self.recording;
        let known = self.guess.images.len();
        let (Some(&first), Some(&begin)) = (self.guess.images.first(), self.guess.times.first()) else {
            return Ok(false);
        };
        for image in (0..first).rev() {
            let (time, oldest) = (self.time(image), self.guess.times[0]);
            if (oldest - time).as_secs_f64() > MAX_GAP_SECS || (begin - time).as_secs_f64() > STEP_SECS {
                break;
            }
            let Some(arrived) = self.guess.carried_back_to(time, imu, model) else { break };
            self.guess.push_front(image, time, arrived);
        }
        let added = self.guess.images.len() - known;
        if added == 0 {
            return Ok(false);
        }
        let until = self.until(added, SUPPORT_SECS).min(known + added);
        let seen = self.settle(0, until, until - 1, 0..added, watch)?;
        Ok(self.evaluate(seen, (begin - self.guess.times[0]).as_secs_f64()))
    }

    /// State of the first image of a segment that is long enough to be taken over.
    fn whole_segment(&self, image: usize) -> Option<NavState> {
        let images = &self.recording.log.images;
        let logged = images[image].state?;
        if images[..image].iter().any(|i| i.is_of(logged.segment)) {
            return None;
        }
        let last = images.iter().rposition(|i| i.is_of(logged.segment))?;
        let secs = (images[last].stamp - images[image].stamp).as_secs_f64();
        (secs >= MIN_SEGMENT_SECS).then_some(logged.state)
    }

    /// One past the last state at most `secs` later than number `from`.
    fn until(&self, from: usize, secs: f64) -> usize {
        let limit = self.guess.times[from] + Duration::from_secs_f64(secs);
        self.guess.times.partition_point(|t| *t <= limit).max(from + 1)
    }

    /// Corrects the states `from..until` by their tracks, with the calibration as it is; the share of the images `new` that show
    /// enough.
    fn settle(
        &mut self,
        from: usize,
        until: usize,
        held: usize,
        new: std::ops::Range<usize>,
        watch: &mut Watch<'_>,
    ) -> Result<f64, AdjustmentError> {
        watch.progress.states = self.guess.images.len();
        let part = Guess {
            images: self.guess.images[from..until].to_vec(),
            times: self.guess.times[from..until].to_vec(),
            states: self.guess.states[from..until].to_vec(),
        };
        let calibration = &self.work.calibration;
        let prior = CalibrationPrior {
            sigmas: vec![0.0; calibration.dim()],
            mean: calibration.clone(),
            image: self.work.prior.image,
        };
        let Ok(mut problem) = initial::build(self.recording, calibration, prior, &part, held - from) else {
            return Ok(0.0);
        };
        optimise::settle(&mut problem, watch)?;
        let mut seen = vec![0_usize; until - from];
        for observation in problem.landmarks.iter().flat_map(|l| &l.observations) {
            seen[observation.frame] += 1;
        }
        for (state, frame) in self.guess.states[from..until].iter_mut().zip(&problem.frames) {
            *state = frame.body.state;
        }
        let enough = new.clone().filter(|k| seen[*k - from] >= MIN_SEEN).count();
        Ok(enough as f64 / new.len().max(MIN_OBSERVATIONS) as f64)
    }

    /// Goes on unless too long a stretch showed too little.
    fn evaluate(&mut self, seen_share: f64, secs: f64) -> bool {
        self.blind_secs = if seen_share >= 0.3 { 0.0 } else { self.blind_secs + secs };
        self.blind_secs <= MAX_BLIND_SECS
    }
}
