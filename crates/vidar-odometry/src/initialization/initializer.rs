//! The odometry before it has a metric state: tracks are followed with the gyroscope's help and logged.

use super::in_flight::{MAX_LOG_SCALE_SIGMA, PROVISIONAL_SECS};
use super::log::joined;
use super::monocular::INITIAL_INVERSE_DISTANCE;
use super::{
    InFlightInitializer, InitFailure, InitFailureReason, InitOutcome, LoggedFrame, TrackObservation,
};
use crate::backend::{Smoother, SmootherError};
use crate::config::OdometryConfig;
use crate::deferred::Deferred;
use crate::imu::{Bias, Preintegration};
use crate::tracking::{CameraPoses, Prediction, Tracker};
use crate::tracking::{HostImage, host_covariance, noisy_covariance};
use crate::tracking::{ImageMotion, MIN_CORNERS, tracks_in};
use nalgebra::Vector3;
use std::sync::Arc;
use vidar_core::{Duration, FrameId, LieGroup, Se3, So3, Timestamp};

/// The stretch of frames that is logged, s, and most frames of it (their images stay in memory): the longest window of an attempt, and
/// what comes while it is solved.
const LOG_SECS: f64 = 3.2;
const LOG_FRAMES: usize = 100;

/// New tracks are started when fewer than this share of the wanted ones is left.
const REFILL_SHARE: f64 = 0.7;

/// Least and longest time between attempts to start, s: every second frame at 20 Hz.
const ATTEMPT_SECS: f64 = 0.09;
const LONGEST_PAUSE_SECS: f64 = 0.5;
/// Pause after an attempt whose images and IMU contradict each other, s.
const CONTRADICTION_PAUSE_SECS: f64 = 0.3;
/// Time of the recording until the result of an attempt is taken over, s.
const SOLVING_SECS: f64 = 0.09;

/// Stillness that a static start needs, s.
pub(crate) const STILL_SECS: f64 = 0.5;

/// An image of the log, with the rotation first_from_body integrated from the gyroscope.
#[derive(Debug)]
struct LoggedRotation {
    frame: FrameId,
    first_from_body: So3,
    host: Arc<HostImage>,
}

/// The odometry that waits for its start.
#[derive(Debug)]
pub(crate) struct Initializer {
    config: OdometryConfig,
    is_mono: bool,
    body_from_camera: Se3,
    pub tracker: Tracker,
    log: Vec<LoggedFrame>,
    rotations: Vec<LoggedRotation>,
    in_flight: InFlightInitializer,
    motion: ImageMotion,
    pub images_still: bool,
    /// An attempt that is being solved.
    solving: Option<Deferred<Attempt>>,
    /// When the last attempt began, and how long after that the next one is worth it, s.
    last_attempt: Option<Timestamp>,
    pause_secs: f64,
    /// What the log spanned then, s.
    solved_secs: f64,
    /// What stood in the way at the last attempt.
    failure: InitFailure,
}

/// What an attempt leaves: who made it, with what was learnt, and its outcome.
type Attempt = (InFlightInitializer, Result<InitOutcome, SmootherError>);

/// A start that was found.
pub(crate) struct InitialState {
    pub smoother: Smoother,
    /// Median distance of the landmarks.
    pub median_distance: f64,
    /// Images of the frames that the smoother holds.
    pub hosts: Vec<Arc<HostImage>>,
}

/// Rotations of the logged frames; nothing has moved.
struct RotationOnlyPoses<'a> {
    rotations: &'a [LoggedRotation],
    body_from_camera: Se3,
}

impl CameraPoses for RotationOnlyPoses<'_> {
    fn world_from_camera(&self, frame: FrameId) -> Option<Se3> {
        let turn = self.rotations.iter().find(|l| l.frame == frame)?;
        Some(rotated_camera(&turn.first_from_body, &self.body_from_camera))
    }
}

