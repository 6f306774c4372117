//! Checks of loops: against points, against the pose priors, against each other.
//!
//! 1. Points of both sides agree: more than [`LoopsConfig::min_inlier_ratio`] within 5 % of depth.
//! 2. χ² of the measured transform against the pose priors, with their covariance, is at most [`LoopsConfig::max_chi2`].
//! 3. Loops agree with each other: of three or more, the largest set of pairwise consistent ones is kept (Mangelson 2018).

use super::candidate::LoopCandidate;
use super::clique;
use crate::aligner::config::LoopsConfig;
use crate::aligner::history::{History, LoopMeasurement, reject};
use crate::aligner::report::{LoopRejection, LoopReport};
use crate::covariance::transported;
use crate::overlap::OverlapFit;
use nalgebra::{Matrix6, SMatrix, SVector, Vector3};
use vidar_core::{LieGroup, Sim3};

/// Factor on the odometry's covariance: estimators are over-confident.
const ODOMETRY_WIDENING: f64 = 4.0;
/// σ of ln(scale) of a chunk whose scale is not observable.
const UNKNOWN_LOG_SCALE: f64 = 0.3;
/// Error of the step between neighbouring chunks: rotation (rad), share of the way, ln(scale).
const STEP_ROTATION: f64 = 0.009;
const STEP_SHIFT: f64 = 0.012;
const STEP_LOG_SCALE: f64 = 0.015;
/// χ² of seven degrees of freedom that one in a thousand true pairs exceeds.
const CONSISTENT_CHI2: f64 = 24.3;

type Matrix7 = SMatrix<f64, 7, 7>;

/// A measured loop with the frames that suggested it.
pub(in crate::aligner) struct CheckedLoop<'a> {
    /// Index of the later chunk.
    pub later: usize,
    /// Index of the earlier chunk.
    pub earlier: usize,
    pub candidate: &'a LoopCandidate,
    pub fit: &'a OverlapFit,
}

/// Checks 1 and 2. A χ² or an inlier ratio that is not a number rejects.
pub(in crate::aligner) fn by_evidence(config: &LoopsConfig, report: &LoopReport) -> Option<LoopRejection> {
    let has_inliers = report.inlier_ratio > config.min_inlier_ratio;
    if !has_inliers {
        return Some(LoopRejection::FewInliers);
    }
    let is_within = report.chi2.is_none_or(|chi2| chi2 <= config.max_chi2);
    (!is_within).then_some(LoopRejection::Chi2TooLarge)
}

/// Check 3: all loops, those that contradict the largest consistent set rejected.
pub(in crate::aligner) fn mutually_consistent(history: &History) -> Vec<LoopMeasurement> {
    let mut loops = history.loops.clone();
    let open: Vec<usize> = (0..loops.len()).filter(|&i| loops[i].report.rejection.is_none()).collect();
    if open.len() < 3 {
        return loops;
    }
    let agree = |i: usize, j: usize| consistent(history, &history.loops[open[i]], &history.loops[open[j]]);
    let kept = clique::largest(open.len(), agree);
    for (position, &i) in open.iter().enumerate() {
        if !kept.contains(&position) {
            reject(&mut loops[i], LoopRejection::Inconsistent);
        }
    }
    loops
}

/// χ² of a loop's camera-to-camera motion and scale against the pose priors, 7 degrees of freedom; NaN where its covariance is
/// singular. `None` where pose priors do not reach from one end to the other, or are not trusted on the way.
pub(in crate::aligner) fn chi2(history: &History, checked: &CheckedLoop<'_>) -> Option<f64> {
    let CheckedLoop { later, earlier, candidate, fit } = *checked;
    if !history.chunks[earlier..=later].iter().all(|c| c.odometry_trusted) {
        return None;
    }
    let (a, b) = (&history.chunks[later], &history.chunks[earlier]);
    let (in_a, in_b) = (a.view(candidate.later_frame)?, b.view(candidate.earlier_frame)?);
    let (predicted, mut covariance) =
        history.frames.relative(candidate.earlier_frame, candidate.later_frame, &history.config.graph)?;
    covariance *= ODOMETRY_WIDENING;
    let (scale_a, scale_b) = (a.initial?.scale, b.initial?.scale);
    let in_earlier = fit.target_from_source.transform_pose(&in_a.chunk_from_camera);
    let mut measured = in_b.chunk_from_camera.inverse() * in_earlier;
    measured.translation *= scale_b;
    let apart = (predicted.inverse() * measured).log();
    let log_scale = (fit.target_from_source.scale * scale_b / scale_a).ln();

    // The measurement's own error, carried to the camera and to metres, and the chunks' inner deformation.
    let to_camera = Sim3::from_se3(&in_a.chunk_from_camera).inverse().adjoint();
    let own = transported(&to_camera, &fit.covariance);
    let metres = SVector::<f64, 6>::from_column_slice(&[1.0, 1.0, 1.0, scale_a, scale_a, scale_a]);
    let own6: Matrix6<f64> =
        Matrix6::from_diagonal(&metres) * own.fixed_view::<6, 6>(0, 0) * Matrix6::from_diagonal(&metres);
    let weights = &history.config.graph;
    let mut deformation = Matrix6::zeros();
    for (chunk, scale) in [(a, scale_a), (b, scale_b)] {
        let n = chunk.views.len().max(1) as f64;
        let rotation = n * weights.attachment_rotation_deg.to_radians().powi(2);
        let position = n * (weights.attachment_depth_ratio * chunk.median_depth() * scale).powi(2);
        for k in 0..3 {
            deformation[(k, k)] += rotation;
            deformation[(k + 3, k + 3)] += position;
        }
    }
    let variance = |std: f64| std.min(UNKNOWN_LOG_SCALE).powi(2);
    let scale_variance = variance(a.log_scale_std) + variance(b.log_scale_std) + own[(6, 6)];
    // A wrong scale of the two chunks also stretches the way between the cameras.
    let stretch = predicted.translation.norm() * scale_variance.sqrt();
    for k in 3..6 {
        deformation[(k, k)] += stretch * stretch;
    }
    let Some(information) = (covariance + own6 + deformation).try_inverse() else { return Some(f64::NAN) };
    Some((apart.transpose() * information * apart)[0] + log_scale * log_scale / scale_variance)
}

