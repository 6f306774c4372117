//! Alignment of predicted chunks in one metric world.
//!
//! A geometry model predicts depth and camera poses in the frame and unit of its chunk. Odometry, an external trajectory or
//! ground truth gives the same cameras in metres. [`Aligner`] takes both, chunk by chunk, and returns a [`Placement`]: one
//! similarity `world_from_chunk` per chunk and one pose per keyframe. How the two sources are combined is chosen by
//! [`CouplingMode`]: the paper's pose-free, pose-conditioned and hybrid couplings (sections III-D to III-F), and the
//! coupled graph ([`coupled`]) that is VIDAR's own.
//!
//! | Module | Content |
//! |---|---|
//! | [`aligner`] | The push machine, its configuration, observations and reports. |
//! | [`coupled`] | Factors and solver of the coupled graph. |
//! | [`overlap`] | Robust similarity between two predictions of the same frames. |
//! | [`landmark_scale`], [`depth_field`] | Scale and smooth depth correction from landmarks. |
//! | [`place_recognition`] | Image descriptors and their index. |
//! | [`keyframe_selection`], [`chunking`] | Which frames become keyframes, and which keyframes form a chunk. |
//! | [`landmark_transfer`], [`covariance`] | Odometry landmarks at the pixels of a depth image; covariances along a chain. |
//! | [`streaming`] | DA3-Streaming number for number: what the golden tests run. |

pub mod aligner;
pub mod chunking;
pub mod coupled;
pub mod covariance;
pub mod depth_field;
mod error;
pub mod keyframe_selection;
pub mod landmark_scale;
pub mod landmark_transfer;
pub mod overlap;
pub mod place_recognition;
pub mod streaming;

pub use aligner::{
    Aligner, AlignerConfig, ChunkObservation, ChunkStatus, CouplingMode, FrameObservation, Placement,
    PosePrior, color_at_size,
};
pub use error::AlignError;
