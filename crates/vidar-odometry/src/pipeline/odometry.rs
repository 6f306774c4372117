//! Events in, one output per image.

use super::health::{HealthDecision, HealthMonitor, MAX_IMU_GAP_SECS};
use super::keyframes::{KeyframeInput, KeyframeRegistry, public_state, seen_landmarks};
use super::orientation_check::{MAX_TURN_DEG, OrientationCheck};
use super::output::{DivergenceSign, LossReason, OdometryOutput, Status, TrackSummary, Tracking};
use super::time_calibration::{CameraTiming, TimeCalibration};
use super::working_size::WorkingSize;
use crate::backend::{CalibrationEstimate, Smoother, SmootherError};
use crate::bundle_adjustment::TrackLog;
use crate::config::{ImuUse, OdometryConfig};
use crate::error::OdometryError;
use crate::frontend::FrontendConfig;
use crate::gyro_alignment::RollingShutter;
use crate::imu::{Bias, ImuBuffer, ImuModel, Preintegration, propagate};
use crate::initialization::{INITIAL_INVERSE_DISTANCE, InitialState, Initializer, STILL_SECS};
use crate::initialization::{InitFailure, InitFailureReason, StaticInitConfig, initialize_static};
use crate::stages::{Stage, StageClock, StageTimes};
use crate::tracking::HostImage;
use crate::tracking::ImuStatistics;
use crate::tracking::Tracker;
use crate::tracking::{FrameInput, SlidingWindowOdometry, StepReport};
use crate::tracking::{ImagePool, TrackRecord};
use nalgebra::Vector3;
use std::collections::VecDeque;
use std::rc::Rc;
use vidar_core::{
    CameraId, Duration, Frame, FrameId, Health, ImuSample, LieGroup, Rig, RigCamera, Se3, SensorEvent,
    Timestamp,
};

/// Images that may wait for IMU measurements of their time.
const MAX_PENDING: usize = 40;

/// A clock offset known this well outlives a loss, s.
const KNOWN_CLOCK_SECS: f64 = 1e-3;

/// Stretch of a recording from which the camera's timing is found, s: a hand turns often enough within it.
const TIMING_SECS: f64 = 30.0;

/// Noise of images that the front end reckons with, grey levels.
const IMAGE_NOISE_GRAY: f64 = 3.0;

/// What was not used, counted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct InputCounts {
    /// Images taken.
    pub images: usize,
    /// IMU measurements taken.
    pub imu_samples: usize,
    /// Images left out because their time did not advance.
    pub images_out_of_order: usize,
    /// IMU measurements left out because their time did not advance or they were not finite.
    pub imu_samples_rejected: usize,
    /// Images that were the same as the one before, pixel by pixel.
    pub images_repeated: usize,
    /// Stretches without IMU measurements, longer than the rate explains.
    pub imu_gaps: usize,
}

mod adjustment;

#[derive(Debug)]
enum Phase {
    Initializing(Box<Initializer>),
    Tracking(Box<SlidingWindowOdometry>),
}

/// Visual-inertial odometry of one camera and one IMU.
#[derive(Debug)]
pub struct Odometry {
    config: OdometryConfig,
    frontend: FrontendConfig,
    camera_id: CameraId,
    /// Of the images that are worked with.
    camera: RigCamera,
    working: WorkingSize,
    /// As the caller's calibration has it.
    given_body_from_camera: Se3,
    imu_model: Option<ImuModel>,
    imu: ImuBuffer,
    pending: VecDeque<Frame>,
    phase: Phase,
    counts: InputCounts,
    last_image: Option<Timestamp>,
    /// Time, in the IMU's clock, of the newest frame that the phase knows.
    last_frame: Option<Timestamp>,
    next_frame: u32,
    segment: u32,
    interval: Vec<ImuSample>,
    last_host: Option<Rc<HostImage>>,
    failure: InitFailure,
    health_monitor: HealthMonitor,
    keyframes: KeyframeRegistry,
    check: OrientationCheck,
    time_calibration: TimeCalibration,
    images: ImagePool,
    clock: StageClock,
    /// What is kept for the adjustment, where one is wanted.
    log: Option<TrackLog>,
}

