//! How well an estimated surface agrees with a reference cloud (the paper's section IV-B).
//!
//! With `R` the estimate after placement, `G` the reference and a threshold τ,
//! `P = |{x ∈ R : min_y |x − y| < τ}| / |R|`, `R = |{y ∈ G : min_x |x − y| < τ}| / |G|`, `F = 2PR / (P + R)`.
//!
//! **Native placement.** The estimate is laid into the reference's world by the rigid motion that fits its pose
//! source's trajectory to the truth; then one similarity refinement by ICP follows, taken only when its scale is
//! within bounds. It mends small uniform inflation of depth, and cannot borrow a scale that the method did not know.
//! **Free placement.** Any scale may be borrowed: starting from the trajectories' Sim(3) fit where there is one, the
//! refinement's scale is not bounded. The native placement is one of the free ones, so the better of them counts and
//! `ΔF = F_free − F_native` is never negative: what knowing the true scale would have bought.
//!
//! **What is judged.** The reference should hold the observed surface only: recall counts every point of it, and a
//! scan of rooms that no camera saw makes recall meaningless. Cutting the reference down to the estimate is not
//! offered, since it would reward reconstructing little. The other way, an estimate may rightly show what the scan
//! left out (through a window): `crop_margin_m` drops estimated points beyond the reference's bounding box plus a
//! margin; the default judges every point, as the formulas say. Clouds sampled unevenly (a camera that hovered)
//! weigh crowded places more: `voxel_size_m` puts one point in each voxel of both clouds before judging.

mod cloud;
mod config;
mod placement;
mod report;
#[cfg(test)]
mod tests;

pub use config::{IcpConfig, OnRefusal, ScaleBounds, SurfaceEvalConfig};
pub use report::{Chamfer, FreePlacement, PlacementReport, PointErrors, Scores, SurfaceReport};

use crate::error::EvalError;
use crate::nearest::{NearestIndex, nearest_distances};
use cloud::{finite_positions, judged_points, thinned, transformed};
use placement::{free_candidates, native_placement};
use vidar_core::{PointCloud, Se3, Sim3, Warning};

/// Where the estimate's world lies in the reference's, as far as trajectories tell.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlacementStart {
    /// SE(3) fit of the pose source to the ground truth; the identity when both share one world.
    pub truth_from_estimate: Se3,
    /// Sim(3) fit of the trajectories, from which the free placement starts too.
    pub truth_from_estimate_sim3: Option<Sim3>,
}

impl From<Se3> for PlacementStart {
    fn from(truth_from_estimate: Se3) -> Self {
        Self { truth_from_estimate, truth_from_estimate_sim3: None }
    }
}

/// Judges `estimate` against `reference`, starting from the SE(3) fit of the pose source to the ground truth.
///
/// As [`evaluate_surface_from`] without a Sim(3) fit of the trajectories.
pub fn evaluate_surface(
    estimate: &PointCloud,
    reference: &PointCloud,
    truth_from_estimate: &Se3,
    config: &SurfaceEvalConfig,
) -> Result<SurfaceReport, EvalError> {
    evaluate_surface_from(estimate, reference, &PlacementStart::from(*truth_from_estimate), config)
}

