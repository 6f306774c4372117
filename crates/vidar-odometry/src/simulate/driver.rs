//! Start and smoother run on tracks, as the whole odometry runs on images.

mod config;
mod landmarks;

pub use config::FeatureOdometryConfig;

use super::sensors::{SimulatedFrame, Simulation};
use crate::backend::{GaugePriorSigmas, MarginalisationReport, OptimiseReport, Smoother, SmootherError};
use crate::imu::{Bias, BufferError, ImuBuffer, NavState, Preintegration};
use crate::initialization::{InFlightInitializer, InitFailure, InitOutcome, LoggedFrame, TrackObservation};
use crate::initialization::{STILL_SECS, WINDOW_SECS};
use crate::tracking::{ImageMotion, ImuStatistics};
use landmarks::observation;
use nalgebra::Vector3;
use rustc_hash::{FxHashMap, FxHashSet};
use vidar_core::{CameraModel, Duration, FrameId, ImuSample, LandmarkId, Se3, Timestamp};
use vidar_solve::statistics::median_upper;

/// What a frame led to.
#[derive(Clone, Debug)]
pub enum StepOutput {
    /// There is no metric state; why not, when an attempt was made.
    Waiting(Option<InitFailure>),
    /// The start succeeded with this frame.
    Initialised {
        /// State of the frame.
        state: NavState,
        /// Standard deviation of log(scale).
        log_scale_sigma: f64,
    },
    /// The state of the frame.
    Tracking(NavState),
}

/// Standard deviations of a resting body's velocity, m/s, and motion from frame to frame, m and rad; after this long its
/// IMU measurements go into the prior, s.
const REST_SIGMA_MPS: f64 = 0.01;
const ZERO_MOTION_SIGMA_M: f64 = 5e-4;
const ZERO_MOTION_SIGMA_RAD: f64 = 2e-4;
const STANDSTILL_FOLD_SECS: f64 = 1.0;

/// See the module's head.
#[derive(Clone, Debug)]
pub struct FeatureOdometry {
    config: FeatureOdometryConfig,
    camera: CameraModel,
    body_from_camera: Se3,
    buffer: ImuBuffer,
    start: InFlightInitializer,
    log: Vec<LoggedFrame>,
    smoother: Option<Smoother>,
    tracks: FxHashMap<LandmarkId, Vec<(FrameId, TrackObservation)>>,
    banned: FxHashSet<LandmarkId>,
    since_keyframe: usize,
    /// Whether the frame that comes is told to rest, and whether it is told or seen to.
    told_to_rest: bool,
    resting: bool,
    motion: ImageMotion,
    /// The frame since which the body rests, and the time from which its IMU measurements are not in the prior yet.
    rest: Option<(FrameId, Timestamp)>,
    last_time: Option<Timestamp>,
    report: OptimiseReport,
    marginalisation: MarginalisationReport,
    scratch: Vec<ImuSample>,
}

/// Distance between prediction and observation that is tried at all, px.
const GATE_PX: f64 = 25.0;

/// Least way from keyframe to keyframe, as a share of the scene's distance.
const MIN_KEYFRAME_BASE: f64 = 2e-3;

impl FeatureOdometry {
    /// For one camera on a body.
    pub fn new(config: FeatureOdometryConfig, camera: CameraModel, body_from_camera: Se3) -> Self {
        let start = InFlightInitializer::new(config.smoother.clone(), camera.clone(), body_from_camera);
        Self {
            buffer: ImuBuffer::new(config.imu_rate_hz),
            config,
            camera,
            body_from_camera,
            start,
            log: Vec::new(),
            smoother: None,
            tracks: FxHashMap::default(),
            banned: FxHashSet::default(),
            since_keyframe: 0,
            told_to_rest: false,
            resting: false,
            motion: ImageMotion::default(),
            rest: None,
            last_time: None,
            report: OptimiseReport::default(),
            marginalisation: MarginalisationReport::default(),
            scratch: Vec::new(),
        }
    }

    /// For a simulation, its IMU measurements taken in.
    ///
    /// # Errors
    /// IMU measurements out of order.
    pub fn for_simulation(
        config: FeatureOdometryConfig,
        simulation: &Simulation,
    ) -> Result<Self, BufferError> {
        let mut odometry = Self::new(config, simulation.camera.clone(), simulation.body_from_camera);
        simulation.imu_samples.iter().try_for_each(|s| odometry.take(*s))?;
        Ok(odometry)
    }

    /// Takes an IMU sample.
    ///
    /// # Errors
    /// An IMU sample out of order or not finite.
    pub fn take(&mut self, sample: ImuSample) -> Result<(), BufferError> {
        self.buffer.push(sample)
    }

    /// Begins at `frame` with a state that is known as well as `sigmas` say.
    ///
    /// # Errors
    /// Settings outside their range, a state that is not finite.
    pub fn start_at(
        &mut self,
        frame: &SimulatedFrame,
        state: NavState,
        sigmas: GaugePriorSigmas,
    ) -> Result<(), SmootherError> {
        let mut smoother =
            Smoother::new(self.config.smoother.clone(), self.camera.clone(), self.body_from_camera)?;
        smoother.start(frame.id, frame.time, state, sigmas)?;
        smoother.mark_keyframe(frame.id)?;
        self.smoother = Some(smoother);
        self.since_keyframe = 0;
        self.last_time = Some(frame.time);
        self.remember(frame.id, &frame.observations);
        Ok(())
    }

