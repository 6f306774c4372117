//! The odometry before it has a metric state: tracks are followed with the gyroscope's help and logged.

use super::{Attempt, InFlightConfig, InFlightStart, LoggedFrame, Obstacle, Refusal, Seen};
use crate::backend::Smoother;
use crate::config::OdometryConfig;
use crate::imu::{Bias, Preintegration};
use crate::tracking::{HostImage, host_covariance, noisy_covariance};
use crate::tracking::{ImageMotion, found_in};
use crate::tracking::{Places, Prediction, Tracker};
use nalgebra::Vector3;
use std::rc::Rc;
use vidar_core::{FrameId, LieGroup, Se3, So3, Timestamp};

/// Frames that are logged at most.
const LOG_FRAMES: usize = 60;

/// Inverse distance to assume of everything, 1/m.
pub(crate) const UNKNOWN_INVERSE: f64 = 0.4;

/// New tracks are started when fewer than this share of the wanted ones is left.
const REFILL_SHARE: f64 = 0.7;

/// Fewest corners of a first image.
const MIN_FEATURES: usize = 40;

/// An attempt to start in flight is made at every such frame.
const ATTEMPT_EVERY: u32 = 2;

/// Stillness that a static start needs, s.
pub(crate) const STILL_SECS: f64 = 0.5;

/// An image of the log, with the rotation first_from_body that the gyroscope tells.
#[derive(Debug)]
struct Turn {
    frame: FrameId,
    first_from_body: So3,
    host: Rc<HostImage>,
}

/// The odometry that waits for its start.
#[derive(Debug)]
pub(crate) struct Starting {
    config: OdometryConfig,
    is_mono: bool,
    body_from_camera: Se3,
    pub tracker: Tracker,
    log: Vec<LoggedFrame>,
    turns: Vec<Turn>,
    in_flight: InFlightStart,
    motion: ImageMotion,
    pub images_still: bool,
    /// What stood in the way at the last attempt.
    refusal: Refusal,
}

/// A start that was found.
pub(crate) struct Found {
    pub smoother: Smoother,
    /// Standard deviation of ln(scale), where there is a scale.
    pub log_scale_sigma: Option<f64>,
    /// Median distance of the landmarks.
    pub median_distance: f64,
    /// Images of the frames that the smoother holds.
    pub hosts: Vec<Rc<HostImage>>,
}

/// Rotations of the logged frames; nothing has moved.
struct Turned<'a> {
    turns: &'a [Turn],
    body_from_camera: Se3,
}

impl Places for Turned<'_> {
    fn world_from_camera(&self, frame: FrameId) -> Option<Se3> {
        let turn = self.turns.iter().find(|l| l.frame == frame)?;
        Some(turned_camera(&turn.first_from_body, &self.body_from_camera))
    }
}

/// Rotation of a camera on a body that only turned.
fn turned_camera(first_from_body: &So3, body_from_camera: &Se3) -> Se3 {
    Se3::new(*first_from_body * body_from_camera.rotation, Vector3::zeros())
}

impl Starting {
    pub fn new(config: OdometryConfig, is_mono: bool, body_from_camera: Se3, tracker: Tracker) -> Self {
        let in_flight = InFlightStart::new(
            InFlightConfig::default(),
            config.smoother(),
            tracker.camera().clone(),
            body_from_camera,
        );
        Self {
            config,
            is_mono,
            body_from_camera,
            tracker,
            log: Vec::new(),
            turns: Vec::new(),
            in_flight,
            motion: ImageMotion::default(),
            images_still: false,
            refusal: Refusal { obstacle: Obstacle::Frames, measured: 0.0, limit: 5.0 },
        }
    }

    /// Best knowledge of the gyroscope's bias.
    pub fn gyro_bias(&self) -> Vector3<f64> {
        *self.in_flight.gyro_bias()
    }

