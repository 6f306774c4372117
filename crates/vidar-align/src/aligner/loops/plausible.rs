//! Loops against what odometry predicts, and against each other.

use super::{Aligner, LoopCandidate, MeasuredLoop};
use crate::overlap::OverlapFit;
use nalgebra::{Matrix6, SMatrix, SVector, Vector3};
use vidar_core::{FrameId, LieGroup, Se3, Sim3};

/// Covariances of odometry are taken this much wider: estimators are surer of themselves than they are right.
const ODOMETRY_WIDENING: f64 = 4.0;
/// Where nothing tells a chunk's scale, ln(scale) may be this far off.
const UNKNOWN_LOG_SCALE: f64 = 0.3;
/// Error of the step between neighbouring chunks: rotation (rad), share of the way, ln(scale).
const STEP_ROTATION: f64 = 0.009;
const STEP_SHIFT: f64 = 0.012;
const STEP_LOG_SCALE: f64 = 0.015;
/// χ² of seven degrees of freedom that one in a thousand true pairs exceeds.
const CONSISTENT_CHI2: f64 = 24.3;

type Matrix7 = SMatrix<f64, 7, 7>;

/// χ² of a loop's camera-to-camera motion and scale against the anchors, 7 degrees of freedom. `None` where anchors do not
/// reach from one end to the other, or are not believed on the way.
pub(super) fn chi2(
    machine: &Aligner,
    later: usize,
    earlier: usize,
    candidate: &LoopCandidate,
    fit: &OverlapFit,
) -> Option<f64> {
    if !machine.mode.uses_pose_priors() || !machine.chunks[earlier..=later].iter().all(|c| c.odometry_trusted)
    {
        return None;
    }
    let (a, b) = (&machine.chunks[later], &machine.chunks[earlier]);
    let (in_a, in_b) = (a.view(candidate.later_frame)?, b.view(candidate.earlier_frame)?);
    let (predicted, mut covariance) =
        machine.frames.relative(candidate.earlier_frame, candidate.later_frame, &machine.config.graph)?;
    covariance *= ODOMETRY_WIDENING;
    let (scale_a, scale_b) = (machine.scale_of(later)?, machine.scale_of(earlier)?);
    let in_earlier = fit.target_from_source.transform_pose(&in_a.chunk_from_camera);
    let mut measured = in_b.chunk_from_camera.inverse() * in_earlier;
    measured.translation *= scale_b;
    let apart = (predicted.inverse() * measured).log();
    let log_scale = (fit.target_from_source.scale * scale_b / scale_a).ln();

    // The measurement's own error, carried to the camera and to metres, and the chunks' inner deformation.
    let to_camera = Sim3::from_se3(&in_a.chunk_from_camera).inverse().adjoint();
    let own = to_camera * fit.covariance * to_camera.transpose();
    let metres = SVector::<f64, 6>::from_column_slice(&[1.0, 1.0, 1.0, scale_a, scale_a, scale_a]);
    let own6: Matrix6<f64> =
        Matrix6::from_diagonal(&metres) * own.fixed_view::<6, 6>(0, 0) * Matrix6::from_diagonal(&metres);
    let weights = &machine.config.graph;
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
    let information = (covariance + own6 + deformation).try_inverse()?;
    Some((apart.transpose() * information * apart)[0] + log_scale * log_scale / scale_variance)
}