    /// The smoother, once there is one.
    pub fn smoother(&mut self) -> Option<&mut Smoother> {
        self.smoother.as_mut()
    }

    /// What the last optimisation did.
    pub fn report(&self) -> &OptimiseReport {
        &self.report
    }

    /// Takes the tracks of the next frame, with its stamp.
    ///
    /// # Errors
    /// Errors of the smoother; IMU measurements that do not reach to the frame count as missing.
    pub fn push(
        &mut self,
        id: FrameId,
        time: Timestamp,
        observations: &[TrackObservation],
    ) -> Result<StepOutput, SmootherError> {
        let bias = match &self.smoother {
            Some(smoother) => smoother.newest().map_or(Bias::ZERO, |(.., s)| s.bias),
            None => Bias { gyro: *self.start.gyro_bias(), accel: Vector3::zeros() },
        };
        // Stamps as far right as is known.
        let time = time + self.smoother.as_ref().map_or(Duration::ZERO, Smoother::next_frame_offset);
        let preintegration = self.preintegrate_until(time, bias);
        let still = self.motion.update(observations.iter().map(|s| (s.landmark, s.pixel)), time);
        self.resting = self.told_to_rest || (self.config.notices_rest && still && self.imu_rests(time));
        self.last_time = Some(time);
        match self.smoother.take() {
            Some(mut smoother) => {
                let state = self.advance(&mut smoother, id, time, observations, preintegration);
                self.smoother = Some(smoother);
                state.map(StepOutput::Tracking)
            }
            None => self.try_start(id, time, observations, preintegration),
        }
    }

    /// Whether the IMU measurements of the last half second are those of a body at rest.
    fn imu_rests(&self, time: Timestamp) -> bool {
        let from = time - Duration::from_secs_f64(STILL_SECS);
        let recent = self.buffer.iter().filter(|s| s.time >= from && s.time <= time);
        ImuStatistics::of(recent).is_still(&self.config.imu.noise)
    }

    /// As [`FeatureOdometry::push`] for a frame of which it is known that the body stands still.
    ///
    /// # Errors
    /// As [`FeatureOdometry::push`].
    pub fn push_resting(
        &mut self,
        id: FrameId,
        time: Timestamp,
        observations: &[TrackObservation],
    ) -> Result<StepOutput, SmootherError> {
        self.told_to_rest = true;
        let output = self.push(id, time, observations);
        self.told_to_rest = false;
        output
    }

    fn preintegrate_until(&mut self, time: Timestamp, bias: Bias) -> Option<Preintegration> {
        let mut cut = std::mem::take(&mut self.scratch);
        let covered = self.last_time.and_then(|from| self.buffer.interval(from, time, &mut cut).ok());
        let spare = self.smoother.as_mut().and_then(Smoother::take_spare);
        let preintegration = covered.map(|_| match spare {
            Some(mut spare) => {
                spare.restart(bias, &cut);
                spare
            }
            None => Preintegration::new(self.config.imu, bias, &cut),
        });
        self.scratch = cut;
        preintegration
    }

    fn try_start(
        &mut self,
        id: FrameId,
        time: Timestamp,
        observations: &[TrackObservation],
        preintegration: Option<Preintegration>,
    ) -> Result<StepOutput, SmootherError> {
        self.log.push(LoggedFrame { frame: id, time, preintegration, observations: observations.to_vec() });
        let old = self.log.len().saturating_sub((WINDOW_SECS * 100.0) as usize);
        self.log.drain(..old);
        if self.resting || !self.log.len().is_multiple_of(self.config.attempt_every) {
            return Ok(StepOutput::Waiting(None));
        }
        match self.start.attempt(&self.log)? {
            InitOutcome::Failed(failure) => Ok(StepOutput::Waiting(Some(failure))),
            InitOutcome::Solved(started) => {
                let mut smoother = started.smoother;
                // What was not used by the start may still become landmarks.
                let held: FxHashSet<FrameId> = smoother.frames().collect();
                let log = std::mem::take(&mut self.log);
                for frame in log.iter().filter(|f| held.contains(&f.frame)) {
                    self.remember(frame.frame, &frame.observations);
                }
                let known: Vec<LandmarkId> = smoother.landmarks().map(|l| l.id).collect();
                known.iter().for_each(|l| {
                    self.tracks.remove(l);
                });
                self.since_keyframe = 0;
                self.trim(&mut smoother)?;
                let state = smoother.newest().map_or(NavState::REST, |(.., s)| *s);
                self.smoother = Some(smoother);
                Ok(StepOutput::Initialised { state, log_scale_sigma: started.log_scale_sigma })
            }
        }
    }

