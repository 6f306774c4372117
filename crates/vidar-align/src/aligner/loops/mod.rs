//! Loops: found by descriptors, measured by geometry, accepted only when three independent checks pass ([`checks`]).
//!
//! In the graph each accepted loop still has a bounded kernel.

pub(super) mod candidate;
pub(super) mod checks;
mod clique;
mod direct;
mod search;

pub(super) use search::LoopSearch;

use super::chunk::sparse_samples;
use super::history::History;
use super::overlaps::fit_robust;
use super::report::LoopRejection;
use crate::overlap::{OverlapFit, SampledView, shared_views};
use crate::streaming::StreamingError;
use candidate::LoopCandidate;
use vidar_core::{GeometryPrediction, LieGroup};

/// Measures `earlier_from_later` of two chunks (by index): by a prediction of the frames of both, or without one by the stored
/// samples of the two chunks.
///
/// # Errors
/// Why there is no measurement.
pub(super) fn measure(
    history: &History,
    (later, earlier): (usize, usize),
    candidate: &LoopCandidate,
    prediction: Option<&GeometryPrediction>,
) -> Result<OverlapFit, LoopRejection> {
    match prediction {
        Some(prediction) => by_loop_chunk(history, later, earlier, prediction).map_err(|error| match error {
            StreamingError::Degenerate { .. } => LoopRejection::Degenerate,
            _ => LoopRejection::NoGeometry,
        }),
        None => direct::measure(history, later, earlier, candidate).ok_or(LoopRejection::NoGeometry),
    }
}

/// `b_from_a = b_from_loop ∘ a_from_loop⁻¹`, each from the frames that the loop chunk shares with that side.
fn by_loop_chunk(
    history: &History,
    later: usize,
    earlier: usize,
    prediction: &GeometryPrediction,
) -> Result<OverlapFit, StreamingError> {
    let loop_views: Vec<SampledView> = prediction.views.iter().map(sparse_samples).collect();
    let side = |chunk: usize| {
        let views = shared_views(history.chunks[chunk].views.iter().map(|v| &v.samples), loop_views.iter());
        fit_robust(&views, &history.config)
    };
    let (a, b) = (side(later)?, side(earlier)?);
    let a_from_loop = a.target_from_source;
    // b_L e^{δ_b} (a_L e^{δ_a})⁻¹ = b_L a_L⁻¹ e^{Ad(a_L)(δ_b − δ_a)} to first order.
    let adjoint = a_from_loop.adjoint();
    Ok(OverlapFit {
        target_from_source: b.target_from_source * a_from_loop.inverse(),
        covariance: adjoint * (a.covariance + b.covariance) * adjoint.transpose(),
        pairs: a.pairs + b.pairs,
        inlier_ratio: a.inlier_ratio.min(b.inlier_ratio),
        median_residual: a.median_residual.max(b.median_residual),
        iterations: a.iterations + b.iterations,
    })
}