impl Odometry {
    /// An odometry for camera `camera` of `rig`.
    ///
    /// # Errors
    /// A setting outside its range, a camera or IMU that the rig lacks, a calibration that cannot be true.
    pub fn new(rig: &Rig, camera: CameraId, config: &OdometryConfig) -> Result<Self, OdometryError> {
        config.validate()?;
        let mut rig_camera = rig.camera(camera).ok_or(OdometryError::NoSuchCamera(camera))?.clone();
        let noise = match config.imu {
            ImuUse::Off => None,
            ImuUse::Auto => rig.imu,
            ImuUse::Required => Some(rig.imu.ok_or(OdometryError::NoImu)?),
        };
        super::calibration::check(&rig_camera)?;
        let (working, working_camera) = WorkingSize::of(&rig_camera.model);
        rig_camera.model = working_camera;
        let imu_model = noise.map(|n| {
            ImuModel::from_data_sheet(&n, config.gyro_noise_factor, config.accel_noise_factor)
                .with_gravity(config.gravity_mps2)
        });
        let frontend = FrontendConfig::default();
        // From here on `off` says what is, not only what was asked for.
        let imu = if imu_model.is_some() { config.imu } else { ImuUse::Off };
        let config = OdometryConfig { imu, ..config.clone() };
        let phase =
            Phase::Initializing(Box::new(initializer(&config, imu_model.is_none(), &rig_camera, &frontend)));
        let time_calibration = TimeCalibration::new(&config);
        Ok(Self {
            config,
            frontend,
            camera_id: camera,
            check: OrientationCheck::new(&rig_camera.body_from_camera.rotation),
            time_calibration,
            images: ImagePool::default(),
            clock: StageClock::start(),
            log: None,
            given_body_from_camera: rig_camera.body_from_camera,
            camera: rig_camera,
            working,
            imu_model,
            imu: ImuBuffer::new(noise.map_or(200.0, |n| n.rate_hz)),
            pending: VecDeque::new(),
            phase,
            counts: InputCounts::default(),
            last_image: None,
            last_frame: None,
            next_frame: 0,
            segment: 0,
            interval: Vec::new(),
            last_host: None,
            failure: InitFailure { reason: InitFailureReason::Frames, measured: 0.0, limit: 5.0 },
            health_monitor: HealthMonitor::default(),
            keyframes: KeyframeRegistry::default(),
        })
    }

    /// Takes an event; says what is known after the oldest image that waited for it, if any did.
    ///
    /// An image is worked on when IMU measurements past its time have come, so the output may belong to an earlier image.
    /// Events of other cameras, depth and ground truth are ignored. What is out of order or not finite is counted
    /// ([`Odometry::counts`]) and left out.
    ///
    /// # Errors
    /// An image of another size than its camera's model.
    pub fn push(&mut self, event: SensorEvent) -> Result<Option<OdometryOutput>, OdometryError> {
        match event {
            SensorEvent::Imu(sample) if self.imu_model.is_some() => match self.imu.push(sample) {
                Ok(()) => {
                    self.counts.imu_samples += 1;
                    if let Some(log) = &mut self.log {
                        log.add_imu(&sample);
                    }
                    match self.imu_model.is_some_and(|m| sample.gyro.0.amax() >= m.gyro_limit) {
                        true => self.time_calibration.forget(),
                        false => self.time_calibration.add_gyro(&sample),
                    }
                }
                Err(_) => self.counts.imu_samples_rejected += 1,
            },
            SensorEvent::Image(frame) if frame.camera == self.camera_id => self.take_image(frame)?,
            _ => {}
        }
        let ready =
            self.pending.front().is_some_and(|f| self.is_ready(f) || self.pending.len() > MAX_PENDING);
        if !ready {
            return Ok(None);
        }
        let frame = self.pending.pop_front();
        Ok(frame.and_then(|f| self.process(f)))
    }

    /// Works on the images that still wait, with the IMU measurements there are.
    pub fn finish(&mut self) -> Vec<OdometryOutput> {
        let mut outputs = Vec::new();
        while let Some(frame) = self.pending.pop_front() {
            outputs.extend(self.process(frame));
        }
        outputs
    }