/// Judges `estimate` against `reference` under the native-scale bounded placement and under the free one.
///
/// Points with a coordinate that is not finite are dropped and counted. Fails when nothing is left of a cloud.
pub fn evaluate_surface_from(
    estimate: &PointCloud,
    reference: &PointCloud,
    start: &PlacementStart,
    config: &SurfaceEvalConfig,
) -> Result<SurfaceReport, EvalError> {
    config.validate()?;
    if !start.truth_from_estimate.is_finite()
        || start.truth_from_estimate_sim3.is_some_and(|s| !s.is_finite())
    {
        return Err(EvalError::BadPlacement);
    }
    let estimated = finite_positions(estimate, "estimated")?;
    let reference_points = finite_positions(reference, "reference")?;
    let mut warnings = dropped_warnings(estimate, reference, estimated.len(), reference_points.len());

    let truth = Truth::new(thinned(&reference_points, config.voxel_size_m)?)?;
    let native = native_placement(&estimated, &truth.index, start, config)?;
    let native_judged = judge(&estimated, &truth, &native.truth_from_estimate, config)?;
    let mut free = FreePlacement::same_as_native(&native, &native_judged.scores);
    for candidate in free_candidates(&estimated, &truth.index, start, config, &native)? {
        // A candidate that carries everything off the reference is no candidate.
        let Ok(judged) = judge(&estimated, &truth, &candidate.truth_from_estimate, config) else { continue };
        if judged.f_at(config.delta_f_threshold()) > free.f_at(config.delta_f_threshold()) {
            free = FreePlacement::new(&candidate, judged.scores);
        }
    }
    if let Some(warning) = native.refusal_warning(config) {
        warnings.push(warning);
    }
    let errors = config
        .keep_point_errors
        .then(|| point_errors(estimate, reference, &truth, &native_judged, &native.truth_from_estimate))
        .transpose()?;
    let threshold = config.delta_f_threshold();
    Ok(SurfaceReport {
        delta_f: free.f_at(threshold) - native_judged.f_at(threshold),
        delta_f_threshold_m: threshold,
        native: native_judged.scores,
        free: free.scores.clone(),
        scale_native: native.truth_from_estimate.scale,
        scale_free: free.truth_from_estimate.scale,
        chamfer: native_judged.chamfer,
        estimate_points: estimate.len(),
        reference_points: reference.len(),
        estimate_points_not_finite: estimate.len() - estimated.len(),
        reference_points_not_finite: reference.len() - reference_points.len(),
        estimate_points_cropped: native_judged.cropped,
        estimate_points_judged: native_judged.estimate_points,
        reference_points_judged: truth.points.len(),
        placement: native.report(),
        free_placement: free,
        point_errors: errors,
        warnings,
    })
}

/// The reference as it is judged, with its index.
struct Truth {
    points: Vec<[f32; 3]>,
    index: NearestIndex,
}

impl Truth {
    fn new(points: Vec<[f32; 3]>) -> Result<Self, EvalError> {
        let index = NearestIndex::build(&points)?;
        Ok(Self { points, index })
    }
}

/// What one placement is worth.
struct Judged {
    scores: Vec<Scores>,
    chamfer: Chamfer,
    estimate_points: usize,
    cropped: usize,
    index: NearestIndex,
}

impl Judged {
    fn f_at(&self, threshold_m: f64) -> f64 {
        report::f_at(&self.scores, threshold_m)
    }
}

fn judge(
    estimated: &[[f32; 3]],
    truth: &Truth,
    truth_from_estimate: &Sim3,
    config: &SurfaceEvalConfig,
) -> Result<Judged, EvalError> {
    let placed = transformed(estimated, truth_from_estimate);
    let (points, cropped) = judged_points(placed, &truth.index, config)?;
    let index = NearestIndex::build(&points)?;
    let to_reference = nearest_distances(&points, &truth.index, None);
    let to_estimate = nearest_distances(&truth.points, &index, None);
    let scores = config.thresholds_m.iter().map(|&t| Scores::new(t, &to_reference, &to_estimate)).collect();
    let chamfer = Chamfer::new(to_reference, to_estimate);
    Ok(Judged { scores, chamfer, estimate_points: points.len(), cropped, index })
}

/// Errors of all given points, in their order, for colouring.
fn point_errors(
    estimate: &PointCloud,
    reference: &PointCloud,
    truth: &Truth,
    judged: &Judged,
    truth_from_estimate: &Sim3,
) -> Result<PointErrors, EvalError> {
    let placed = transformed(&estimate.positions, truth_from_estimate);
    Ok(PointErrors {
        estimate_m: nearest_distances(&placed, &truth.index, None),
        reference_m: nearest_distances(&reference.positions, &judged.index, None),
    })
}

fn dropped_warnings(
    estimate: &PointCloud,
    reference: &PointCloud,
    estimated: usize,
    referenced: usize,
) -> Vec<Warning> {
    [("estimated", estimate.len(), estimated), ("reference", reference.len(), referenced)]
        .into_iter()
        .filter(|(_, given, kept)| given > kept)
        .map(|(which, given, kept)| {
            let message = format!("{} of {given} points of the {which} cloud are not finite", given - kept);
            Warning::new("points-not-finite", message).at(format!("{which} cloud"))
        })
        .collect()
}
