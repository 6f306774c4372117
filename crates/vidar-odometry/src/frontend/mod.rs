//! The visual front end: from images to measured pixels with covariances.
//!
//! Semi-direct, after Forster et al., "SVO: Semidirect Visual Odometry for Monocular and Multicamera Systems", T-RO 2017:
//!
//! 1. [`Pyramid`]: the image at several resolutions.
//! 2. [`ImageAligner`]: where the camera is, by sparse image alignment against the last keyframe and the last frame,
//!    starting from what the gyroscope says. It predicts; nothing of it is kept as a measurement.
//! 3. [`Warp`], [`Template`], [`align_feature`]: each landmark is measured against its **keyframe's** patch, so that errors do
//!    not add up from frame to frame, with a covariance per measurement.
//! 4. [`Detector`]: new features of a keyframe in the cells of an [`OccupancyGrid`] that no landmark holds.
//! 5. [`KltTracker`]: features of unknown depth from image to image, as the gyroscope expects them, there and back.
//! 6. [`DepthFilter`]: inverse distance of such features by search along epipolar curves.
//! 7. [`TwoViewSolver`], [`triangulate`]: motion between two views, with and without a known rotation.
//! 8. [`refine_camera`], [`refine_point`]: motion and structure one at a time, for vision alone.
//! 9. [`ImageQuality`], [`MotionMeter`]: how good an image is, and whether the camera stands still.
//!
//! Every stage is a plain function or an object that owns nothing but buffers; the map, the states and the decisions are the
//! caller's. Results do not depend on threads, and vector instructions give the bits that scalar code gives.

mod config;
mod depth_filter;
mod detect;
mod error;
mod feature;
mod feature_alignment;
mod image_alignment;
mod klt;
mod patch;
mod pyramid;
mod refine;
mod simd;
mod statistics;
mod template;
#[cfg(test)]
mod testbed;
mod two_view;

pub use config::{
    DepthFilterConfig, DetectorConfig, FrontendConfig, ImageAlignmentConfig, KltConfig, MatchingConfig,
    PyramidConfig, RefinementConfig, TwoViewConfig,
};
pub use depth_filter::{DepthFilter, Seed, SeedMeasurement, SeedOutcome};
pub use detect::{Detection, Detector, OccupancyGrid};
pub use error::FrontendError;
pub use feature::{Feature, FeatureKind, PixelMeasurement};
pub use feature_alignment::{AlignedFeature, MatchFailure, align_feature};
pub use image_alignment::{
    AlignmentPoint, AlignmentReference, ImageAligner, ImageAlignment, MAX_REFERENCES, MotionPrediction,
};
pub use klt::{KltStep, KltTracker};
pub use pyramid::{Pyramid, from_level, level_scale, to_level};
pub use refine::{
    CameraRefinement, PointObservation, PointRefinement, PointSighting, is_inlier, refine_camera,
    refine_point,
};
pub use statistics::{ImageMotion, ImageQuality, MotionMeter};
pub use template::{Template, Warp};
pub use two_view::{RayPair, Triangulated, TwoView, TwoViewFailure, TwoViewSolver, triangulate};