    /// What was taken and what was left out so far.
    pub fn counts(&self) -> InputCounts {
        self.counts
    }

    /// Where the time of the newest image went.
    pub fn stage_times(&self) -> StageTimes {
        self.clock.times()
    }

    /// All tracks as the newest image showed them, for plots; none before the start.
    pub fn tracks(&self) -> Vec<TrackRecord> {
        match &self.phase {
            Phase::Initializing(_) => Vec::new(),
            Phase::Tracking(window) => {
                window.records().into_iter().map(|track| self.working.restore_track(track)).collect()
            }
        }
    }

    fn take_image(&mut self, mut frame: Frame) -> Result<(), OdometryError> {
        let (width, height) = self.working.given();
        let (found_width, found_height) = (frame.image.width(), frame.image.height());
        if (found_width, found_height) != (width, height) {
            return Err(OdometryError::WrongImageSize { width, height, found_width, found_height });
        }
        if self.last_image.is_some_and(|last| frame.time <= last) {
            self.counts.images_out_of_order += 1;
            return Ok(());
        }
        self.last_image = Some(frame.time);
        self.counts.images += 1;
        frame.image = self.working.image(frame.image);
        self.pending.push_back(frame);
        Ok(())
    }

    fn imu_time(&self, frame: &Frame) -> Timestamp {
        frame.time + self.camera.time_offset + self.estimated_offset()
    }

    /// Correction of the clock offset that the next frame is stamped with.
    fn estimated_offset(&self) -> Duration {
        match &self.phase {
            Phase::Tracking(window) => window.smoother.next_frame_offset(),
            Phase::Initializing(_) => Duration::ZERO,
        }
    }

    /// The calibration as estimated on the way: where the camera is on the body, and what to add to image stamps to get
    /// the IMU's time. `None` before the start.
    pub fn calibration(&mut self) -> Option<CalibrationEstimate> {
        let Phase::Tracking(window) = &mut self.phase else { return None };
        let estimate = window.smoother.calibration();
        let time_offset_secs = self.camera.time_offset.as_secs_f64() + estimate.time_offset_secs;
        Some(CalibrationEstimate { time_offset_secs, ..estimate })
    }

    /// Clock, readout and rotation of the camera as used now. Run over the first half minute of a recording, they can be given to
    /// an odometry that starts at its beginning: [`Odometry::with_timing`].
    pub fn timing(&self) -> CameraTiming {
        let offset = self.camera.time_offset + self.estimated_offset();
        self.time_calibration.timing(&self.camera, offset.as_secs_f64())
    }

    /// Finds clock, readout and rotation of a camera from the beginning of a recording: events are taken until the values
    /// are settled, for half a minute at most.
    ///
    /// # Errors
    /// As [`Odometry::new`] and [`Odometry::push`].
    pub fn find_timing(
        rig: &Rig,
        camera: CameraId,
        config: &OdometryConfig,
        events: impl IntoIterator<Item = SensorEvent>,
    ) -> Result<CameraTiming, OdometryError> {
        let mut odometry = Self::new(rig, camera, config)?;
        let mut first = None;
        for event in events {
            odometry.push(event)?;
            let Some(newest) = odometry.last_image else { continue };
            let seen_secs = (newest - *first.get_or_insert(newest)).as_secs_f64();
            if odometry.time_calibration.is_settled() || seen_secs > TIMING_SECS {
                break;
            }
        }
        odometry.recalibrate(None);
        Ok(odometry.timing())
    }

    /// An odometry that begins with what another one found of the camera's clock, readout and rotation.
    ///
    /// # Errors
    /// As [`Odometry::new`].
    pub fn with_timing(
        rig: &Rig,
        camera: CameraId,
        config: &OdometryConfig,
        timing: &CameraTiming,
    ) -> Result<Self, OdometryError> {
        let mut rig = rig.clone();
        let found = rig.cameras.get_mut(camera.index()).ok_or(OdometryError::NoSuchCamera(camera))?;
        let given_body_from_camera = found.body_from_camera;
        let mut config = config.clone();
        timing.apply(found, &mut config);
        Ok(Self { given_body_from_camera, ..Self::new(&rig, camera, &config)? })
    }

