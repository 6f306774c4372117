//! Placement of predicted chunks in the metric world.
//!
//! A geometry model predicts in the frame and units of its chunk; the anchor (odometry, an external trajectory or
//! ground truth) knows the same cameras in metres. [`place_chunk`] finds the similarity between the two, and
//! [`aligned_views`] carries depth and poses over. This is the paper's *decoupled hybrid* for one chunk
//! (section III-D): `S_vio = Umeyama({c_i^pred}, {c_i^VIO})`, `M ← S_vio(M)`, with its guard that a rank-deficient
//! fit changes nothing (section III-F).

//!
//! [`aligner::Aligner`] does the same for a whole run, chunk by chunk, in all modes: the reference's chain, the paper's
//! couplings, and the coupled graph that is VIDAR's own.

pub mod aligner;
pub mod coupled;
pub mod depth_field;
pub mod landmark_scale;
pub mod overlap;
mod place;
pub mod place_recognition;
pub mod streaming;

pub use aligner::{
    Aligner, AlignerConfig, ChunkObservation, CouplingMode, FrameObservation, MetricAnchor, Placement,
};
pub use place::{
    AlignConfig, AlignError, Anchor, ChunkAlignment, Verdict, aligned_views, color_at_size, place_chunk,
};
