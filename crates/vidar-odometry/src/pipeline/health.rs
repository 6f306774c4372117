//! Health of the tracked state, and when it is declared lost.

use super::output::{DivergenceSign, LossReason};
use crate::config::OdometryConfig;
use crate::imu::NavState;
use crate::tracking::StepReport;
use vidar_core::{Health, Timestamp};

/// Below these numbers of inlier landmarks a frame has few features, or is blind.
const FEW_LANDMARKS: usize = 15;
const BLIND_LANDMARKS: usize = 5;

/// Share of outlier observations that makes a frame suspicious; suspicious frames in a row after which the state is
/// suspect; and after which it is declared lost.
const SUSPICIOUS_SHARE: f64 = 0.5;
const SUSPICIOUS_FRAMES: u32 = 5;
const SUSPICIOUS_LIMIT: u32 = 25;

/// Largest valid biases, rad/s and m/s².
const MAX_GYRO_BIAS: f64 = 0.5;
const MAX_ACCEL_BIAS: f64 = 1.5;

/// Standard deviation of ln(scale) below which the scale counts as settled.
pub(crate) const SETTLED_SCALE_STD: f64 = 0.02;

/// The longest stretch without IMU measurements that is bridged, s.
pub(crate) const MAX_IMU_GAP_SECS: f64 = 0.5;

/// Monitors the health of an odometry that is tracking.
#[derive(Debug, Default)]
pub(crate) struct HealthMonitor {
    blind_since: Option<Timestamp>,
    suspicious: u32,
}

/// Decision after one image.
pub(crate) enum HealthDecision {
    Continue(Health),
    Lost(LossReason),
}

impl HealthMonitor {
    /// Evaluates the state after an image at `time`. `is_metric`: an IMU observes the scale; `scale_std`: the present
    /// standard deviation of ln(scale).
    pub fn evaluate(
        &mut self,
        state: &NavState,
        step: &StepReport,
        time: Timestamp,
        is_metric: bool,
        scale_std: f64,
        config: &OdometryConfig,
    ) -> HealthDecision {
        if let Some((sign, found, limit)) = self.divergence(state, step, is_metric, config) {
            return HealthDecision::Lost(LossReason::Diverged { sign, found, limit });
        }
        // A body at rest needs no landmark: its velocity is zero.
        let blind = step.fitting < BLIND_LANDMARKS && !step.is_still && !step.just_started;
        if blind {
            let since = *self.blind_since.get_or_insert(time);
            let secs = (time - since).as_secs_f64();
            let limit = if is_metric { config.max_blind_secs } else { 0.2 * config.max_blind_secs };
            if secs > limit {
                return HealthDecision::Lost(LossReason::NoFeatures { secs });
            }
            return HealthDecision::Continue(Health::Degraded);
        }
        self.blind_since = None;
        HealthDecision::Continue(match () {
            () if self.suspicious >= SUSPICIOUS_FRAMES => Health::Suspect,
            () if !is_metric => Health::ScaleUnknown,
            () if step.fitting < FEW_LANDMARKS && !step.is_still => Health::LowFeatures,
            () if scale_std > SETTLED_SCALE_STD => Health::ScaleConverging,
            () => Health::Ok,
        })
    }

    fn divergence(
        &mut self,
        state: &NavState,
        step: &StepReport,
        is_metric: bool,
        config: &OdometryConfig,
    ) -> Option<(DivergenceSign, f64, f64)> {
        let share = step.contradicting as f64 / (step.contradicting + step.fitting).max(1) as f64;
        let enough = step.contradicting + step.fitting >= FEW_LANDMARKS;
        self.suspicious = if enough && share > SUSPICIOUS_SHARE { self.suspicious + 1 } else { 0 };
        if !state.is_finite() {
            return Some((DivergenceSign::NotFinite, f64::NAN, 0.0));
        }
        if self.suspicious >= SUSPICIOUS_LIMIT {
            return Some((DivergenceSign::RejectedShare, share, SUSPICIOUS_SHARE));
        }
        if !is_metric {
            return None;
        }
        let checks = [
            (DivergenceSign::Speed, state.velocity.norm(), config.max_speed_mps),
            (DivergenceSign::GyroBias, state.bias.gyro.norm(), MAX_GYRO_BIAS),
            (DivergenceSign::AccelBias, state.bias.accel.norm(), MAX_ACCEL_BIAS),
        ];
        checks.into_iter().find(|(_, found, limit)| found > limit)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::Duration;

    fn at(millis: i64) -> Timestamp {
        Timestamp::from_nanos(0) + Duration::from_millis(millis)
    }

    fn evaluate(
        health_monitor: &mut HealthMonitor,
        fitting: usize,
        contradicting: usize,
        millis: i64,
    ) -> HealthDecision {
        let step = StepReport { fitting, contradicting, ..StepReport::default() };
        health_monitor.evaluate(&NavState::REST, &step, at(millis), true, 0.01, &OdometryConfig::default())
    }

    #[test]
    fn blindness_degrades_at_once_and_is_lost_after_its_time() {
        let mut health_monitor = HealthMonitor::default();
        assert!(matches!(evaluate(&mut health_monitor, 50, 0, 0), HealthDecision::Continue(Health::Ok)));
        assert!(matches!(
            evaluate(&mut health_monitor, 10, 0, 50),
            HealthDecision::Continue(Health::LowFeatures)
        ));
        assert!(matches!(
            evaluate(&mut health_monitor, 2, 0, 100),
            HealthDecision::Continue(Health::Degraded)
        ));
        assert!(matches!(
            evaluate(&mut health_monitor, 2, 0, 2000),
            HealthDecision::Continue(Health::Degraded)
        ));
        let HealthDecision::Lost(LossReason::NoFeatures { secs }) = evaluate(&mut health_monitor, 2, 0, 2150)
        else {
            panic!("blind for more than two seconds")
        };
        assert!((secs - 2.05).abs() < 1e-9);
    }

    #[test]
    fn contradiction_is_suspected_and_then_given_up() {
        let mut health_monitor = HealthMonitor::default();
        let words: Vec<bool> = (0..24)
            .map(|k| {
                matches!(evaluate(&mut health_monitor, 10, 30, k), HealthDecision::Continue(Health::Suspect))
            })
            .collect();
        assert_eq!(words.iter().filter(|w| **w).count(), 20, "from the fifth frame on");
        assert!(matches!(
            evaluate(&mut health_monitor, 10, 30, 25),
            HealthDecision::Lost(LossReason::Diverged { .. })
        ));
        assert!(
            matches!(evaluate(&mut health_monitor, 50, 2, 26), HealthDecision::Continue(Health::Ok)),
            "one good frame clears it"
        );
    }

    #[test]
    fn impossible_states_are_given_up() {
        let mut fast = NavState::REST;
        fast.velocity.x = 25.0;
        let mut biased = NavState::REST;
        biased.bias.accel.y = -2.0;
        let mut broken = NavState::REST;
        broken.velocity.z = f64::NAN;
        for state in [fast, biased, broken] {
            let step = StepReport { fitting: 50, ..StepReport::default() };
            let decision = HealthMonitor::default().evaluate(
                &state,
                &step,
                at(0),
                true,
                0.01,
                &OdometryConfig::default(),
            );
            assert!(matches!(decision, HealthDecision::Lost(LossReason::Diverged { .. })));
        }
    }
}