/// Whether two loops can both be true: once around both, `b₁ ← a₁ ← a₂ ← b₂ ← b₁`, must end where it began, within the
/// covariance of the loops and of the chain between their ends.
pub(super) fn consistent(machine: &Aligner, first: &MeasuredLoop, second: &MeasuredLoop) -> bool {
    let place = |chunk: usize| machine.chunks[chunk].first_guess;
    let (Some(a1), Some(a2)) = (place(first.later), place(second.later)) else { return true };
    let (Some(b1), Some(b2)) = (place(first.earlier), place(second.earlier)) else { return true };
    let around = first.earlier_from_later
        * (a1.inverse() * a2)
        * second.earlier_from_later.inverse()
        * (b2.inverse() * b1);
    let error = around.log();
    // What happens along the chain, at the far end's lever.
    let mut variance = SVector::<f64, 7>::zeros();
    for (from, to, x, y) in [(first.later, second.later, &a1, &a2), (first.earlier, second.earlier, &b1, &b2)]
    {
        let steps = from.abs_diff(to) as f64;
        let way = (center(machine, from, x) - center(machine, to, y)).norm() / b1.scale;
        let turn = steps * STEP_ROTATION * STEP_ROTATION;
        let shift = way * way * (turn + STEP_SHIFT * STEP_SHIFT + steps * STEP_LOG_SCALE * STEP_LOG_SCALE);
        for k in 0..3 {
            variance[k] += turn;
            variance[k + 3] += shift;
        }
        variance[6] += steps * STEP_LOG_SCALE * STEP_LOG_SCALE;
    }
    let carried = |l: &MeasuredLoop, onward: &Sim3| {
        let carry = onward.adjoint();
        carry * l.covariance * carry.transpose()
    };
    // Errors sit right of each loop's transform; what follows it carries them to b₁.
    let after_first = (a1.inverse() * a2) * second.earlier_from_later.inverse() * (b2.inverse() * b1);
    let after_second = b2.inverse() * b1;
    let covariance: Matrix7 = carried(first, &after_first.inverse())
        + carried(second, &(after_second.inverse() * second.earlier_from_later))
        + Matrix7::from_diagonal(&variance)
        + Matrix7::from_diagonal(&floor(machine, first, &b1));
    covariance
        .try_inverse()
        .is_none_or(|information| (error.transpose() * information * error)[0] <= CONSISTENT_CHI2)
}

/// The chunks' inner deformation, which no covariance of a loop knows of.
fn floor(machine: &Aligner, of: &MeasuredLoop, place: &Sim3) -> SVector<f64, 7> {
    let weights = &machine.config.graph;
    let chunk = &machine.chunks[of.earlier];
    let n = 2.0 * chunk.views.len().max(1) as f64;
    let rotation = n * weights.attachment_rotation_deg.to_radians().powi(2);
    let depth = chunk.median_depth();
    let lever = (center(machine, of.earlier, place) - place.translation).norm() / place.scale + depth;
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

fn center(machine: &Aligner, chunk: usize, place: &Sim3) -> Vector3<f64> {
    let views = &machine.chunks[chunk].views;
    let middle = views.get(views.len() / 2).map_or_else(Vector3::zeros, |v| v.chunk_from_camera.translation);
    place.act(&middle)
}

impl Aligner {
    /// Metres per unit of a chunk as they are known.
    pub(in crate::aligner) fn scale_of(&self, chunk: usize) -> Option<f64> {
        self.chunks[chunk].first_guess.map(|g| g.scale)
    }
}

impl super::super::memory::Frames {
    /// `first_from_second` of two anchored frames with its covariance, right of it, summed over the steps between:
    /// `Σ Ad(T_last⁻¹ T_k) Σ_k Ad(…)ᵀ`.
    pub(in crate::aligner) fn relative(
        &self,
        first: FrameId,
        second: FrameId,
        weights: &super::super::GraphWeights,
    ) -> Option<(Se3, Matrix6<f64>)> {
        let end = self.pose_prior(second)?.world_from_camera;
        let start = self.pose_prior(first)?.world_from_camera;
        let mut covariance = Matrix6::zeros();
        for step in self.steps().filter(|s| s.from >= first && s.to <= second) {
            let carry = (end.inverse() * step.world_from_to).adjoint();
            covariance += carry * step.covariance(weights) * carry.transpose();
        }
        Some((start.inverse() * end, covariance))
    }
}
