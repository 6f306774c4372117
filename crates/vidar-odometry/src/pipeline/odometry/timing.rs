//! The camera's clock, readout and rotation, as they are found while images come.

use super::settling::Settling;
use super::successor::RecentFrames;
use super::{Odometry, Phase, Status};
use crate::backend::CalibrationEstimate;
use crate::config::OdometryConfig;
use crate::error::OdometryError;
use crate::gyro_alignment::RollingShutter;
use crate::pipeline::orientation_check::OrientationCheck;
use crate::pipeline::output::LossReason;
use crate::pipeline::time_calibration::{CameraTiming, Correction};
use crate::tracking::tracks_in;
use nalgebra::Vector3;
use vidar_core::{CameraId, Duration, FrameId, LieGroup, Rig, SensorEvent, Timestamp};

/// A clock offset known this well outlives a loss, s.
const KNOWN_CLOCK_SECS: f64 = 1e-3;

/// Stretch of a recording from which the camera's timing is found, s: a hand turns often enough within it.
const TIMING_SECS: f64 = 30.0;

impl Odometry {
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

    /// Finds clock, readout and rotation of a camera from the beginning of a recording: events are taken until what is found is
    /// settled, for half a minute at most.
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
        // Here no state is worth more than the values.
        odometry.recent = RecentFrames::new(false);
        odometry.settling = Settling::new(false);
        let mut first = None;
        for event in events {
            odometry.push(event)?;
            let Some(newest) = odometry.last_image else { continue };
            let seen_secs = (newest - *first.get_or_insert(newest)).as_secs_f64();
            if seen_secs > TIMING_SECS || odometry.time_calibration.is_settled() {
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

    /// Correction of the clock offset that the next frame is stamped with.
    pub(super) fn estimated_offset(&self) -> Duration {
        match &self.phase {
            Phase::Tracking(window) => window.smoother.next_frame_offset(),
            Phase::Initializing(_) => Duration::ZERO,
        }
    }

    /// How the camera moves while an image of this time is read out, as gyroscope and newest state give it.
    pub(super) fn shutter_at(&self, time: Timestamp) -> RollingShutter {
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
        let left = match &self.phase {
            Phase::Tracking(window) => 1.0 - window.smoother.stabilised_share(),
            Phase::Initializing(_) => 1.0,
        };
        // A stabiliser takes back what turns the image, not what rolls it.
        let left = Vector3::new(left, left, 1.0);
        RollingShutter {
            readout_secs,
            rate: (camera_from_body * (0.5 * (first.gyro.0 + last.gyro.0) - bias)).component_mul(&left),
            acceleration: (camera_from_body * ((last.gyro.0 - first.gyro.0) / readout_secs))
                .component_mul(&left),
            velocity,
        }
    }

    /// Checks clock, readout and camera rotation against tracks and gyroscope, with an image stamped `now` or after the last one. Where
    /// they are corrected, a second odometry begins with them on the last images; without images it starts anew.
    pub(super) fn recalibrate(&mut self, now: Option<Timestamp>) -> Option<Status> {
        if self.successor.is_some() {
            return None;
        }
        let offset = self.camera.time_offset + self.estimated_offset();
        let correction = self.time_calibration.correction(
            &self.camera,
            offset.as_secs_f64(),
            matches!(self.phase, Phase::Tracking(_)),
            now,
        )?;
        if now.is_some() && self.begin_successor(&correction) {
            return None;
        }
        self.correct(&correction)
    }

    /// Goes on with corrected values from here on; a state is given up.
    pub(super) fn correct(&mut self, correction: &Correction) -> Option<Status> {
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
    pub(super) fn log_features_of(&mut self, id: FrameId, stamp: Timestamp) {
        let tracker = self.phase.tracker();
        let shown = tracks_in(&tracker.tracks, id);
        self.time_calibration.add_image(stamp, shown, &tracker.fixed);
    }

    /// A clock offset that is well known is not forgotten with the state.
    pub(super) fn keep_clock_offset(&mut self, reason: &LossReason) {
        let Phase::Tracking(window) = &mut self.phase else { return };
        let estimate = window.smoother.calibration();
        let is_known = estimate.time_offset_sigma_secs.is_some_and(|s| s < KNOWN_CLOCK_SECS);
        let keeps = !matches!(reason, LossReason::Diverged { .. } | LossReason::Recalibrated { .. });
        if is_known && keeps {
            self.camera.time_offset += Duration::from_secs_f64(estimate.time_offset_secs);
        }
    }
}
