//! Errors of evaluation.

use thiserror::Error;
use vidar_core::{BodyFrame, Duration, Timestamp};

/// Why an evaluation failed.
#[derive(Clone, Debug, PartialEq, Error)]
#[non_exhaustive]
pub enum EvalError {
    /// A configuration value is out of range.
    #[error("{key}: {found} is not valid, expected {expected}")]
    Config {
        /// The key.
        key: &'static str,
        /// The value as found.
        found: String,
        /// What is allowed.
        expected: &'static str,
    },
    /// The two trajectories are of different bodies, so their positions differ by a lever arm.
    #[error(
        "the estimate holds poses of the {estimate}, the ground truth of the {truth}; \
         move one into the other's frame first (Trajectory::in_frame, with the rig's calibration)"
    )]
    BodyMismatch {
        /// Body of the estimate.
        estimate: BodyFrame,
        /// Body of the ground truth.
        truth: BodyFrame,
    },
    /// A trajectory has no pose.
    #[error("the {which} trajectory has no pose")]
    EmptyTrajectory {
        /// `estimated` or `ground-truth`.
        which: &'static str,
    },
    /// No pose of one trajectory matches one of the other.
    #[error(
        "no stamps of the two trajectories lie within {max_difference_ms} ms: estimate {estimate_first} … \
         {estimate_last} s, ground truth {truth_first} … {truth_last} s, nearest pair {nearest} apart; {hint}"
    )]
    NoMatches {
        /// Largest allowed difference, milliseconds.
        max_difference_ms: f64,
        /// First stamp of the estimate.
        estimate_first: Timestamp,
        /// Last stamp of the estimate.
        estimate_last: Timestamp,
        /// First stamp of the ground truth.
        truth_first: Timestamp,
        /// Last stamp of the ground truth.
        truth_last: Timestamp,
        /// Smallest difference between a stamp of one and a stamp of the other.
        nearest: Duration,
        /// The likely reason.
        hint: String,
    },
    /// A cloud has no usable point.
    #[error("the {which} cloud has no point with finite coordinates ({given} given)")]
    EmptyCloud {
        /// `estimated` or `reference`.
        which: &'static str,
        /// Points given, all of them unusable.
        given: usize,
    },
    /// Cropping to the reference removed all points.
    #[error(
        "no estimated point lies within {margin_m} m of the reference's bounding box: \
         the clouds are in different world frames, or the placement is wrong"
    )]
    NothingInBounds {
        /// Margin around the reference's bounding box, metres.
        margin_m: f64,
    },
    /// More points than an index can hold.
    #[error("{found} points are more than the {limit} that one index can hold; downsample first")]
    TooManyPoints {
        /// Points given.
        found: usize,
        /// Largest number.
        limit: usize,
    },
    /// A voxel grid of this size cannot be numbered.
    #[error("voxels of {voxel_m} m over an extent of {extent_m} m are too many; use larger voxels")]
    VoxelTooSmall {
        /// Edge of a voxel, metres.
        voxel_m: f64,
        /// Largest extent of the cloud, metres.
        extent_m: f64,
    },
    /// The points that were paired do not determine an alignment.
    #[error("no alignment: {0}")]
    Alignment(#[from] vidar_core::UmeyamaError),
    /// The initial placement is not finite.
    #[error("the placement truth_from_estimate is not finite")]
    BadPlacement,
    /// Two depth images differ in size.
    #[error("predicted depth is {width}x{height}, ground truth is {truth_width}x{truth_height}")]
    DepthSize {
        /// Columns of the prediction.
        width: usize,
        /// Rows of the prediction.
        height: usize,
        /// Columns of the ground truth.
        truth_width: usize,
        /// Rows of the ground truth.
        truth_height: usize,
    },
    /// A mesh cannot be sampled.
    #[error("mesh with {vertices} vertices and {triangles} triangles cannot be sampled: {reason}")]
    BadMesh {
        /// Its vertices.
        vertices: usize,
        /// Its triangles.
        triangles: usize,
        /// What is wrong.
        reason: &'static str,
    },
}