/// Rotation of a camera on a body that only turned.
fn rotated_camera(first_from_body: &So3, body_from_camera: &Se3) -> Se3 {
    Se3::new(*first_from_body * body_from_camera.rotation, Vector3::zeros())
}

impl Initializer {
    pub fn new(config: OdometryConfig, is_mono: bool, body_from_camera: Se3, tracker: Tracker) -> Self {
        let in_flight =
            InFlightInitializer::new(config.smoother(), tracker.camera().clone(), body_from_camera);
        Self {
            config,
            is_mono,
            body_from_camera,
            tracker,
            log: Vec::new(),
            rotations: Vec::new(),
            in_flight,
            motion: ImageMotion::default(),
            images_still: false,
            solving: None,
            last_attempt: None,
            pause_secs: ATTEMPT_SECS,
            solved_secs: 0.0,
            failure: InitFailure { reason: InitFailureReason::Frames, measured: 0.0, limit: 5.0 },
        }
    }

    /// Best knowledge of the gyroscope's bias.
    pub fn gyro_bias(&self) -> Vector3<f64> {
        *self.in_flight.gyro_bias()
    }

    /// Time that the log spans, s.
    pub fn logged_secs(&self) -> f64 {
        match (self.log.first(), self.log.last()) {
            (Some(first), Some(last)) => (last.time - first.time).as_secs_f64(),
            _ => 0.0,
        }
    }

    /// Tracks all features into an image and logs their observations; a metric state if the log determines one.
    pub fn follow(
        &mut self,
        host: Arc<HostImage>,
        time: Timestamp,
        preintegration: Option<Preintegration>,
    ) -> Result<InitialState, InitFailure> {
        let frame = host.frame;
        let tracked = self.track(&host, time, preintegration.as_ref());
        let preintegration = preintegration.filter(|_| !self.log.is_empty());
        if preintegration.is_none() {
            // What is being solved cannot be carried to this image.
            self.solving = None;
        }
        self.log.push(LoggedFrame { frame, time, preintegration, observations: Vec::new() });
        if (tracked as f64) < REFILL_SHARE * self.config.max_landmarks as f64 {
            self.tracker.detect(&host, self.config.max_landmarks - tracked, INITIAL_INVERSE_DISTANCE);
        }
        self.log_observations(frame);
        self.forget();
        if self.tracker.tracks.len() < MIN_CORNERS {
            self.solving = None;
            let found = self.tracker.tracks.len() as f64;
            return Err(InitFailure {
                reason: InitFailureReason::Tracks,
                measured: found,
                limit: MIN_CORNERS as f64,
            });
        }
        if let Some((in_flight, outcome)) =
            self.solving.take_if(|s| s.is_due(time)).and_then(Deferred::result)
        {
            self.in_flight = in_flight;
            match self.take_over(outcome) {
                Ok(found) => return Ok(found),
                Err(failure) => {
                    self.pause_secs = pause_after(&failure, self.solved_secs);
                    self.failure = failure;
                }
            }
        }
        let is_early = |last: Timestamp| (time - last).as_secs_f64() < self.pause_secs;
        if self.solving.is_some() || self.last_attempt.is_some_and(is_early) {
            return Err(self.failure.clone());
        }
        self.last_attempt = Some(time);
        if self.is_mono {
            return self.attempt_mono().inspect_err(|failure| self.failure = failure.clone());
        }
        if self.log.last().is_some_and(|newest| newest.preintegration.is_some()) {
            self.begin_attempt(time);
        }
        Err(self.failure.clone())
    }

    /// Begins to look for a metric state in what is logged now.
    fn begin_attempt(&mut self, time: Timestamp) {
        self.solved_secs = self.logged_secs();
        let (mut in_flight, log) = (self.in_flight.clone(), self.log.clone());
        let solve = move || {
            let outcome = in_flight.attempt(&log);
            (in_flight, outcome)
        };
        self.solving = Some(Deferred::begin(time + Duration::from_secs_f64(SOLVING_SECS), solve));
    }