    fn is_ready(&self, frame: &Frame) -> bool {
        let half_readout = Duration::from_secs_f64(0.5 * self.time_calibration.readout_secs);
        let until = self.imu_time(frame) + half_readout;
        self.imu_model.is_none() || self.imu.newest().is_some_and(|newest| newest >= until)
    }

    /// One image. `None` when nothing can be said of it.
    fn process(&mut self, frame: Frame) -> Option<OdometryOutput> {
        self.clock = StageClock::start();
        let time = self.imu_time(&frame);
        let id = FrameId(self.next_frame);
        self.next_frame = self.next_frame.wrapping_add(1);
        // The size was checked when the image came.
        let host = self.images.take(id, &frame.image, self.frontend.pyramid.levels, self.shutter_at(time))?;
        let was_starting = matches!(self.phase, Phase::Initializing(_));
        let status = self.status_after(&frame, host, time);
        self.log_image(&frame, id, &status);
        let status = match self.imu_model {
            Some(_) => {
                self.log_features_of(id, frame.time);
                self.recalibrate(Some(frame.time)).unwrap_or(status)
            }
            None => status,
        };
        self.clock.lap(if was_starting { Stage::Initialise } else { Stage::Output });
        self.imu.forget_before(self.last_frame.unwrap_or(time) - Duration::from_millis(1500));
        Some(OdometryOutput { frame_id: frame.id, time: frame.time, status })
    }

    fn status_after(&mut self, frame: &Frame, host: Rc<HostImage>, time: Timestamp) -> Status {
        if let Some(reason) = self.gap_before(time) {
            self.last_frame = Some(time);
            self.last_host = Some(host);
            return self.lose(reason);
        }
        let preintegration = self.preintegrate_until(time);
        self.clock.lap(Stage::Pyramid);
        let repeated = self.last_host.as_ref().is_some_and(|l| l.pyramid.level(0) == host.pyramid.level(0));
        let imu_still = self.imu_is_still(time);
        self.counts.images_repeated += usize::from(repeated);
        // The same image again is what a body at rest would see; of a moving one it tells nothing.
        if repeated && !imu_still {
            return self.coast(preintegration, frame.time);
        }
        self.last_host = Some(host.clone());
        self.last_frame = Some(time);
        let gyro = preintegration.as_ref().map(|r| (r.rotation(r.bias()).log(), r.secs()));
        match &mut self.phase {
            Phase::Initializing(initializer) => {
                let found = initializer.follow(host.clone(), time, preintegration);
                self.check.add(&self.camera.model, &initializer.tracker.tracks, host.frame, gyro);
                if let Some(turn_deg) = self.check.inconsistency_deg() {
                    let reason = InitFailureReason::CameraOrientation;
                    return self.wait(InitFailure { reason, measured: turn_deg, limit: MAX_TURN_DEG });
                }
                let resting = initializer.images_still && imu_still;
                match found {
                    _ if resting => self.start_static(frame, &host, time),
                    Ok(found) => self.start_in_flight(found, frame, &host),
                    Err(failure) => {
                        self.failure = failure.clone();
                        Status::Waiting(failure)
                    }
                }
            }
            Phase::Tracking(window) => {
                let frame_id = host.frame;
                let step = window.step(FrameInput { host, time, preintegration, imu_still }, &mut self.clock);
                self.check.add(&self.camera.model, &window.tracker.tracks, frame_id, gyro);
                if let Some(found) = self.check.inconsistency_deg() {
                    let (sign, limit) = (DivergenceSign::CameraOrientation, MAX_TURN_DEG);
                    return self.lose(LossReason::Diverged { sign, found, limit });
                }
                match step {
                    Ok(step) => self.report(&step, frame, frame_id),
                    Err(error) => self.lose(LossReason::Backend(error)),
                }
            }
        }
    }