    /// Follows all tracks into an image and logs what was seen; a metric state if the log tells one.
    pub fn follow(
        &mut self,
        host: Rc<HostImage>,
        time: Timestamp,
        readings: Option<Preintegration>,
    ) -> Result<Found, Refusal> {
        let frame = host.frame;
        let followed = self.track(&host, time, readings.as_ref());
        let readings = readings.filter(|_| !self.log.is_empty());
        let chained = readings.is_some();
        self.log.push(LoggedFrame { frame, time, readings, seen: Vec::new() });
        if (followed as f64) < REFILL_SHARE * self.config.max_landmarks as f64 {
            self.tracker.detect(&host, self.config.max_landmarks - followed, UNKNOWN_INVERSE);
        }
        self.log_seen(frame);
        self.forget();
        if self.tracker.tracks.len() < MIN_FEATURES {
            let found = self.tracker.tracks.len() as f64;
            return Err(Refusal { obstacle: Obstacle::Tracks, measured: found, limit: MIN_FEATURES as f64 });
        }
        if !frame.0.is_multiple_of(ATTEMPT_EVERY) {
            return Err(self.refusal);
        }
        let attempt = if self.is_mono { self.attempt_mono() } else { self.attempt_in_flight(chained) };
        if let Err(refusal) = &attempt {
            self.refusal = *refusal;
        }
        attempt
    }

    fn attempt_in_flight(&mut self, chained: bool) -> Result<Found, Refusal> {
        if !chained {
            return Err(self.refusal);
        }
        match self.in_flight.attempt(&self.log) {
            Ok(Attempt::Started(started)) => {
                let (log_scale_sigma, median_distance_m) =
                    (started.log_scale_sigma, started.median_distance_m);
                Ok(self.found(started.smoother, Some(log_scale_sigma), median_distance_m))
            }
            Ok(Attempt::Refused(refusal)) => Err(refusal),
            Err(_) => Err(self.refusal),
        }
    }

    fn attempt_mono(&mut self) -> Result<Found, Refusal> {
        let camera = self.tracker.camera().clone();
        let smoother = super::monocular::start(&self.log, &camera, &self.body_from_camera, &self.config)?;
        Ok(self.found(smoother, None, 1.0 / UNKNOWN_INVERSE))
    }

    /// Measures all tracks in the newest image; how many were found.
    fn track(&mut self, host: &Rc<HostImage>, time: Timestamp, readings: Option<&Preintegration>) -> usize {
        let frame = host.frame;
        let bias = Bias { gyro: self.gyro_bias(), accel: Vector3::zeros() };
        let turn = readings.map_or(So3::IDENTITY, |r| r.rotation(&bias));
        let last = self.turns.last().map(|l| (l.frame, l.first_from_body));
        let first_from_body = last.map_or(So3::IDENTITY, |(_, first_from_last)| first_from_last * turn);
        let secs = self.log.last().map_or(0.0, |l| (time - l.time).as_secs_f64());
        if let Some((last, first_from_last)) = last {
            let world_from_current = turned_camera(&first_from_body, &self.body_from_camera);
            let world_from_last = turned_camera(&first_from_last, &self.body_from_camera);
            let places = Turned { turns: &self.turns, body_from_camera: self.body_from_camera };
            let prediction = Prediction {
                places: &places,
                world_from_current,
                current_from_last: world_from_current.inverse() * world_from_last,
                has_translation: false,
                last,
                secs,
            };
            self.tracker.measure(&host.pyramid, frame, &prediction);
        }
        self.images_still = self.motion.update(found_in(&self.tracker.tracks, frame), time);
        self.turns.push(Turn { frame, first_from_body, host: host.clone() });
        self.tracker.tracks.iter().filter(|t| t.measured.is_some()).count()
    }

    /// Writes what the newest frame saw into the log, its own new tracks included.
    fn log_seen(&mut self, frame: FrameId) {
        let Some(newest) = self.log.last_mut() else { return };
        for track in &self.tracker.tracks {
            let landmark = track.id;
            if track.host.frame == frame {
                let covariance = host_covariance(track);
                newest.seen.push(Seen { landmark, pixel: track.feature.pixel, covariance });
            } else if let Some(measured) = &track.measured {
                let covariance = noisy_covariance(measured, self.config.pixel_noise_px);
                newest.seen.push(Seen { landmark, pixel: measured.pixel, covariance });
            }
        }
    }

    fn forget(&mut self) {
        let excess = self.log.len().saturating_sub(LOG_FRAMES);
        self.log.drain(..excess);
        self.turns.drain(..excess);
    }

    fn found(&self, smoother: Smoother, log_scale_sigma: Option<f64>, median_distance: f64) -> Found {
        let held = |t: &&Turn| smoother.frames().any(|f| f == t.frame);
        let hosts = self.turns.iter().filter(held).map(|t| t.host.clone()).collect();
        Found { smoother, log_scale_sigma, median_distance, hosts }
    }
}
