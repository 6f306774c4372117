//! Events in, one output per image.

use super::health::HealthMonitor;
use super::keyframes::KeyframeRegistry;
use super::orientation_check::{MAX_TURN_DEG, OrientationCheck};
use super::output::{DivergenceSign, LossReason, OdometryOutput, Status};
use super::time_calibration::TimeCalibration;
use super::working_size::WorkingSize;
use crate::bundle_adjustment::{ImuGain, TrackLog};
use crate::config::{ImuUse, OdometryConfig};
use crate::error::OdometryError;
use crate::frontend::PYRAMID_LEVELS;
use crate::imu::{ImuBuffer, ImuModel};
use crate::initialization::{InitFailure, InitFailureReason, Initializer};
use crate::stages::{Stage, StageClock, StageTimes};
use crate::tracking::{FrameInput, HostImage, ImagePool, SlidingWindowOdometry, TrackRecord, Tracker};
use image_questions::ImageQuestions;
use relocalization::Relocalizer;
use settling::Settling;
use start::initializing;
use std::collections::VecDeque;
use std::sync::Arc;
use successor::{RecentFrames, Successor};
use vidar_core::{
    CameraId, Duration, Frame, FrameId, ImuSample, LieGroup, RevisedPose, Rig, RigCamera, Se3, SensorEvent,
    Timestamp,
};

mod adjustment;
mod image_questions;
mod inertial;
mod joined_segments;
mod relocalization;
mod report;
mod saved_map;
mod settling;
mod start;
mod successor;
mod timing;

/// Images that may wait for IMU measurements of their time.
const MAX_PENDING: usize = 40;

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

#[derive(Debug)]
enum Phase {
    Initializing(Box<Initializer>),
    Tracking(Box<SlidingWindowOdometry>),
}