    /// How the camera moves while an image of this time is read out, as gyroscope and newest state give it.
    fn shutter_at(&self, time: Timestamp) -> RollingShutter {
        let readout_secs = self.time_calibration.readout_secs;
        let half = Duration::from_secs_f64(0.5 * readout_secs);
        let ends = (self.imu.at(time - half), self.imu.at(time + half));
        let (true, (Some(first), Some(last))) = (readout_secs > 0.0, ends) else {
            return RollingShutter::default();
        };
        let camera_from_body = self.camera.body_from_camera.rotation.inverse();
        let (bias, velocity) = match &self.phase {
            Phase::Tracking(window) => window.state().map_or((Vector3::zeros(), Vector3::zeros()), |s| {
                let body_velocity = s.world_from_body.rotation.inverse() * s.velocity;
                let rate = 0.5 * (first.gyro.0 + last.gyro.0) - s.bias.gyro;
                let at_camera = body_velocity + rate.cross(&self.camera.body_from_camera.translation);
                (s.bias.gyro, camera_from_body * at_camera)
            }),
            Phase::Initializing(initializer) => (initializer.gyro_bias(), Vector3::zeros()),
        };
        RollingShutter {
            readout_secs,
            rate: camera_from_body * (0.5 * (first.gyro.0 + last.gyro.0) - bias),
            acceleration: camera_from_body * ((last.gyro.0 - first.gyro.0) / readout_secs),
            velocity,
        }
    }

    /// Checks clock, readout and camera rotation against tracks and gyroscope, with an image stamped `now` or after the last one; starts
    /// anew where they were corrected.
    fn recalibrate(&mut self, now: Option<Timestamp>) -> Option<Status> {
        let offset = self.camera.time_offset + self.estimated_offset();
        let correction = self.time_calibration.correction(
            &self.camera,
            offset.as_secs_f64(),
            matches!(self.phase, Phase::Tracking(_)),
            now,
        )?;
        self.camera.time_offset = Duration::from_secs_f64(correction.offset_secs);
        if let Some(rotation) = correction.body_from_camera {
            self.camera.body_from_camera.rotation = rotation;
            self.check = OrientationCheck::new(&rotation);
        }
        self.last_frame = None;
        if let Phase::Initializing(_) = &self.phase {
            self.initialize_anew();
            return None;
        }
        Some(self.lose(LossReason::Recalibrated {
            time_offset_ms: correction.offset_secs * 1e3,
            readout_ms: correction.readout_secs * 1e3,
        }))
    }

    /// Hands the features of image `id` to the time calibration.
    fn log_features_of(&mut self, id: FrameId, stamp: Timestamp) {
        let tracks = match &self.phase {
            Phase::Initializing(initializer) => &initializer.tracker.tracks,
            Phase::Tracking(window) => &window.tracker.tracks,
        };
        let shown = tracks.iter().filter(|t| t.last_frame == id).map(|t| (t.id, t.last_pixel));
        self.time_calibration.add_image(stamp, shown);
    }

    /// A stretch without images or IMU measurements that cannot be bridged.
    fn gap_before(&mut self, time: Timestamp) -> Option<LossReason> {
        let (Phase::Tracking(_), Some(last)) = (&self.phase, self.last_frame) else {
            return None;
        };
        let secs = (time - last).as_secs_f64();
        if secs > self.config.max_blind_secs {
            return Some(LossReason::ImageGap { secs });
        }
        self.imu_model?;
        match self.imu.interval(last, time, &mut self.interval) {
            Ok(Some(gap)) if gap.length.as_secs_f64() > MAX_IMU_GAP_SECS => {
                Some(LossReason::ImuGap { secs: gap.length.as_secs_f64() })
            }
            Ok(_) => None,
            Err(_) => Some(LossReason::ImuGap { secs }),
        }
    }

    /// The state carried forward by the IMU, for an image that tells nothing.
    fn coast(&mut self, preintegration: Option<Preintegration>, time: Timestamp) -> Status {
        let Phase::Tracking(window) = &mut self.phase else {
            return Status::Waiting(self.failure.clone());
        };
        let Some(state) = window.state() else { return Status::Waiting(self.failure.clone()) };
        let covariance = window.smoother.covariance_of_newest().unwrap_or_else(unknown_covariance);
        let scale_std = present_scale_std(&mut window.smoother, self.imu_model.is_some());
        let (state, covariance) = match &preintegration {
            Some(preintegration) => {
                let carried = propagate(&state, &covariance, preintegration);
                (carried.state, carried.covariance)
            }
            None => (state, covariance),
        };
        let tracking = Tracking {
            segment: self.segment,
            state: public_state(&state, time),
            covariance,
            scale_std,
            health: Health::Degraded,
            tracked: 0,
            tracks: TrackSummary::default(),
            landmarks: Vec::new(),
            keyframe: None,
            revised: Vec::new(),
        };
        Status::Tracking(Box::new(tracking))
    }

