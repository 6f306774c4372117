//! The visual front end: from images to measured pixels with covariances.
//!
//! Semi-direct, after Forster et al., "SVO: Semidirect Visual Odometry for Monocular and Multicamera Systems", T-RO 2017:
//!
//! 1. [`Pyramid`]: the image at several resolutions.
//! 2. [`ImageAligner`]: sparse image alignment. The odometry uses it only where no valid IMU measurements predict the pose
//!    (no IMU, or a saturated one): the landmarks that the last image showed are aligned from that image to the current
//!    one, starting from a constant-velocity motion. It is a prediction, not a measurement.
//! 3. [`Warp`], [`Template`], [`align_feature`]: each landmark is measured against its **keyframe's** patch, so that errors do
//!    not add up from frame to frame, with a covariance per measurement.
//! 4. [`Detector`]: new features of a keyframe in the cells of an [`OccupancyGrid`] that no landmark holds.
//! 5. [`TwoViewSolver`], [`triangulate`]: motion between two views.
//!
//! Features of unknown depth are measured like landmarks, against their keyframe's patch: a frame-to-frame tracker (KLT)
//! lets errors add up, and a depth filter beside the smoother would count its measurements twice.
//!
//! Every stage is a plain function or an object that owns nothing but buffers; the map, the states and the decisions are the
//! caller's. Results do not depend on threads, and vector instructions give the bits that scalar code gives.

mod detect;
mod error;
mod feature;
mod feature_alignment;
mod image_alignment;
mod patch;
mod pyramid;
mod template;
#[cfg(test)]
pub(crate) mod testbed;
mod two_view;

pub use detect::{Detection, Detector, DetectorConfig, OccupancyGrid};
pub use error::FrontendError;
pub use feature::{Feature, FeatureKind, PixelMeasurement};
pub use feature_alignment::{AlignedFeature, MatchFailure, align_feature};
pub use image_alignment::{
    AlignmentPoint, AlignmentReference, ImageAligner, ImageAlignment, MAX_REFERENCES, MotionPrediction,
};
pub(crate) use patch::sample;
pub use pyramid::{PYRAMID_LEVELS, Pyramid, from_level, level_scale, to_level};
pub use template::{Template, Warp};
pub use two_view::{RayPair, Triangulated, TwoView, TwoViewFailure, TwoViewSolver, triangulate};
