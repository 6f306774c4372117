//! Agreement of an estimated surface with a reference cloud (the paper's section IV-B).
//!
//! With `R` the estimate after placement, `G` the reference and a threshold τ,
//! `P = |{x ∈ R : min_y |x − y| < τ}| / |R|`, `R = |{y ∈ G : min_x |x − y| < τ}| / |G|`, `F = 2PR / (P + R)`.
//!
//! **Rigid placement.** The estimate is moved into the reference's world frame by the SE(3) fit of its trajectory to
//! ground truth, refined by an ICP without scale. The scale is the estimate's own: a map that claims to be metric is judged
//! by this one, and so are the mean distances and the errors of points.
//! **Native placement**, the paper's. From the same SE(3) fit one similarity refinement by ICP follows; it is accepted only
//! when its scale is within bounds. It forgives an error of scale within those bounds; above 2 % that is a warning.
//! **Free placement.** The refinement's scale is not bounded; it also starts from the trajectories' Sim(3) fit where
//! there is one. The rigid and the native placement are among the free ones and the one with the highest F counts, so
//! `ΔF = F_free − F_native` and `F_free − F_rigid` are never negative: the gain in F if the true scale were known.
//!
//! **Evaluated points.** The reference should contain the observed surface only: recall counts every point of it, and
//! a scan of rooms that no camera observed makes recall meaningless. Cropping the reference to the estimate is not
//! offered, since it would reward reconstructing little. An estimate may contain surface that the scan omits (through a
//! window): `crop_margin_m` drops estimated points beyond the reference's bounding box plus a margin; by default every
//! point is evaluated. In clouds of uneven density, dense parts weigh more: `voxel_size_m` puts one point in each voxel
//! of both clouds before evaluation.

mod cloud;
mod config;
mod pairs;
mod placement;
mod report;
#[cfg(test)]
mod tests;

pub use config::{IcpConfig, OnRejection, ScaleBounds, SurfaceEvalConfig};
pub use report::{Chamfer, FreePlacement, PlacementReport, PointErrors, Scores, SurfaceReport};

use crate::error::EvalError;
use crate::nearest::{NearestIndex, nearest_distances};
use cloud::{evaluated_points, finite_positions, thinned, transformed};
use pairs::Matching;
use placement::{Placement, free_candidates, native_placement, rigid_placement};
use vidar_core::{PointCloud, Se3, Sim3, Warning};

/// Initial placement of the estimate in the reference's world frame, from the trajectories.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlacementStart {
    /// SE(3) fit of the pose source to the ground truth; the identity when both share one world frame.
    pub truth_from_estimate: Se3,
    /// Sim(3) fit of the trajectories, from which the free placement starts too.
    pub truth_from_estimate_sim3: Option<Sim3>,
}

impl From<Se3> for PlacementStart {
    fn from(truth_from_estimate: Se3) -> Self {
        Self { truth_from_estimate, truth_from_estimate_sim3: None }
    }
}

/// Evaluates `estimate` against `reference`, starting from the SE(3) fit of the pose source to the ground truth.
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

/// Evaluates `estimate` against `reference` under the rigid, the native-scale bounded and the free placement.
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

    let truth = Reference::new(thinned(&reference_points, config.voxel_size_m)?)?;
    let threshold = config.delta_f_threshold();
    let matching = Matching::new(&estimated, &truth.index, config.icp.max_points);
    let rigid = rigid_placement(&matching, start, config);
    let rigid_score = score(&estimated, &truth, &rigid.truth_from_estimate, config)?;
    let native = native_placement(&matching, start, config)?;
    let native_scores = candidate_scores(&estimated, &truth, &native.truth_from_estimate, config)?;
    let mut free = FreePlacement::new(rigid.start, rigid.truth_from_estimate, rigid_score.scores.clone());
    let bounded = Placement { start: "native", truth_from_estimate: native.truth_from_estimate };
    for candidate in std::iter::once(bounded).chain(free_candidates(&matching, start, config, &native)?) {
        // A candidate that moves all points outside the crop is skipped.
        let scores = candidate_scores(&estimated, &truth, &candidate.truth_from_estimate, config);
        let Ok(scores) = scores else { continue };
        if report::f_at(&scores, threshold) > free.f_at(threshold) {
            free = FreePlacement::new(candidate.start, candidate.truth_from_estimate, scores);
        }
    }
    warnings.extend(native.rejection_warning(config));
    warnings.extend(native.scale_warning());
    Ok(SurfaceReport {
        delta_f_rigid: free.f_at(threshold) - report::f_at(&rigid_score.scores, threshold),
        delta_f: free.f_at(threshold) - report::f_at(&native_scores, threshold),
        delta_f_threshold_m: threshold,
        rigid: rigid_score.scores,
        native: native_scores,
        free: free.scores.clone(),
        scale_native: native.truth_from_estimate.scale,
        scale_free: free.truth_from_estimate.scale,
        chamfer: rigid_score.chamfer,
        rigid_placement: rigid.truth_from_estimate.into(),
        estimate_points: estimate.len(),
        reference_points: reference.len(),
        estimate_points_not_finite: estimate.len() - estimated.len(),
        reference_points_not_finite: reference.len() - reference_points.len(),
        estimate_points_cropped: rigid_score.cropped,
        estimate_points_evaluated: rigid_score.estimate_points,
        reference_points_evaluated: truth.points.len(),
        placement: native.report(),
        free_placement: free,
        point_errors: point_errors(
            (estimate, reference),
            &truth,
            (rigid_score.distances, &rigid_score.index),
            (&rigid.truth_from_estimate, config.voxel_size_m.is_some()),
        ),
        warnings,
    })
}

