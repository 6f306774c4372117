//! The coupled graph: metric keyframe poses and the gauges of the chunks, estimated together.
//!
//! Pose-conditioned depth trusts the odometry's drift, the decoupled hybrid trusts the model's; each fails where the other
//! holds. Here both are measurements of one state:
//!
//! - Tᵢ ∈ SE(3), `world_from_camera` of keyframe i, metric, gravity-aligned;
//! - Xₖ ∈ Sim(3), `world_from_chunk` of chunk k.
//!
//! Residuals (whitened; robust where a model or a matcher may be grossly wrong) are in [`Factor`]. A model's poses within
//! a chunk share their deformation, so [`inflation`] keeps n of them from counting as n independent ones: treating
//! them as independent damages a good odometry. Perturbations are on the right, tangents `[rotation, translation,
//! log-scale]`.
//!
//! The solver checks itself: when the odometry's own residuals grow beyond what its covariance allows
//! ([`Solution::odometry_chi2`]), [`solve`] falls back to one way, poses from odometry and loops, chunks fitted to them.

mod factor;
mod graph;

pub use factor::{Attachment, Factor, RelativeChunk};
pub use graph::{CoupledConfig, CoupledState, GraphError, InformationFlow, Solution, solve};
pub use vidar_solve::Kernel;

/// By how much the standard deviations of n measurements that share one error are widened so that they count as one:
/// √n.
pub fn inflation(sharing: usize) -> f64 {
    (sharing.max(1) as f64).sqrt()
}