    /// The start that an attempt found, carried to the newest image.
    fn take_over(&self, outcome: Result<InitOutcome, SmootherError>) -> Result<InitialState, InitFailure> {
        match outcome.map_err(InitFailure::backend)? {
            InitOutcome::Failed(failure) => Err(failure),
            InitOutcome::Solved(mut started) => {
                self.carry_on(&mut started.smoother).map_err(InitFailure::backend)?;
                Ok(self.initial_state(started.smoother, started.median_distance_m))
            }
        }
    }

    /// Adds the newest image to a window that was solved while it came.
    fn carry_on(&self, smoother: &mut Smoother) -> Result<(), SmootherError> {
        let (Some((solved, _, state)), Some(newest)) = (smoother.newest(), self.log.last()) else {
            return Ok(());
        };
        let state = *state;
        let since = self.log.iter().filter(|f| f.frame > solved);
        let Some(mut joined) = joined(since) else { return Ok(()) };
        joined.reintegrate(state.bias);
        let predicted = smoother.predict(&joined);
        smoother.add_frame(newest.frame, newest.time, predicted, Some(joined))?;
        smoother.mark_keyframe(newest.frame)?;
        for seen in &newest.observations {
            if smoother.landmark(seen.landmark).is_some() {
                smoother.add_observation(&seen.by(newest.frame))?;
            }
        }
        smoother.optimise(self.config.iterations);
        Ok(())
    }

    fn attempt_mono(&mut self) -> Result<InitialState, InitFailure> {
        let camera = self.tracker.camera().clone();
        let smoother = super::monocular::start(&self.log, &camera, &self.body_from_camera, &self.config)?;
        Ok(self.initial_state(smoother, 1.0 / INITIAL_INVERSE_DISTANCE))
    }

    /// Measures all tracks in the newest image; how many were found.
    fn track(
        &mut self,
        host: &Arc<HostImage>,
        time: Timestamp,
        preintegration: Option<&Preintegration>,
    ) -> usize {
        let frame = host.frame;
        let bias = Bias { gyro: self.gyro_bias(), accel: Vector3::zeros() };
        let turn = preintegration.map_or(So3::IDENTITY, |r| r.rotation(&bias));
        let last = self.rotations.last().map(|l| (l.frame, l.first_from_body));
        let first_from_body = last.map_or(So3::IDENTITY, |(_, first_from_last)| first_from_last * turn);
        let secs = self.log.last().map_or(0.0, |l| (time - l.time).as_secs_f64());
        if let Some((last, first_from_last)) = last {
            let world_from_current = rotated_camera(&first_from_body, &self.body_from_camera);
            let world_from_last = rotated_camera(&first_from_last, &self.body_from_camera);
            let poses =
                RotationOnlyPoses { rotations: &self.rotations, body_from_camera: self.body_from_camera };
            let prediction = Prediction {
                poses: &poses,
                world_from_current,
                current_from_last: world_from_current.inverse() * world_from_last,
                has_translation: false,
                may_be_stabilised: true,
                last,
                secs,
            };
            self.tracker.measure(host, &prediction);
            let fixed = &self.tracker.fixed;
            for logged in self.log.iter_mut().filter(|_| !fixed.is_empty()) {
                logged.observations.retain(|seen| !fixed.contains(&seen.landmark));
            }
        }
        self.images_still = self.motion.update(tracks_in(&self.tracker.tracks, frame), time);
        self.rotations.push(LoggedRotation { frame, first_from_body, host: host.clone() });
        self.tracker.tracks.iter().filter(|t| t.measured.is_some()).count()
    }