/// Visual-inertial odometry of one camera and one IMU.
#[derive(Debug)]
pub struct Odometry {
    config: OdometryConfig,
    camera_id: CameraId,
    /// Of the images that are worked with.
    camera: RigCamera,
    working: WorkingSize,
    /// As the caller's calibration has it.
    given_body_from_camera: Se3,
    imu_model: Option<ImuModel>,
    /// With `imu_gain` applied.
    imu: ImuBuffer,
    imu_gain: ImuGain,
    pending: VecDeque<Frame>,
    phase: Phase,
    counts: InputCounts,
    last_image: Option<Timestamp>,
    /// Time, in the IMU's clock, of the newest frame that the phase knows.
    last_frame: Option<Timestamp>,
    next_frame: u32,
    segment: u32,
    /// The number of the next one.
    next_segment: u32,
    /// From the smoother's world to that of the segment, where a loss is between them and the place was found again.
    placed: Option<Se3>,
    relocalizer: Relocalizer,
    interval: Vec<ImuSample>,
    last_host: Option<Arc<HostImage>>,
    failure: InitFailure,
    health_monitor: HealthMonitor,
    keyframes: KeyframeRegistry,
    /// Poses of keyframes in a scale that was settled with the newest image.
    settled: Vec<RevisedPose>,
    check: OrientationCheck,
    time_calibration: TimeCalibration,
    images: ImagePool,
    /// Images that an odometry with another timing would begin with, as long as the timing is not settled.
    recent: RecentFrames,
    successor: Option<Successor>,
    settling: Settling,
    questions: ImageQuestions,
    clock: StageClock,
    /// What is kept for adjustments: of a scale that is not settled, and after the end.
    log: Option<TrackLog>,
    /// Whether one after the end is wanted.
    keeps_log: bool,
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
        let given_body_from_camera = rig_camera.body_from_camera;
        let (working, working_camera) = WorkingSize::of(&rig_camera.model);
        rig_camera.model = working_camera;
        let imu_model = noise.map(|n| {
            ImuModel::from_data_sheet(&n, config.gyro_noise_factor, config.accel_noise_factor)
                .with_gyro_gain_std(config.gyro_gain_std)
                .with_gravity(config.gravity_mps2)
        });
        // From here on `off` says what is, not only what was asked for.
        let imu = if imu_model.is_some() { config.imu } else { ImuUse::Off };
        let config = OdometryConfig { imu, ..config.clone() };
        let samples = ImuBuffer::new(noise.map_or(200.0, |n| n.rate_hz));
        let tracker = Tracker::new(rig_camera.model.clone(), IMAGE_NOISE_GRAY);
        let fresh = Self::fresh(config, tracker, (camera, rig_camera), working, imu_model, samples);
        let settling = Settling::new(fresh.imu_model.is_some());
        Ok(Self { given_body_from_camera, settling, log: fresh.new_log(), ..fresh })
    }

    /// An odometry that has seen nothing; `camera` is that of the images that are worked with.
    fn fresh(
        config: OdometryConfig,
        tracker: Tracker,
        (camera_id, camera): (CameraId, RigCamera),
        working: WorkingSize,
        imu_model: Option<ImuModel>,
        imu: ImuBuffer,
    ) -> Self {
        let phase = initializing(&config, imu_model.is_none(), &camera, tracker);
        let time_calibration = TimeCalibration::new(&config);
        Self {
            questions: ImageQuestions::new(&config, imu_model.is_some()),
            config,
            camera_id,
            check: OrientationCheck::new(&camera.body_from_camera.rotation),
            recent: RecentFrames::new(imu_model.is_some()),
            successor: None,
            settling: Settling::new(false),
            time_calibration,
            images: ImagePool::default(),
            clock: StageClock::start(),
            log: None,
            keeps_log: false,
            given_body_from_camera: camera.body_from_camera,
            camera,
            working,
            imu_model,
            imu,
            imu_gain: ImuGain::default(),
            pending: VecDeque::new(),
            phase,
            counts: InputCounts::default(),
            last_image: None,
            last_frame: None,
            next_frame: 0,
            segment: 0,
            next_segment: 1,
            placed: None,
            relocalizer: Relocalizer::default(),
            interval: Vec::new(),
            last_host: None,
            failure: InitFailure { reason: InitFailureReason::Frames, measured: 0.0, limit: 5.0 },
            health_monitor: HealthMonitor::default(),
            keyframes: KeyframeRegistry::default(),
            settled: Vec::new(),
        }
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
            SensorEvent::Imu(sample) if self.imu_model.is_some() => {
                match self.imu.push(self.imu_gain.applied(&sample)) {
                    Ok(()) => {
                        self.counts.imu_samples += 1;
                        self.successor.iter_mut().for_each(|s| s.add_imu(sample));
                        if let Some(log) = &mut self.log {
                            log.add_imu(&sample);
                        }
                        match self.imu_model.is_some_and(|m| sample.gyro.0.amax() >= m.gyro_limit) {
                            true => self.time_calibration.forget(),
                            false => self.time_calibration.add_gyro(&sample),
                        }
                    }
                    Err(_) => self.counts.imu_samples_rejected += 1,
                }
            }
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
        let host = self.images.take(id, &frame.image, PYRAMID_LEVELS, self.shutter_at(time))?;
        self.recent.add(id, &frame);
        let was_starting = matches!(self.phase, Phase::Initializing(_));
        let mut status = self.status_after(&frame, host, time);
        self.relocalize(&mut status, id, frame.id, time);
        self.log_image(&frame, id, &status);
        let status = match self.imu_model {
            Some(_) => {
                self.log_features_of(id, frame.time);
                self.recalibrate(Some(frame.time)).unwrap_or(status)
            }
            None => status,
        };
        self.clock.lap(if was_starting { Stage::Initialise } else { Stage::Output });
        self.question_images(frame.time);
        self.settle_scale(&status, frame.time);
        self.shorten_log(frame.time);
        let mut status = self.follow_successor(id).unwrap_or(status);
        if let Status::Tracking(tracking) = &mut status {
            tracking.settled.append(&mut self.settled);
        }
        let used_from = self.last_frame.unwrap_or(time) - Duration::from_millis(1500);
        self.imu.forget_before(self.recent.oldest().map_or(used_from, |t| used_from.min(t)));
        Some(OdometryOutput { frame_id: frame.id, time: frame.time, status })
    }

    fn status_after(&mut self, frame: &Frame, host: Arc<HostImage>, time: Timestamp) -> Status {
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
                    Err(failure)
                        if self.imu_model.is_some() && start::hardly_moves(initializer, &failure) =>
                    {
                        self.start_slow(failure, frame, &host, time)
                    }
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
                if let Some(found) = self.check.contradiction_deg() {
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

    /// Gives the state up and starts anew.
    fn lose(&mut self, reason: LossReason) -> Status {
        self.successor = None;
        self.settling.begin_anew();
        self.recent.go_on(!self.settling.is_over());
        self.keep_clock_offset(&reason);
        self.initialize_anew();
        self.health_monitor = HealthMonitor::default();
        self.keyframes.forget_held();
        self.keyframes.forget_provisional();
        self.relocalizer.lose(&reason, self.last_frame.unwrap_or_default());
        self.placed = None;
        self.segment = self.next_segment;
        self.next_segment = self.next_segment.wrapping_add(1);
        Status::Lost(reason)
    }
}
