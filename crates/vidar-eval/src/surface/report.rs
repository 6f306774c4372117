//! Results of surface evaluation.

use crate::transform::TransformRecord;
use serde::{Deserialize, Serialize};
use vidar_core::{Sim3, Warning};

/// Precision, recall and F at one threshold.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Scores {
    /// The threshold τ, metres.
    pub threshold_m: f64,
    /// Share of the estimate's points nearer than τ to the reference, 0…1.
    pub precision: f64,
    /// Share of the reference's points nearer than τ to the estimate, 0…1.
    pub recall: f64,
    /// Harmonic mean of both, 0…1; 0 when both are 0.
    pub f: f64,
}

/// Distances from cloud to cloud, metres, over the evaluated points under the rigid placement.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Chamfer {
    /// Mean of `accuracy_mean_m` and `completeness_mean_m`.
    pub chamfer_m: f64,
    /// Mean distance from the estimate's points to the reference.
    pub accuracy_mean_m: f64,
    /// Median of the same.
    pub accuracy_median_m: f64,
    /// Mean distance from the reference's points to the estimate.
    pub completeness_mean_m: f64,
    /// Median of the same.
    pub completeness_median_m: f64,
}

/// How the native placement was determined.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PlacementReport {
    /// The placement under which `native` was scored.
    pub truth_from_estimate: TransformRecord,
    /// Whether the similarity refinement was accepted.
    pub accepted: bool,
    /// The reason, with numbers.
    pub reason: String,
    /// Scale at which the refinement ended, accepted or not; absent when it could not be computed.
    pub refined_scale: Option<f64>,
    /// Steps of the refinement.
    pub iterations: usize,
    /// Whether it converged before its last step.
    pub converged: bool,
    /// RMS of the trimmed pairs before it, metres.
    pub rms_before_m: Option<f64>,
    /// RMS of the trimmed pairs after it, metres.
    pub rms_after_m: Option<f64>,
}

/// The free placement with the highest F.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FreePlacement {
    /// Its origin: `rigid`; `native`; `rigid-start`, the rejected refinement; `similarity-start`, the Sim(3) fit
    /// of the trajectories; `similarity-start-refined`, an ICP from there.
    pub start: String,
    /// The placement.
    #[serde(with = "as_record")]
    pub truth_from_estimate: Sim3,
    #[serde(skip)]
    pub(super) scores: Vec<Scores>,
}

/// Distance of every given point to the other cloud under the rigid placement, metres, in the given order; NaN for
/// points that are not finite. With voxels, the other cloud is the thinned one.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PointErrors {
    /// For each point of the estimate.
    pub estimate_m: Vec<f32>,
    /// For each point of the reference.
    pub reference_m: Vec<f32>,
}

/// Agreement of a surface with its reference, and the basis of the comparison.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SurfaceReport {
    /// Scores under the rigid placement, one per threshold: the scale is the estimate's own.
    pub rigid: Vec<Scores>,
    /// Scores under the paper's native-scale bounded placement, which may change the scale within bounds.
    pub native: Vec<Scores>,
    /// Scores under the free placement.
    pub free: Vec<Scores>,
    /// F_free − F_rigid at `delta_f_threshold_m`: what the true scale would gain.
    pub delta_f_rigid: f64,
    /// F_free − F_native at `delta_f_threshold_m`, the paper's ΔF.
    pub delta_f: f64,
    /// The largest threshold, metres.
    pub delta_f_threshold_m: f64,
    /// Scale of the native placement: 1 when no refinement was accepted.
    pub scale_native: f64,
    /// Scale of the free placement.
    pub scale_free: f64,
    /// Mean distances under the rigid placement.
    pub chamfer: Chamfer,
    /// The rigid placement; its scale is 1.
    pub rigid_placement: TransformRecord,
    /// Points given.
    pub estimate_points: usize,
    /// Points given.
    pub reference_points: usize,
    /// Points dropped because a coordinate was not finite.
    pub estimate_points_not_finite: usize,
    /// Points dropped because a coordinate was not finite.
    pub reference_points_not_finite: usize,
    /// Points dropped because they lie outside the reference's box and margin.
    pub estimate_points_cropped: usize,
    /// Points that were evaluated, after cropping and voxels.
    pub estimate_points_evaluated: usize,
    /// Points that were evaluated, after voxels.
    pub reference_points_evaluated: usize,
    /// How the native placement was determined.
    pub placement: PlacementReport,
    /// The free placement.
    pub free_placement: FreePlacement,
    /// Errors per point, when asked for; not part of the JSON.
    #[serde(skip)]
    pub point_errors: Option<PointErrors>,
    /// Warnings about the input and the placement.
    pub warnings: Vec<Warning>,
}