    /// Writes what the newest frame saw into the log, its own new tracks included.
    fn log_observations(&mut self, frame: FrameId) {
        let Some(newest) = self.log.last_mut() else { return };
        for track in &self.tracker.tracks {
            let landmark = track.id;
            if track.host.frame == frame {
                let covariance = host_covariance(track);
                newest.observations.push(TrackObservation {
                    landmark,
                    pixel: track.feature.global_pixel,
                    covariance,
                });
            } else if let Some(measured) = &track.measured {
                let covariance = noisy_covariance(measured, self.config.pixel_noise_px);
                newest.observations.push(TrackObservation { landmark, pixel: measured.pixel, covariance });
            }
        }
    }

    fn forget(&mut self) {
        let Some(newest) = self.log.last().map(|f| f.time) else { return };
        let old = self.log.iter().take_while(|f| (newest - f.time).as_secs_f64() > LOG_SECS).count();
        let excess = old.max(self.log.len().saturating_sub(LOG_FRAMES));
        self.log.drain(..excess);
        self.rotations.drain(..excess);
    }

    fn initial_state(&self, smoother: Smoother, median_distance: f64) -> InitialState {
        let held = |t: &&LoggedRotation| smoother.frames().any(|f| f == t.frame);
        let hosts = self.rotations.iter().filter(held).map(|t| t.host.clone()).collect();
        InitialState { smoother, median_distance, hosts }
    }
}

/// Time from the beginning of an attempt of `span` seconds until another one may tell more, s: paced by what it lacked.
fn pause_after(failure: &InitFailure, span: f64) -> f64 {
    let ratio = failure.measured / failure.limit;
    let pause = match failure.reason {
        // σ falls with the square of a window's length, parallax grows with it.
        InitFailureReason::ScaleUncertainty => span * (ratio.sqrt() - 1.0),
        InitFailureReason::Parallax => span * (1.0 / ratio - 1.0),
        InitFailureReason::ScaleAgreement
        | InitFailureReason::Seconds
        | InitFailureReason::Frames
        | InitFailureReason::Tracks => ATTEMPT_SECS,
        _ => CONTRADICTION_PAUSE_SECS,
    };
    let pause = pause.clamp(ATTEMPT_SECS, LONGEST_PAUSE_SECS);
    // From some length on less is asked for; the chosen frames may span less than the log. An attempt just before delays the one then.
    let was_asked_more =
        failure.reason == InitFailureReason::ScaleUncertainty && failure.limit <= MAX_LOG_SCALE_SIGMA;
    match PROVISIONAL_SECS - span {
        left if left > 0.0 && left < pause + ATTEMPT_SECS => left.max(ATTEMPT_SECS),
        left if left <= 0.0 && was_asked_more => ATTEMPT_SECS,
        _ => pause,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Half a second was lost where the attempt that is judged as a provisional start came when another one was over.
    #[test]
    fn the_first_attempt_of_which_less_is_asked_begins_when_that_is_so() {
        let after =
            |reason, measured, limit, span| pause_after(&InitFailure::new(reason, measured, limit), span);
        let uncertain = |limit, span| after(InitFailureReason::ScaleUncertainty, 1.0, limit, span);
        assert_eq!(uncertain(MAX_LOG_SCALE_SIGMA, 0.8), LONGEST_PAUSE_SECS);
        for span in [1.25, 1.4, 1.7] {
            assert!((span + uncertain(MAX_LOG_SCALE_SIGMA, span) - PROVISIONAL_SECS).abs() < 1e-9, "{span}");
        }
        // Frames that span a little less than the log were judged as before.
        assert_eq!(uncertain(MAX_LOG_SCALE_SIGMA, 1.8), ATTEMPT_SECS);
        assert_eq!(uncertain(0.5, 1.8), LONGEST_PAUSE_SECS);
        assert_eq!(after(InitFailureReason::ImuChi2, 8.0, 0.4, 0.8), CONTRADICTION_PAUSE_SECS);
        assert!((after(InitFailureReason::Parallax, 0.8, 1.0, 1.0) - 0.25).abs() < 1e-9);
    }
}
