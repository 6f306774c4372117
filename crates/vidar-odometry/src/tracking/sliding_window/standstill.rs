//! A body that rests: its first frame and the newest one stand for a rest of any length.

use super::{SlidingWindowOdometry, StepReport};
use crate::backend::SmootherError;
use crate::tracking::standstill::tracks_in;
use vidar_core::Timestamp;

/// Standard deviations of the velocity of a body that stands still, m/s, and of its motion from image to image, m and rad.
pub(super) const ZERO_VELOCITY_SIGMA_MPS: f64 = 0.01;
pub(super) const ZERO_MOTION_SIGMA_M: f64 = 5e-4;
pub(super) const ZERO_MOTION_SIGMA_RAD: f64 = 2e-4;

/// IMU measurements of a rest are put into the prior after this long, s.
const STANDSTILL_FOLD_SECS: f64 = 1.0;

impl SlidingWindowOdometry {
    /// The body stands at the newest frame, which is a keyframe.
    pub fn stand(&mut self, time: Timestamp) {
        self.rest = Some((self.last, time));
        self.motion.stand(tracks_in(&self.tracker.tracks, self.last), time);
    }

    /// Holds a rest of any length by its first frame and the newest one.
    pub(super) fn update_standstill(
        &mut self,
        step: &StepReport,
        time: Timestamp,
    ) -> Result<(), SmootherError> {
        if !step.is_still {
            self.rest = None;
            return Ok(());
        }
        let Some((first, folded)) = self.rest else {
            self.rest = Some((self.last, time));
            return Ok(());
        };
        let (newest, between) = (self.last, self.smoother.frames().rev().nth(1));
        if let Some(between) = between.filter(|b| *b != first) {
            self.smoother.drop_frame(between, &mut self.marginalisation)?;
        }
        if (time - folded).as_secs_f64() < STANDSTILL_FOLD_SECS {
            return Ok(());
        }
        if let Some(stays) = self.smoother.fold_standstill(&mut self.marginalisation)? {
            self.last = stays;
            for track in self.tracker.tracks.iter_mut().filter(|t| t.last_frame == newest) {
                track.last_frame = stays;
                track.observations.retain(|(frame, _)| *frame != newest);
            }
        }
        self.rest = Some((first, time));
        Ok(())
    }
}
