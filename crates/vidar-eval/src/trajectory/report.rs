//! Results of trajectory evaluation.

use super::Matched;
use crate::stats::ErrorStats;
use crate::transform::TransformRecord;
use serde::{Deserialize, Serialize};
use vidar_core::{Duration, Trajectory, Warning};

/// Errors of a trajectory, and the basis of the comparison.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TrajectoryReport {
    /// The frame of the rig whose poses were compared.
    pub body: String,
    /// Number of pairs.
    pub matched: usize,
    /// Poses of the estimate.
    pub estimate_poses: usize,
    /// Poses of the ground truth.
    pub truth_poses: usize,
    /// How much of both was compared.
    pub coverage: Coverage,
    /// Absolute error after the best rigid motion, metres: the ATE of a metric method.
    pub ate_se3_m: Option<ErrorStats>,
    /// Absolute error after the best similarity, metres: the ATE regardless of scale.
    pub ate_sim3_m: Option<ErrorStats>,
    /// Absolute error without alignment, metres: meaningful only when both share one world frame.
    pub ate_unaligned_m: Option<ErrorStats>,
    /// Angle between orientations after the rigid motion that fits the positions, degrees.
    pub orientation_se3_deg: Option<ErrorStats>,
    /// Scale of the similarity fit: metres of truth per unit of the estimate.
    pub scale: Option<f64>,
    /// |ln scale|: 0 for a metric estimate, 0.01 for one percent off, either way.
    pub scale_error: Option<f64>,
    /// Relative error from frame to frame.
    pub rpe_frames: Option<RpeReport>,
    /// Relative error per distance travelled.
    pub rpe_metres: Option<RpeReport>,
    /// Length of the whole estimated path, metres.
    pub estimate_path_m: f64,
    /// Length of the whole true path, metres.
    pub truth_path_m: f64,
    /// Length of the estimated path through the matched poses, metres.
    pub matched_estimate_path_m: f64,
    /// Length of the true path through the matched poses, metres.
    pub matched_truth_path_m: f64,
    /// The rigid alignment that was used.
    pub truth_from_estimate_se3: Option<TransformRecord>,
    /// The similarity alignment that was used.
    pub truth_from_estimate_sim3: Option<TransformRecord>,
    /// Quantities that could not be determined, and why.
    pub warnings: Vec<Warning>,
}

/// How much of the two trajectories was compared.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Coverage {
    /// Share of the estimate's poses that are matched, 0…1.
    pub estimate_ratio: f64,
    /// Share of the ground truth's time between matched poses that are not further apart than the gap, 0…1.
    pub truth_time_ratio: f64,
    /// Time of the ground truth, seconds.
    pub truth_secs: f64,
    /// Longest time of the ground truth without a match, seconds, before the first and after the last included.
    pub longest_gap_secs: f64,
}

/// The step over which motion is compared.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "unit", rename_all = "snake_case")]
pub enum RpeStep {
    /// A number of matched poses.
    Frames {
        /// How many.
        count: usize,
    },
    /// A distance along the estimated path.
    Metres {
        /// How far, metres.
        length: f64,
    },
}

/// Relative errors over consecutive steps of one kind.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct RpeReport {
    /// The step.
    pub step: RpeStep,
    /// Number of steps.
    pub pairs: usize,
    /// Length of the error's translation, metres.
    pub translation_m: ErrorStats,
    /// Angle of the error's rotation, degrees.
    pub rotation_deg: ErrorStats,
}

/// How much of both trajectories the matched poses cover.
pub(super) fn coverage(
    matched: &[Matched<'_>],
    estimate: &Trajectory,
    truth: &Trajectory,
    gap: Duration,
) -> Coverage {
    let mut used: Vec<_> = matched.iter().map(|m| m.estimate.time).collect();
    used.dedup();
    let times: Vec<_> = matched.iter().map(|m| m.truth.time).collect();
    let steps = || times.windows(2).map(|w| w[1] - w[0]);
    // The sum of nothing is -0.0, which would be shown.
    let covered = steps().filter(|&s| s <= gap).map(Duration::as_secs_f64).fold(0.0, |a, b| a + b);
    let (mut total, mut longest) = (Duration::ZERO, steps().max().unwrap_or(Duration::ZERO));
    if let (Some((start, end)), Some(&first), Some(&last)) = (truth.time_range(), times.first(), times.last())
    {
        total = end - start;
        longest = longest.max(first - start).max(end - last);
    }
    let total = total.as_secs_f64();
    Coverage {
        estimate_ratio: used.len() as f64 / estimate.len().max(1) as f64,
        // A truth of a single pose has no time to cover: matched is covered.
        truth_time_ratio: if total > 0.0 { (covered / total).min(1.0) } else { 1.0 },
        truth_secs: total,
        longest_gap_secs: longest.as_secs_f64(),
    }
}