/// Whether two loops can both be true: once around both, `b₁ ← a₁ ← a₂ ← b₂ ← b₁`, must return to its start, within the
/// covariance of the loops and of the chain between their ends.
fn consistent(history: &History, first: &LoopMeasurement, second: &LoopMeasurement) -> bool {
    let initial = |chunk: usize| history.chunks[chunk].initial;
    let (Some(a1), Some(a2)) = (initial(first.later), initial(second.later)) else { return true };
    let (Some(b1), Some(b2)) = (initial(first.earlier), initial(second.earlier)) else { return true };
    let around = first.earlier_from_later
        * (a1.inverse() * a2)
        * second.earlier_from_later.inverse()
        * (b2.inverse() * b1);
    let error = around.log();
    // Errors along the chain, at the lever of the far end.
    let mut variance = SVector::<f64, 7>::zeros();
    for (from, to, x, y) in [(first.later, second.later, &a1, &a2), (first.earlier, second.earlier, &b1, &b2)]
    {
        let steps = from.abs_diff(to) as f64;
        let way = (center(history, from, x) - center(history, to, y)).norm() / b1.scale;
        let turn = steps * STEP_ROTATION * STEP_ROTATION;
        let shift = way * way * (turn + STEP_SHIFT * STEP_SHIFT + steps * STEP_LOG_SCALE * STEP_LOG_SCALE);
        for k in 0..3 {
            variance[k] += turn;
            variance[k + 3] += shift;
        }
        variance[6] += steps * STEP_LOG_SCALE * STEP_LOG_SCALE;
    }
    let carried = |l: &LoopMeasurement, onward: &Sim3| transported(&onward.adjoint(), &l.covariance);
    // Errors sit right of each loop's transform; their adjoints carry them to b₁.
    let after_first = (a1.inverse() * a2) * second.earlier_from_later.inverse() * (b2.inverse() * b1);
    let after_second = b2.inverse() * b1;
    let covariance: Matrix7 = carried(first, &after_first.inverse())
        + carried(second, &(after_second.inverse() * second.earlier_from_later))
        + Matrix7::from_diagonal(&variance)
        + Matrix7::from_diagonal(&floor(history, first, &b1));
    covariance
        .try_inverse()
        .is_some_and(|information| (error.transpose() * information * error)[0] <= CONSISTENT_CHI2)
}

/// The deformation inside chunks, which the covariance of a loop does not contain.
fn floor(history: &History, of: &LoopMeasurement, place: &Sim3) -> SVector<f64, 7> {
    let weights = &history.config.graph;
    let chunk = &history.chunks[of.earlier];
    let n = 2.0 * chunk.views.len().max(1) as f64;
    let rotation = n * weights.attachment_rotation_deg.to_radians().powi(2);
    let depth = chunk.median_depth();
    let lever = (center(history, of.earlier, place) - place.translation).norm() / place.scale + depth;
    let position = n * (weights.attachment_depth_ratio * depth).powi(2) + rotation * lever * lever;
    SVector::from_column_slice(&[
        rotation,
        rotation,
        rotation,
        position,
        position,
        position,
        2.0 * STEP_LOG_SCALE * STEP_LOG_SCALE,
    ])
}

fn center(history: &History, chunk: usize, place: &Sim3) -> Vector3<f64> {
    let views = &history.chunks[chunk].views;
    let central = views.get(views.len() / 2).map_or_else(Vector3::zeros, |v| v.chunk_from_camera.translation);
    place.act(&central)
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::ChunkId;

    #[test]
    fn a_chi2_or_inlier_ratio_that_is_not_a_number_rejects_the_loop() {
        let config = LoopsConfig::default();
        let report = |inlier_ratio: f64, chi2: Option<f64>| LoopReport {
            later: ChunkId(5),
            earlier: ChunkId(1),
            similarity: 0.9,
            earlier_from_later: Some(Sim3::IDENTITY),
            inlier_ratio,
            chi2,
            rejection: None,
        };
        let checked = |inlier_ratio, chi2| by_evidence(&config, &report(inlier_ratio, chi2));
        assert_eq!(checked(0.9, Some(1.0)), None);
        assert_eq!(checked(0.9, None), None);
        assert_eq!(checked(0.9, Some(f64::NAN)), Some(LoopRejection::Chi2TooLarge));
        assert_eq!(checked(0.9, Some(25.0)), Some(LoopRejection::Chi2TooLarge));
        assert_eq!(checked(f64::NAN, Some(1.0)), Some(LoopRejection::FewInliers));
    }
}
