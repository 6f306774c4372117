//! Errors of the smoother.

use vidar_core::{FrameId, LandmarkId, Timestamp};

/// Errors of the smoother.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum SmootherError {
    /// A setting is outside its range.
    #[error("{key} must be {low} to {high}, found {found}")]
    BadSetting {
        /// The key.
        key: &'static str,
        /// Least allowed.
        low: f64,
        /// Most allowed.
        high: f64,
        /// What was found.
        found: f64,
    },
    /// The window is full; a frame has to be dropped or marginalised first.
    #[error("the window holds {held} frames already (max_frames); drop or marginalise one first")]
    Full {
        /// Frames held.
        held: usize,
    },
    /// Frames must come in the order of time, each once.
    #[error("frame {id} at {time} s does not follow the newest frame at {newest} s")]
    NotNext {
        /// The frame.
        id: FrameId,
        /// Its time.
        time: Timestamp,
        /// Time of the newest frame held.
        newest: Timestamp,
    },
    /// The window has no such frame.
    #[error("frame {0} is not in the window")]
    NoSuchFrame(FrameId),
    /// There is no such landmark.
    #[error("landmark {0} is not in the map")]
    NoSuchLandmark(LandmarkId),
    /// The landmark exists already, or the frame sees it already.
    #[error("landmark {landmark} is already known to frame {frame}")]
    Twice {
        /// The landmark.
        landmark: LandmarkId,
        /// The frame.
        frame: FrameId,
    },
    /// A value is not finite, a covariance not positive definite, or a pixel has no bearing.
    #[error("{what} of landmark {landmark} in frame {frame} is of no use: {found}")]
    BadMeasurement {
        /// What is wrong.
        what: &'static str,
        /// The landmark.
        landmark: LandmarkId,
        /// The frame.
        frame: FrameId,
        /// The value.
        found: String,
    },
    /// A state that is not finite.
    #[error("the state given for frame {0} is not finite")]
    BadState(FrameId),
    /// The window holds no frame.
    #[error("the window holds no frame; it has to begin with one")]
    Empty,
}
