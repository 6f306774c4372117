//! What is kept for the adjustment after the recording's end, and the adjustment.

use super::{Odometry, Phase, Status};
use crate::bundle_adjustment::{
    self, Adjusted, AdjustmentError, AdjustmentInput, CalibrationSigmas, ImagePrior, LoggedState, Progress,
    TrackLog,
};
use crate::imu::{NavState, StepNoise};
use crate::tracking::{host_covariance, noisy_covariance};
use std::ops::ControlFlow;
use vidar_core::{Frame, FrameId, Health};

impl Odometry {
    /// Logs what image `id` shows, where a log is kept and the image is due or a keyframe.
    pub(super) fn log_image(&mut self, frame: &Frame, id: FrameId, status: &Status) {
        let Some(log) = &mut self.log else { return };
        log.add_stamp(frame.id, frame.time);
        let is_keyframe = matches!(status, Status::Tracking(tracking) if tracking.keyframe.is_some());
        if !is_keyframe && !log.is_due(frame.time) {
            return;
        }
        let (tracks, state) = match &self.phase {
            Phase::Initializing(initializer) => (&initializer.tracker.tracks, None),
            Phase::Tracking(window) => (&window.tracker.tracks, window.state()),
        };
        let noise_px = self.config.pixel_noise_px;
        let shown = tracks.iter().filter_map(|t| match &t.measured {
            _ if t.host.frame == id => Some((t.id, &t.feature.pixel, host_covariance(t))),
            Some(measured) if t.last_frame == id => {
                Some((t.id, &t.last_pixel, noisy_covariance(measured, noise_px)))
            }
            _ => None,
        });
        // Where the IMU alone carried the state it is no better than what the adjustment carries itself.
        let is_seen = matches!(status, Status::Tracking(tracking) if tracking.health != Health::Degraded);
        let placed = self.placed;
        let in_world = |state: NavState| placed.map_or(state, |placed| state.moved(&placed));
        let logged = |state| LoggedState { segment: self.segment, state: in_world(state) };
        let state = state.filter(|_| is_seen).map(logged);
        let Some(log) = &mut self.log else { return };
        log.add_image(id, (frame.id, frame.time), state, shown);
        if let Some(host) = self.last_host.as_ref().filter(|host| self.keeps_log && host.frame == id) {
            log.add_place(frame.time, host);
        }
        if let Phase::Tracking(window) = &self.phase {
            log.follow(&window.smoother, in_world);
        }
    }

    /// Keeps tracks and IMU measurements from here on, for [`Odometry::adjust`]: about 2 MB per minute of recording, and at most
    /// 32 MB of grey levels.
    pub fn keep_log(&mut self) {
        self.keeps_log = true;
        self.log = self.new_log();
    }

    /// Drops the grey levels that were kept: the adjustment then has no loop constraints.
    pub fn forget_log_images(&mut self) {
        self.log.iter_mut().for_each(TrackLog::forget_places);
    }

    /// One adjustment of all states that the log holds; see [`bundle_adjustment`].
    ///
    /// # Errors
    /// No log was kept or there is no IMU; otherwise as [`bundle_adjustment::adjust`].
    pub fn adjust(&self, sigmas: &CalibrationSigmas) -> Result<Adjusted, AdjustmentError> {
        self.adjust_with(sigmas, &mut |_| ControlFlow::Continue(()))
    }

    /// As [`Odometry::adjust`]. `tell` hears how far it is, and is asked before every iteration whether to go on.
    ///
    /// # Errors
    /// As [`Odometry::adjust`], and [`AdjustmentError::Cancelled`] where `tell` broke it off.
    pub fn adjust_with(
        &self,
        sigmas: &CalibrationSigmas,
        tell: &mut dyn FnMut(Progress) -> ControlFlow<()>,
    ) -> Result<Adjusted, AdjustmentError> {
        let kept = self.log.as_ref().filter(|_| self.keeps_log);
        let (Some(log), Some(model)) = (kept, &self.imu_model) else {
            return Err(AdjustmentError::TooShort { images: 0 });
        };
        let mut camera = self.camera.clone();
        camera.time_offset += self.estimated_offset();
        let data_sheet = StepNoise {
            gyro_density: model.noise.gyro_density / self.config.gyro_noise_factor,
            accel_density: model.noise.accel_density / self.config.accel_noise_factor,
            ..model.noise
        };
        let log = self.joined_log(log);
        let input = AdjustmentInput {
            log: &log,
            camera: &camera,
            readout_secs: self.time_calibration.readout_secs,
            given_body_from_camera: self.given_body_from_camera,
            // The adjustment has the gains among its unknowns.
            model: model.with_gyro_gain_std(0.0),
            data_sheet,
            sigmas: &CalibrationSigmas {
                principal_point_px: sigmas.principal_point_px / self.working.factor(),
                images: sigmas.images.or(self.image_prior()),
                ..sigmas.clone()
            },
        };
        let adjusted = bundle_adjustment::adjust(&input, tell)?;
        self.working.restore_adjusted(adjusted).map_err(|_| AdjustmentError::Undetermined)
    }

    /// What the window takes images to have of their own.
    pub(super) fn image_prior(&self) -> ImagePrior {
        let window = self.config.smoother();
        ImagePrior { focal: None, shift: window.image_shift_sigma(), delay: window.delay_sigma() }
    }
}