/// The evaluated points of the reference with their search index.
struct Reference {
    points: Vec<[f32; 3]>,
    index: NearestIndex,
}

impl Reference {
    fn new(points: Vec<[f32; 3]>) -> Result<Self, EvalError> {
        let index = NearestIndex::build(&points)?;
        Ok(Self { points, index })
    }
}

/// Scores of one placement.
struct PlacementScore {
    scores: Vec<Scores>,
    chamfer: Chamfer,
    estimate_points: usize,
    cropped: usize,
    index: NearestIndex,
    /// Distances of the evaluated points, when errors per point are requested.
    distances: Option<PointErrors>,
}

fn score(
    estimated: &[[f32; 3]],
    truth: &Reference,
    truth_from_estimate: &Sim3,
    config: &SurfaceEvalConfig,
) -> Result<PlacementScore, EvalError> {
    let placed = transformed(estimated, truth_from_estimate);
    let (points, cropped) = evaluated_points(placed, &truth.index, config)?;
    let index = NearestIndex::build(&points)?;
    let to_reference = nearest_distances(&points, &truth.index, None);
    let to_estimate = nearest_distances(&truth.points, &index, None);
    let scores = config.thresholds_m.iter().map(|&t| Scores::new(t, &to_reference, &to_estimate)).collect();
    let distances = config
        .keep_point_errors
        .then(|| PointErrors { estimate_m: to_reference.clone(), reference_m: to_estimate.clone() });
    let chamfer = Chamfer::new(to_reference, to_estimate);
    Ok(PlacementScore { scores, chamfer, estimate_points: points.len(), cropped, index, distances })
}

/// The scores of a placement without its distances: only those below the largest threshold are searched for.
fn candidate_scores(
    estimated: &[[f32; 3]],
    truth: &Reference,
    truth_from_estimate: &Sim3,
    config: &SurfaceEvalConfig,
) -> Result<Vec<Scores>, EvalError> {
    let placed = transformed(estimated, truth_from_estimate);
    let (points, _) = evaluated_points(placed, &truth.index, config)?;
    let index = NearestIndex::build(&points)?;
    // The margin covers the rounding of squared distances in f32.
    let limit = Some((config.delta_f_threshold() * 1.001) as f32);
    let to_reference = nearest_distances(&points, &truth.index, limit);
    let to_estimate = nearest_distances(&truth.points, &index, limit);
    Ok(config.thresholds_m.iter().map(|&t| Scores::new(t, &to_reference, &to_estimate)).collect())
}

/// Errors of all given points, in their order, for colouring.
fn point_errors(
    (estimate, reference): (&PointCloud, &PointCloud),
    truth: &Reference,
    (evaluated, index): (Option<PointErrors>, &NearestIndex),
    (truth_from_estimate, thinned): (&Sim3, bool),
) -> Option<PointErrors> {
    let PointErrors { estimate_m, reference_m } = evaluated?;
    // With voxels the evaluated points are means; as many as given are the given ones.
    let same_estimate = !thinned && estimate_m.len() == estimate.len();
    let same_reference = !thinned && reference_m.len() == reference.len();
    let of_estimate = || {
        let placed = transformed(&estimate.positions, truth_from_estimate);
        nearest_distances(&placed, &truth.index, None)
    };
    let of_reference = || nearest_distances(&reference.positions, index, None);
    Some(PointErrors {
        estimate_m: if same_estimate { estimate_m } else { of_estimate() },
        reference_m: if same_reference { reference_m } else { of_reference() },
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