impl Scores {
    /// Scores from the distances of the estimate's points and of the reference's, metres.
    pub(super) fn new(threshold_m: f64, to_reference: &[f32], to_estimate: &[f32]) -> Self {
        let share = |distances: &[f32]| {
            let near = distances.iter().filter(|&&d| f64::from(d) < threshold_m).count();
            near as f64 / distances.len().max(1) as f64
        };
        let (precision, recall) = (share(to_reference), share(to_estimate));
        let sum = precision + recall;
        let f = if sum > 0.0 { 2.0 * precision * recall / sum } else { 0.0 };
        Self { threshold_m, precision, recall, f }
    }
}

impl Chamfer {
    pub(super) fn new(to_reference: Vec<f32>, to_estimate: Vec<f32>) -> Self {
        let (accuracy_mean_m, accuracy_median_m) = mean_and_median(to_reference);
        let (completeness_mean_m, completeness_median_m) = mean_and_median(to_estimate);
        Self {
            chamfer_m: 0.5 * (accuracy_mean_m + completeness_mean_m),
            accuracy_mean_m,
            accuracy_median_m,
            completeness_mean_m,
            completeness_median_m,
        }
    }
}

/// Mean and median of a non-empty list.
fn mean_and_median(mut distances: Vec<f32>) -> (f64, f64) {
    let n = distances.len().max(1);
    let mean = distances.iter().map(|&d| f64::from(d)).sum::<f64>() / n as f64;
    if distances.is_empty() {
        return (0.0, 0.0);
    }
    let odd = distances.len() % 2 == 1;
    let (below, upper, _) = distances.select_nth_unstable_by(n / 2, f32::total_cmp);
    let upper = f64::from(*upper);
    let lower =
        if odd { upper } else { below.iter().copied().max_by(f32::total_cmp).map_or(upper, f64::from) };
    (mean, 0.5 * (lower + upper))
}

/// F at `threshold_m`; 0 when there is none.
pub(super) fn f_at(scores: &[Scores], threshold_m: f64) -> f64 {
    scores.iter().find(|s| s.threshold_m == threshold_m).map_or(0.0, |s| s.f)
}

impl FreePlacement {
    /// With the scores of a placement that was found from `start`.
    pub(super) fn new(start: &str, truth_from_estimate: Sim3, scores: Vec<Scores>) -> Self {
        Self { start: start.to_owned(), truth_from_estimate, scores }
    }

    pub(super) fn f_at(&self, threshold_m: f64) -> f64 {
        f_at(&self.scores, threshold_m)
    }
}

/// Serialises a similarity as a [`TransformRecord`].
mod as_record {
    use super::{Sim3, TransformRecord};
    use serde::{Deserialize, Deserializer, Serialize, Serializer, de::Error};

    pub(super) fn serialize<S: Serializer>(t: &Sim3, serializer: S) -> Result<S::Ok, S::Error> {
        TransformRecord::from(*t).serialize(serializer)
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Sim3, D::Error> {
        let record = TransformRecord::deserialize(deserializer)?;
        record.to_sim3().ok_or_else(|| D::Error::custom("not a similarity"))
    }
}
