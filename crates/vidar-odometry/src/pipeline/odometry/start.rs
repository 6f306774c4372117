//! From images without a state to the first one, and back.

use super::{Odometry, Phase, Status};
use crate::backend::{Smoother, SmootherError};
use crate::bundle_adjustment::TrackLog;
use crate::config::OdometryConfig;
use crate::initialization::{INITIAL_INVERSE_DISTANCE, InitialState, Initializer, STILL_SECS};
use crate::initialization::{
    InitFailure, InitFailureReason, StaticInitConfig, StaticState, initialize_slow, initialize_static,
};
use crate::tracking::{HostImage, ImuStatistics, SlidingWindowOdometry, StepReport, Tracker};
use std::sync::Arc;
use vidar_core::{Duration, Frame, FrameId, ImuSample, RigCamera, Timestamp};

/// Images without parallax for this long begin a state that hardly moves, s.
const SLOW_SECS: f64 = 1.0;

/// Whether a failed attempt says that the body hardly moved for long enough.
pub(super) fn hardly_moves(initializer: &Initializer, failure: &InitFailure) -> bool {
    failure.reason == InitFailureReason::Parallax && initializer.logged_secs() >= SLOW_SECS
}

impl Odometry {
    /// Whether the IMU measurements of the last half second are those of a body at rest.
    pub(super) fn imu_is_still(&self, time: Timestamp) -> bool {
        let from = time - Duration::from_secs_f64(STILL_SECS);
        let (Some(model), Some(first)) = (&self.imu_model, self.imu.iter().next()) else { return false };
        let recent = self.imu.iter().filter(|s| s.time >= from && s.time <= time);
        first.time <= from && ImuStatistics::of(recent).is_still(&model.noise)
    }

    /// Starts from a body at rest: level and gyroscope bias are known, the velocity is zero, and the scale follows as
    /// soon as the body moves.
    pub(super) fn start_static(&mut self, frame: &Frame, host: &Arc<HostImage>, time: Timestamp) -> Status {
        let samples: Vec<ImuSample> = self.imu.iter().filter(|s| s.time <= time).copied().collect();
        // An IMU sample early, so that the span is not shorter than asked for by less than one period.
        let from = time - Duration::from_secs_f64(STILL_SECS + 0.02);
        let begin = samples.partition_point(|s| s.time < from);
        let rest_config =
            StaticInitConfig { gravity_mps2: self.config.gravity_mps2, ..StaticInitConfig::default() };
        let at_rest = match initialize_static(&samples[begin..], None, &rest_config) {
            Ok(at_rest) => at_rest,
            Err(failure) => return self.wait(failure),
        };
        match self.start_at(host, time, &at_rest, INITIAL_INVERSE_DISTANCE) {
            Ok(mut window) => {
                window.stand(time);
                self.begin(window, frame, host.frame)
            }
            Err(error) => self.wait(InitFailure::backend(error)),
        }
    }

    /// Starts from a body whose images show no parallax though it does not stand still: a hand that holds a camera, or turns
    /// it on the spot. Level and gyroscope bias are known, the velocity is small, and the scale follows as soon as there is parallax.
    pub(super) fn start_slow(
        &mut self,
        failure: InitFailure,
        frame: &Frame,
        host: &Arc<HostImage>,
        time: Timestamp,
    ) -> Status {
        let Phase::Initializing(initializer) = &self.phase else { return self.wait(failure) };
        let (from, gyro_bias) = (time - Duration::from_secs_f64(SLOW_SECS), initializer.gyro_bias());
        let samples: Vec<ImuSample> =
            self.imu.iter().filter(|s| (from..=time).contains(&s.time)).copied().collect();
        let Some(slow) = initialize_slow(&samples, &gyro_bias, self.config.gravity_mps2) else {
            return self.wait(failure);
        };
        match self.start_at(host, time, &slow, INITIAL_INVERSE_DISTANCE) {
            Ok(window) => self.begin(window, frame, host.frame),
            Err(error) => self.wait(InitFailure::backend(error)),
        }
    }

    /// A window that begins with this image and state, among things at `typical_inverse` (1/m).
    pub(super) fn start_at(
        &mut self,
        host: &Arc<HostImage>,
        time: Timestamp,
        start: &StaticState,
        typical_inverse: f64,
    ) -> Result<SlidingWindowOdometry, SmootherError> {
        self.time_calibration.forget_tracks();
        self.log.iter_mut().for_each(TrackLog::next_generation);
        let mut smoother = self.smoother()?;
        smoother.start(host.frame, time, start.state, start.sigmas)?;
        smoother.mark_keyframe(host.frame)?;
        let mut tracker = self.phase.tracker().another();
        tracker.detect(host, 2 * self.config.max_landmarks, typical_inverse);
        let (config, hosts) = (self.config.clone(), vec![host.clone()]);
        SlidingWindowOdometry::new(config, smoother, tracker, hosts, typical_inverse)
    }

    /// Goes on with the smoother that solved the start.
    pub(super) fn start_in_flight(
        &mut self,
        found: InitialState,
        frame: &Frame,
        host: &Arc<HostImage>,
    ) -> Status {
        let waiting = self.initializing_anew();
        let Phase::Initializing(before) = std::mem::replace(&mut self.phase, waiting) else {
            return Status::Waiting(self.failure.clone());
        };
        let typical = 1.0 / found.median_distance.clamp(0.1, 100.0);
        let window = SlidingWindowOdometry::new(
            self.config.clone(),
            found.smoother,
            before.tracker,
            found.hosts,
            typical,
        );
        match window {
            Ok(window) => self.begin(window, frame, host.frame),
            Err(error) => self.wait(InitFailure::backend(error)),
        }
    }

    pub(super) fn begin(&mut self, window: SlidingWindowOdometry, frame: &Frame, id: FrameId) -> Status {
        self.phase = Phase::Tracking(Box::new(window));
        let step = StepReport { just_started: true, is_keyframe: true, ..StepReport::default() };
        self.report(&step, frame, id)
    }

    pub(super) fn initialize_anew(&mut self) {
        self.time_calibration.forget_tracks();
        self.log.iter_mut().for_each(TrackLog::next_generation);
        self.phase = self.initializing_anew();
    }

    fn initializing_anew(&self) -> Phase {
        initializing(&self.config, self.imu_model.is_none(), &self.camera, self.phase.tracker().another())
    }

    pub(super) fn wait(&mut self, failure: InitFailure) -> Status {
        self.failure = failure.clone();
        Status::Waiting(failure)
    }

    fn smoother(&self) -> Result<Smoother, SmootherError> {
        Smoother::new(self.config.smoother(), self.camera.model.clone(), self.camera.body_from_camera)
    }
}

pub(super) fn initializing(
    config: &OdometryConfig,
    is_mono: bool,
    camera: &RigCamera,
    tracker: Tracker,
) -> Phase {
    let initializer = Initializer::new(config.clone(), is_mono, camera.body_from_camera, tracker);
    Phase::Initializing(Box::new(initializer))
}

impl Phase {
    pub(super) fn tracker(&self) -> &Tracker {
        match self {
            Self::Initializing(initializer) => &initializer.tracker,
            Self::Tracking(window) => &window.tracker,
        }
    }
}
