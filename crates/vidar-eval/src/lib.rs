//! Judgement: how good are the trajectory, the depth and the surface, by the paper's protocols (section IV).
//!
//! - [`evaluate_trajectory`]: matched stamps, ATE under SE(3) and Sim(3), scale error |ln s|, RPE, coverage.
//! - [`evaluate_surface`]: precision, recall and F under the native-scale bounded placement, the *free* variant,
//!   ΔF, chamfer distances.
//! - [`evaluate_depth`], [`DepthAccumulator`]: AbsRel, δ and the like, per frame and over many.
//! - [`NearestIndex`], [`nearest_distances`]: exact nearest neighbours of millions of points.
//! - [`sample_mesh`]: a mesh as evenly spread points, so that it can be judged as a cloud.
//!
//! Reports are plain values with units in their names; they serialise to JSON with stable keys and never hold NaN:
//! what the input does not determine is `None`, with a [`Warning`](vidar_core::Warning) that says why.

mod depth;
mod error;
mod nearest;
mod sample;
mod stats;
mod surface;
mod trajectory;
mod transform;

pub use depth::{DepthAccumulator, DepthErrors, DepthReport, DepthSummary, evaluate_depth};
pub use error::EvalError;
pub use nearest::{NearestIndex, Neighbour, nearest_distances};
pub use sample::{SampleDensity, sample_mesh};
pub use stats::ErrorStats;
pub use surface::{
    Chamfer, FreePlacement, IcpConfig, OnRefusal, PlacementReport, PlacementStart, PointErrors, ScaleBounds,
    Scores, SurfaceEvalConfig, SurfaceReport, evaluate_surface, evaluate_surface_from,
};
pub use trajectory::{
    Coverage, RpeReport, RpeStep, TrajectoryEvalConfig, TrajectoryReport, associate, evaluate_trajectory,
};
pub use transform::TransformRecord;