    /// The figure of one frame: predict, add observations, optimise, leave out outliers, keyframe, window.
    fn advance(
        &mut self,
        smoother: &mut Smoother,
        id: FrameId,
        time: Timestamp,
        observations: &[TrackObservation],
        preintegration: Option<Preintegration>,
    ) -> Result<NavState, SmootherError> {
        let last = smoother.newest().map_or(NavState::REST, |(.., s)| *s);
        let predicted = preintegration.as_ref().map_or(last, |r| r.predict(&last));
        smoother.add_frame(id, time, predicted, preintegration)?;
        if self.resting {
            smoother.add_zero_velocity(id, REST_SIGMA_MPS)?;
            if self.rest.is_some() {
                smoother.add_zero_motion(id, ZERO_MOTION_SIGMA_M, ZERO_MOTION_SIGMA_RAD)?;
            }
        }
        self.remember(id, observations);
        let mut tracked = 0;
        for s in observations {
            let near = smoother.predict_pixel(id, s.landmark).is_some_and(|p| (p - s.pixel).norm() < GATE_PX);
            if near {
                smoother.add_observation(&observation(id, s))?;
                tracked += 1;
            }
        }
        smoother.optimise_into(self.config.iterations, &mut self.report);
        self.leave_out(smoother);
        self.since_keyframe += 1;
        let is_due = match self.resting {
            // The first frame of a rest stands for all of it.
            true => self.rest.is_none(),
            false => {
                let few = self.since_keyframe >= self.config.keyframe_every || tracked < 40;
                few && has_moved(smoother, id)
            }
        };
        if is_due {
            smoother.mark_keyframe(id)?;
            self.since_keyframe = 0;
            self.add_landmarks(smoother, id, observations)?;
        }
        let state = smoother.newest().map_or(predicted, |(.., s)| *s);
        self.update_standstill(smoother, id, time)?;
        self.trim(smoother)?;
        Ok(state)
    }

    /// Holds a rest of any length by its first frame and the newest one.
    fn update_standstill(
        &mut self,
        smoother: &mut Smoother,
        id: FrameId,
        time: Timestamp,
    ) -> Result<(), SmootherError> {
        self.rest = match self.rest {
            _ if !self.resting => None,
            None => Some((id, time)),
            Some((first, folded)) => {
                let between = smoother.frames().rev().nth(1);
                if let Some(between) = between.filter(|b| *b != first) {
                    smoother.drop_frame(between, &mut self.marginalisation)?;
                }
                let is_long = (time - folded).as_secs_f64() >= STANDSTILL_FOLD_SECS;
                if is_long {
                    smoother.fold_standstill(&mut self.marginalisation)?;
                }
                Some((first, if is_long { time } else { folded }))
            }
        };
        Ok(())
    }

    fn remember(&mut self, id: FrameId, observations: &[TrackObservation]) {
        for s in observations.iter().filter(|s| !self.banned.contains(&s.landmark)) {
            self.tracks.entry(s.landmark).or_default().push((id, *s));
        }
    }

    fn trim(&mut self, smoother: &mut Smoother) -> Result<(), SmootherError> {
        loop {
            let newest = smoother.newest().map(|(id, ..)| id);
            let keyframes: FxHashSet<FrameId> = smoother.keyframes().collect();
            let mut others = smoother.frames().filter(|f| !keyframes.contains(f) && Some(*f) != newest);
            let (first_other, first) = (others.next(), smoother.frames().next());
            let other_count = smoother.len() - keyframes.len();
            if let Some(other) = first_other.filter(|_| other_count > self.config.recent) {
                drop(others);
                smoother.drop_frame(other, &mut self.marginalisation)?;
            } else if let Some(first) = first.filter(|_| keyframes.len() > self.config.keyframes) {
                drop(others);
                let repeated =
                    median_inverse(smoother).and_then(|inverse| smoother.repeated_keyframe(inverse));
                smoother.marginalise(repeated.unwrap_or(first), &mut self.marginalisation)?;
            } else {
                break;
            }
            for ended in &self.marginalisation.ended {
                // Its observations are in the prior now.
                self.tracks.remove(ended);
            }
        }
        let held: FxHashSet<FrameId> = smoother.frames().collect();
        self.tracks.retain(|_, history| history.last().is_some_and(|(f, _)| held.contains(f)));
        Ok(())
    }
}

/// Whether a frame is as far from the last keyframe as a new one should be: without a base, keyframes would only push out
/// those that know the scene.
fn has_moved(smoother: &Smoother, id: FrameId) -> bool {
    let place = |f: FrameId| smoother.state(f).map(|s| s.world_from_body.translation);
    let Some((here, last)) = place(id).zip(smoother.keyframes().next_back().and_then(place)) else {
        return true;
    };
    let Some(median) = median_inverse(smoother) else { return true };
    (here - last).norm() * median > MIN_KEYFRAME_BASE
}

/// Median inverse distance of the landmarks from their hosts, 1/m.
fn median_inverse(smoother: &Smoother) -> Option<f64> {
    let mut inverse: Vec<f64> = smoother.landmarks().map(|l| l.inverse_distance).collect();
    median_upper(&mut inverse)
}
