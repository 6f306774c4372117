//! The IMU measurements between two images.

use super::{Odometry, Phase};
use crate::imu::{Bias, Preintegration};
use crate::pipeline::health::MAX_IMU_GAP_SECS;
use crate::pipeline::output::LossReason;
use nalgebra::Vector3;
use vidar_core::Timestamp;

impl Odometry {
    /// A stretch without images or IMU measurements that cannot be bridged.
    pub(super) fn gap_before(&mut self, time: Timestamp) -> Option<LossReason> {
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

    pub(super) fn preintegrate_until(&mut self, time: Timestamp) -> Option<Preintegration> {
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
}
