//! Settings of trajectory evaluation.

use crate::error::EvalError;
use serde::{Deserialize, Serialize};
use vidar_core::Duration;

/// Settings of trajectory evaluation. The defaults are evo's.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct TrajectoryEvalConfig {
    /// Stamps further apart than this are not paired, milliseconds, 0…10000. Raise it for slow ground truth.
    pub max_time_difference_ms: f64,
    /// Step of the relative error in frames, at least 1. 1 measures odometry from pose to pose.
    pub rpe_frames: usize,
    /// Step of the relative error along the estimated path, metres, above 0.
    pub rpe_distance_m: f64,
    /// Matched stamps further apart than this leave the time between them uncovered, milliseconds, above 0.
    pub coverage_gap_ms: f64,
    /// Below this share of the ground truth's time a warning is given, 0…1.
    pub low_coverage_ratio: f64,
}

impl Default for TrajectoryEvalConfig {
    fn default() -> Self {
        Self {
            max_time_difference_ms: 10.0,
            rpe_frames: 1,
            rpe_distance_m: 1.0,
            coverage_gap_ms: 1000.0,
            low_coverage_ratio: 0.5,
        }
    }
}

impl TrajectoryEvalConfig {
    /// Checks every value's range.
    pub fn validate(&self) -> Result<(), EvalError> {
        let check = |key, value: f64, ok: bool, expected| {
            if ok { Ok(()) } else { Err(EvalError::Config { key, found: value.to_string(), expected }) }
        };
        let t = self.max_time_difference_ms;
        check("max_time_difference_ms", t, (0.0..=10_000.0).contains(&t), "0…10000 ms")?;
        check("rpe_frames", self.rpe_frames as f64, self.rpe_frames >= 1, "at least 1")?;
        let d = self.rpe_distance_m;
        check("rpe_distance_m", d, d.is_finite() && d > 0.0, "above 0 m")?;
        let g = self.coverage_gap_ms;
        check("coverage_gap_ms", g, g.is_finite() && g > 0.0, "above 0 ms")?;
        let r = self.low_coverage_ratio;
        check("low_coverage_ratio", r, (0.0..=1.0).contains(&r), "0…1")
    }

    pub(super) fn max_time_difference(&self) -> Duration {
        Duration::from_secs_f64(self.max_time_difference_ms * 1e-3)
    }

    pub(super) fn coverage_gap(&self) -> Duration {
        Duration::from_secs_f64(self.coverage_gap_ms * 1e-3)
    }
}
