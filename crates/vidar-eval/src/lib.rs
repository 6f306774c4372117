//! Evaluation of trajectories, depth and surfaces by the paper's protocols (section IV).
//!
//! - [`evaluate_trajectory`]: matched stamps, ATE under SE(3) and Sim(3), scale error |ln s|, RPE, coverage.
//! - [`evaluate_surface`]: precision, recall and F under the native-scale bounded placement, the *free* variant,
//!   ΔF, chamfer distances.
//! - [`DepthAccumulator`]: AbsRel, δ and other depth errors, per frame and over many; [`register_depth`] reprojects a
//!   depth sensor's image into the evaluated view.
//! - [`NearestIndex`], [`nearest_distances`]: exact nearest neighbours of millions of points.
//! - [`sample_mesh`]: samples a mesh evenly, so that it can be evaluated as a cloud.
//!
//! Reports are plain values with units in their names. They serialise to JSON with stable keys and never hold NaN:
//! what the input does not determine is `None`, with a [`Warning`](vidar_core::Warning) that gives the reason.

mod depth;
mod error;
mod nearest;
mod registration;
mod sample;
mod stats;
mod surface;
mod trajectory;
mod transform;

pub use depth::{DepthAccumulator, DepthErrors, DepthReport, DepthSummary};
pub use error::EvalError;
pub use nearest::{NearestIndex, Neighbour, nearest_distances};
pub use registration::register_depth;
pub use sample::{SampleDensity, sample_mesh};
pub use stats::ErrorStats;
pub use surface::{
    Chamfer, FreePlacement, IcpConfig, OnRejection, PlacementReport, PlacementStart, PointErrors,
    ScaleBounds, Scores, SurfaceEvalConfig, SurfaceReport, evaluate_surface, evaluate_surface_from,
};
pub use trajectory::{
    Coverage, RpeReport, RpeStep, TrajectoryEvalConfig, TrajectoryReport, associate, evaluate_trajectory,
};
pub use transform::TransformRecord;