    fn preintegrate_until(&mut self, time: Timestamp) -> Option<Preintegration> {
        let (model, from) = (self.imu_model?, self.last_frame?);
        let gap = self.imu.interval(from, time, &mut self.interval).ok()?;
        self.counts.imu_gaps += usize::from(gap.is_some());
        let (bias, spare) = match &mut self.phase {
            Phase::Tracking(window) => (window.state()?.bias, window.spare_preintegration()),
            Phase::Initializing(initializer) => {
                (Bias { gyro: initializer.gyro_bias(), accel: Vector3::zeros() }, None)
            }
        };
        let Some(mut preintegration) = spare else {
            return Some(Preintegration::new(model, bias, &self.interval));
        };
        preintegration.restart(bias, &self.interval);
        Some(preintegration)
    }

    /// Whether the IMU measurements of the last half second are those of a body at rest.
    fn imu_is_still(&self, time: Timestamp) -> bool {
        let from = time - Duration::from_secs_f64(STILL_SECS);
        let (Some(model), Some(first)) = (&self.imu_model, self.imu.iter().next()) else { return false };
        let recent = self.imu.iter().filter(|s| s.time >= from && s.time <= time);
        first.time <= from && ImuStatistics::of(recent).is_still(&model.noise)
    }

    /// Starts from a body at rest: level and gyroscope bias are known, the velocity is zero, and the scale follows as
    /// soon as the body moves.
    fn start_static(&mut self, frame: &Frame, host: &Rc<HostImage>, time: Timestamp) -> Status {
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
        self.time_calibration.forget_tracks();
        self.log.iter_mut().for_each(TrackLog::next_generation);
        let Ok(mut smoother) = self.smoother() else { return self.wait(self.failure.clone()) };
        let begun = smoother.start(host.frame, time, at_rest.state, at_rest.sigmas);
        if begun.and_then(|()| smoother.mark_keyframe(host.frame)).is_err() {
            return self.wait(self.failure.clone());
        }
        let mut tracker = Tracker::new(self.camera.model.clone(), &self.frontend, IMAGE_NOISE_GRAY);
        tracker.detect(host, 2 * self.config.max_landmarks, INITIAL_INVERSE_DISTANCE);
        let hosts = vec![host.clone()];
        let window = SlidingWindowOdometry::new(
            self.config.clone(),
            smoother,
            tracker,
            hosts,
            INITIAL_INVERSE_DISTANCE,
        );
        let Some(mut window) = window else { return self.wait(self.failure.clone()) };
        window.stand(time);
        self.begin(window, frame, host.frame)
    }

    /// Goes on with the smoother that solved the start.
    fn start_in_flight(&mut self, found: InitialState, frame: &Frame, host: &Rc<HostImage>) -> Status {
        let waiting = Phase::Initializing(Box::new(initializer(
            &self.config,
            self.imu_model.is_none(),
            &self.camera,
            &self.frontend,
        )));
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
        let Some(window) = window else { return self.wait(self.failure.clone()) };
        self.begin(window, frame, host.frame)
    }

    fn begin(&mut self, window: SlidingWindowOdometry, frame: &Frame, id: FrameId) -> Status {
        self.phase = Phase::Tracking(Box::new(window));
        let step = StepReport { just_started: true, is_keyframe: true, ..StepReport::default() };
        self.report(&step, frame, id)
    }

    fn wait(&mut self, failure: InitFailure) -> Status {
        self.failure = failure.clone();
        Status::Waiting(failure)
    }

    fn smoother(&self) -> Result<Smoother, SmootherError> {
        Smoother::new(self.config.smoother(), self.camera.model.clone(), self.camera.body_from_camera)
    }

