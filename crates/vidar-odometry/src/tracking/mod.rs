//! Tracking: features are measured in every image against the patch of their host keyframe, and a sliding window of
//! frames is kept, with its keyframes, landmarks and seeds.
//!
//! - `Track` and [`Tracker`]: one feature, and all features of the odometry: predicted, measured, detected, dropped.
//! - [`SlidingWindowOdometry`]: one image from its prediction to the optimised state: predict, match, optimise, estimate the
//!   distances of seeds, choose keyframes, marginalise.
//! - [`ImageMotion`] and [`ImuStatistics`]: standstill detection from images and from the IMU (as for OpenVINS' zero
//!   velocity updates).

mod fixed_parts;
mod search;
mod sliding_window;
pub(crate) mod standstill;
mod track;
mod tracker;

pub(crate) use search::{CameraPoses, Prediction};
pub(crate) use sliding_window::{
    ASSUMED_LANDMARKS, ASSUMED_LOG_STD, FrameInput, SlidingWindowOdometry, StepReport,
};
pub(crate) use standstill::{ImageMotion, ImuStatistics, tracks_in};
pub use track::TrackRecord;
pub(crate) use track::{
    HostImage, ImagePool, Measurer, Track, host_covariance, noisy_covariance, parallax, rotated_pixel,
    unknown_distance,
};
pub(crate) use tracker::{MIN_CORNERS, Tracker};
