//! What the smoother estimates: states of the frames held, landmarks, and the camera's calibration.

use super::window::Frame;
use super::{LandmarkEstimate, Smoother, inertial, linearise, visual};
use crate::imu::{ImuModel, NavState, Preintegration};
use nalgebra::Vector2;
use vidar_core::{CameraModel, Duration, FrameId, LandmarkId, LieGroup, Se3, Timestamp};

/// The clock offset that frames are stamped with changes by no more than this from frame to frame, s: less than the time
/// between images of any camera that is used.
const MAX_CLOCK_STEP_SECS: f64 = 2e-3;

/// Two frames nearer together than this share of the scene's distance, turned by less than this, rad, show the same: about a pixel of parallax and ten
/// pixels of motion at a focal length of 460.
const SAME_VIEW: f64 = 2e-3;
const SAME_VIEW_RAD: f64 = 0.02;

impl Smoother {
    /// Frames held, oldest first.
    pub fn frames(&self) -> impl DoubleEndedIterator<Item = FrameId> + ExactSizeIterator + '_ {
        self.frames.iter().map(|f| f.id)
    }

    /// Keyframes held, oldest first.
    pub fn keyframes(&self) -> impl DoubleEndedIterator<Item = FrameId> + '_ {
        self.frames.iter().filter(|f| f.keyframe).map(|f| f.id)
    }

    /// Number of frames held.
    pub fn len(&self) -> usize {
        self.frames.len()
    }

    /// Whether nothing has begun.
    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    /// The state of a frame.
    pub fn state(&self, id: FrameId) -> Option<&NavState> {
        self.frames.iter().find(|f| f.id == id).map(|f| &f.state)
    }

    /// Newest frame: its name, time and state.
    pub fn newest(&self) -> Option<(FrameId, Timestamp, &NavState)> {
        self.frames.last().map(|f| (f.id, f.time, &f.state))
    }

    /// When a frame was taken.
    pub fn time(&self, id: FrameId) -> Option<Timestamp> {
        self.frames.iter().find(|f| f.id == id).map(|f| f.time)
    }

    /// The present estimate of a landmark.
    pub fn landmark(&self, id: LandmarkId) -> Option<LandmarkEstimate> {
        let landmark = &self.landmarks[*self.slots.get(&id)?];
        Some(landmark.estimate(&self.frames, &self.calibration.body_from_camera))
    }

    /// All landmarks in the order of their storage (the same on every run).
    pub fn landmarks(&self) -> impl Iterator<Item = LandmarkEstimate> + '_ {
        let place = &self.calibration.body_from_camera;
        self.landmarks.iter().filter(|l| l.alive).map(|l| l.estimate(&self.frames, place))
    }

    /// Whether a frame sees a landmark.
    pub fn sees(&self, frame: FrameId, landmark: LandmarkId) -> bool {
        match (self.index(frame), self.slots.get(&landmark)) {
            (Ok(frame), Some(&slot)) => self.landmarks[slot].sees(frame),
            _ => false,
        }
    }

    /// Landmarks that a frame sees, hosted by it or not.
    pub fn seen_by(&self, frame: FrameId) -> impl Iterator<Item = LandmarkId> + '_ {
        let at = self.index(frame).unwrap_or(usize::MAX);
        self.landmarks.iter().filter(move |l| l.alive && l.sees(at)).map(|l| l.id)
    }

    /// The oldest keyframe that shows what the newest keyframe shows from the same place, `typical_inverse` being a typical inverse
    /// distance of the scene, 1/m. It knows no distance that the newest one does not know.
    pub fn repeated_keyframe(&self, typical_inverse: f64) -> Option<FrameId> {
        let mut keyframes = self.frames.iter().filter(|f| f.keyframe);
        let newest = keyframes.next_back()?;
        let same_view = |f: &&Frame| {
            let moved = f.state.world_from_body.inverse() * newest.state.world_from_body;
            moved.translation.norm() * typical_inverse < SAME_VIEW
                && moved.rotation.log().norm() < SAME_VIEW_RAD
        };
        keyframes.find(same_view).map(|f| f.id)
    }

    /// The camera's model.
    pub fn camera(&self) -> &CameraModel {
        &self.camera
    }

    /// Place of the camera on the body, as estimated.
    pub fn body_from_camera(&self) -> &Se3 {
        &self.calibration.body_from_camera
    }

    /// Correction of the camera's clock, as estimated: images were taken this much later than their stamps say (which
    /// hold what was known of the offset before). Its standard deviation is in [`Smoother::calibration_sigmas`].
    pub fn time_offset(&self) -> Duration {
        Duration::from_secs_f64(self.calibration.time_offset_secs)
    }

    /// What to add to the next image's stamp before its frame is added and its IMU measurements are cut: the clock offset as
    /// estimated, but never more than 2 ms away from that of the newest frame, so that time advances whatever the
    /// estimate does. Zero as long as the offset is not estimated.
    ///
    /// [`Smoother::add_frame`] takes its `time` to be stamped like that. The states held are those of the true instants
    /// of the images, as far as the offset is known.
    pub fn next_frame_offset(&self) -> Duration {
        let newest = self.frames.last().map_or(0.0, |f| f.clock_secs);
        let change = self.calibration.time_offset_secs - newest;
        Duration::from_secs_f64(newest + change.clamp(-MAX_CLOCK_STEP_SECS, MAX_CLOCK_STEP_SECS))
    }

    /// Pixel that a landmark is expected at in a frame, `None` if it does not project there.
    pub fn predict_pixel(&self, frame: FrameId, landmark: LandmarkId) -> Option<Vector2<f64>> {
        let target = &self.frames[self.index(frame).ok()?];
        let estimate = self.landmark(landmark)?;
        let host = &self.frames[self.index(estimate.host).ok()?];
        let place =
            |f: &Frame| visual::CameraPose::new(&f.state.world_from_body, &self.calibration.body_from_camera);
        let q = visual::direction(&place(host), &place(target), &estimate.bearing, estimate.inverse_distance);
        self.camera.project(&q)
    }

    /// Squared whitened residual of the IMU measurements between frames, per degree of freedom; 1 is what fits, 0 when there are
    /// none.
    pub fn inertial_chi2_per_dof(&self) -> f64 {
        let mut sum = (0.0, 0.0);
        for pair in self.frames.windows(2) {
            let Some(imu_factor) = &pair[1].imu_factor else { continue };
            let shift = linearise::shift_between(&self.calibration, &pair[0], &pair[1]);
            let [from, to] = [0, 1].map(|k| self.body_state_of(&pair[k]));
            let r = inertial::residual(&imu_factor.preintegration, &from, &to, shift);
            sum = (sum.0 + imu_factor.whitening.apply(&r).norm_squared(), sum.1 + 15.0);
        }
        if sum.1 > 0.0 { sum.0 / sum.1 } else { 0.0 }
    }

    /// Memory of IMU measurements that are not needed any more, to be filled again by [`Preintegration::restart`].
    pub fn take_spare(&mut self) -> Option<Preintegration> {
        self.spare.pop()
    }

    /// An IMU model that the window's IMU measurements carry, if any does.
    pub fn imu_model(&self) -> Option<&ImuModel> {
        self.frames.iter().rev().find_map(|f| f.imu_factor.as_ref()).map(|l| l.preintegration.model())
    }
}