    /// What is known after a step.
    fn report(&mut self, step: &StepReport, frame: &Frame, id: FrameId) -> Status {
        let is_metric = self.imu_model.is_some();
        let Phase::Tracking(window) = &mut self.phase else {
            return Status::Waiting(self.failure.clone());
        };
        let Some(state) = window.state() else { return Status::Waiting(self.failure.clone()) };
        let smoother = &mut window.smoother;
        let covariance = smoother.covariance_of_newest().unwrap_or_else(unknown_covariance);
        let scale_std = present_scale_std(smoother, is_metric);
        let health = match self.health_monitor.evaluate(
            &state,
            step,
            frame.time,
            is_metric,
            scale_std,
            &self.config,
        ) {
            HealthDecision::Continue(health) => health,
            HealthDecision::Lost(reason) => return self.lose(reason),
        };
        let world_from_camera = state.world_from_body * *smoother.body_from_camera();
        let mut landmarks = seen_landmarks(smoother, &window.tracker.tracks, &world_from_camera);
        self.working.restore_landmarks(&mut landmarks);
        let mut tracking = Tracking {
            segment: self.segment,
            state: public_state(&state, frame.time),
            covariance,
            scale_std,
            health,
            tracked: step.fitting,
            tracks: step.summary(),
            landmarks,
            keyframe: None,
            revised: Vec::new(),
        };
        if step.is_keyframe {
            let input = KeyframeInput {
                frame: id,
                caller_frame: frame.id,
                time: frame.time,
                segment: self.segment,
                state: &state,
                covariance: &covariance,
                scale_std,
                health,
                landmarks: &tracking.landmarks,
            };
            tracking.keyframe = Some(Box::new(self.keyframes.make(smoother, &input)));
        }
        if step.is_keyframe || !step.left.is_empty() {
            self.keyframes.revise(smoother, &step.left, &mut tracking.revised);
        }
        Status::Tracking(Box::new(tracking))
    }

    /// A clock offset that is well known is not forgotten with the state.
    fn keep_clock_offset(&mut self, reason: &LossReason) {
        let Phase::Tracking(window) = &mut self.phase else { return };
        let estimate = window.smoother.calibration();
        let is_known = estimate.time_offset_sigma_secs.is_some_and(|s| s < KNOWN_CLOCK_SECS);
        let keeps = !matches!(reason, LossReason::Diverged { .. } | LossReason::Recalibrated { .. });
        if is_known && keeps {
            self.camera.time_offset += Duration::from_secs_f64(estimate.time_offset_secs);
        }
    }

    /// Gives the state up and starts anew.
    fn lose(&mut self, reason: LossReason) -> Status {
        self.keep_clock_offset(&reason);
        self.initialize_anew();
        self.health_monitor = HealthMonitor::default();
        self.keyframes.forget_held();
        self.segment = self.segment.wrapping_add(1);
        Status::Lost(reason)
    }

    fn initialize_anew(&mut self) {
        self.time_calibration.forget_tracks();
        self.log.iter_mut().for_each(TrackLog::next_generation);
        self.phase = Phase::Initializing(Box::new(initializer(
            &self.config,
            self.imu_model.is_none(),
            &self.camera,
            &self.frontend,
        )));
    }
}

/// Standard deviation of ln(scale) of the present window; infinite where it is not observable or not finite.
fn present_scale_std(smoother: &mut Smoother, is_metric: bool) -> f64 {
    let sigma = if is_metric { smoother.log_scale_sigma() } else { None };
    sigma.filter(|s| s.is_finite()).unwrap_or(f64::INFINITY)
}

/// Covariance of a state that the backend gives none for.
fn unknown_covariance() -> vidar_core::NavCovariance {
    vidar_core::NavCovariance::from_diagonal_element(f64::INFINITY)
}

fn initializer(
    config: &OdometryConfig,
    is_mono: bool,
    camera: &RigCamera,
    frontend: &FrontendConfig,
) -> Initializer {
    let tracker = Tracker::new(camera.model.clone(), frontend, IMAGE_NOISE_GRAY);
    Initializer::new(config.clone(), is_mono, camera.body_from_camera, tracker)
}
