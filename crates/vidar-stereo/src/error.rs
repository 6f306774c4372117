//! Errors of stereo, each with what was found and what is expected.

use thiserror::Error;
use vidar_core::{ChunkId, FrameId, ModelError};

/// Why stereo failed.
#[derive(Clone, Debug, PartialEq, Error)]
#[non_exhaustive]
pub enum StereoError {
    /// A setting is out of its range.
    #[error("stereo setting {key}: expected {low} to {high}, found {found}")]
    BadConfig {
        /// The field of `StereoConfig`.
        key: &'static str,
        /// Its value.
        found: f64,
        /// Smallest value allowed.
        low: f64,
        /// Largest value allowed.
        high: f64,
    },
    /// Fewer views than matching needs.
    #[error("chunk {chunk}: {found} views, stereo needs at least {needed}")]
    TooFewViews {
        /// Which chunk.
        chunk: ChunkId,
        /// Views given.
        found: usize,
        /// Views needed.
        needed: usize,
    },
    /// A requested reference is not among the views.
    #[error("reference {index} is not one of the {views} views")]
    NoSuchReference {
        /// The requested index.
        index: usize,
        /// Number of views.
        views: usize,
    },
    /// A view has no pose.
    #[error("frame {frame} has no prior pose, and stereo needs one")]
    MissingPose {
        /// Which frame.
        frame: FrameId,
    },
    /// A pose holds a value that is not finite.
    #[error("frame {frame}: its prior pose is not finite")]
    BadPose {
        /// Which frame.
        frame: FrameId,
    },
    /// The intrinsics are singular or not finite.
    #[error("frame {frame}: intrinsics fx {fx}, fy {fy}, cx {cx}, cy {cy} are not valid")]
    BadIntrinsics {
        /// Which frame.
        frame: FrameId,
        /// Focal length, x, pixels.
        fx: f64,
        /// Focal length, y, pixels.
        fy: f64,
        /// Principal point, x, pixels.
        cx: f64,
        /// Principal point, y, pixels.
        cy: f64,
    },
    /// A mask and its image differ in size.
    #[error("frame {frame}: its mask is {width}x{height}, its image is {expected_width}x{expected_height}")]
    MaskSize {
        /// Which frame.
        frame: FrameId,
        /// Columns of the mask.
        width: usize,
        /// Rows of the mask.
        height: usize,
        /// Columns of the image.
        expected_width: usize,
        /// Rows of the image.
        expected_height: usize,
    },
    /// The image does not have the size of its intrinsics.
    #[error("frame {frame}: image of {width}x{height}, but intrinsics of {expected_width}x{expected_height}")]
    SizeMismatch {
        /// Which frame.
        frame: FrameId,
        /// Columns of the image.
        width: usize,
        /// Rows of the image.
        height: usize,
        /// Columns of the intrinsics.
        expected_width: usize,
        /// Rows of the intrinsics.
        expected_height: usize,
    },
    /// The image is too small to match anything in.
    #[error(
        "frame {frame}: image of {width}x{height} at the working size, at least {needed}x{needed} is needed"
    )]
    TooSmall {
        /// Which frame.
        frame: FrameId,
        /// Columns at the working size.
        width: usize,
        /// Rows at the working size.
        height: usize,
        /// Fewest rows and columns.
        needed: usize,
    },
    /// No reference has a neighbour with overlap and a baseline (the camera only rotated, or did not move).
    #[error(
        "chunk {chunk}: no view has parallax: at most {found_deg:.3} deg was found, {needed_deg:.3} deg is needed"
    )]
    NoParallax {
        /// Which chunk.
        chunk: ChunkId,
        /// Largest parallax found, degrees.
        found_deg: f64,
        /// Parallax needed, degrees.
        needed_deg: f64,
    },
    /// The caller cancelled.
    #[error("cancelled")]
    Cancelled,
    /// A result could not be assembled: a defect of this crate, not of the input.
    #[error("internal: {what}")]
    Internal {
        /// What failed.
        what: String,
    },
}

impl From<StereoError> for ModelError {
    fn from(error: StereoError) -> Self {
        match error {
            StereoError::TooFewViews { chunk, found, needed } => Self::TooFewViews { chunk, found, needed },
            StereoError::MissingPose { frame } => Self::MissingPose { frame },
            StereoError::Cancelled => Self::Cancelled,
            StereoError::BadPose { frame }
            | StereoError::BadIntrinsics { frame, .. }
            | StereoError::SizeMismatch { frame, .. }
            | StereoError::MaskSize { frame, .. }
            | StereoError::TooSmall { frame, .. } => Self::BadView { frame, reason: error.to_string() },
            other => Self::Other(other.to_string()),
        }
    }
}
