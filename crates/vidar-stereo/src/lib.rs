//! Multi-view stereo from known poses: a geometry model that needs no weights.
//!
//! ```text
//! views ─▶ grey, working size ─▶ probe the scene's depth ─▶ choose neighbours ─▶ a quarter of the size: plane sweep,
//!          semi-global matching ─▶ half the size: edges, sweep along the surface, semi-global matching ─▶ the full size:
//!          edges, scores ─▶ consistency checks ─▶ confidence ─▶ depth
//! ```
//!
//! - **Neighbours** (`select`): by overlap and parallax at the depth that the probe at a quarter of the size estimates;
//!   each further neighbour should have another position than those before it.
//! - **Sweep** (`sweep`; Collins 1996, Gallup 2007): zero-mean normalised correlation in small windows (`ncc`), the better
//!   half of the neighbours averaged. Gain and offset of the exposure drop out. The coarse size sweeps planes even in
//!   inverse depth over the whole range, the middle one a few offsets along the surface found, continued by its slopes
//!   (`surface`).
//! - **Semi-global matching** (`sgm`; Hirschmüller 2008): eight paths in integers, over planes or over offsets.
//! - **Edges** (`edges`): pixels beside edges try the surfaces around them (the idea of Bleyer 2011), at half the size and
//!   at the full one; there a parabola through the costs gives the last fraction of a step (`fine`).
//! - **Checks between views** (`consistency`; Schönberger 2016): forward-backward reprojection through the neighbours'
//!   own depths; agreeing views are averaged.
//! - **Confidence** (`confidence`): the probability of an error below [`TOLERANCE_RATIO`].
//!
//! - **Poses** (`register`): corrected by a small bundle adjustment with the standard deviations of the settings, before the
//!   sweep; the prediction contains the corrected poses.
//!
//! The prediction is in the frame of the prior poses and in metres. It is a function of the call's input alone, the same
//! bits for any number of threads: a model keeps no state between calls. Poses are corrected per chunk, so a view in
//! two chunks may differ by a few millimetres between them.
//!
//! Kernels are compiled for several instruction sets and chosen when run (`simd`); all give the same bits.
//!
//! Memory for one reference of `w × h` working pixels and `d` planes is about `w/4 · h/4 · d · 3` bytes for costs and
//! sums, 60 bytes a pixel at the full size, and 24 bytes a pixel for each view's finished estimate, until the call ends.

mod chunk;
pub mod complete;
mod confidence;
mod config;
mod consistency;
mod edges;
mod elementary;
mod error;
mod estimate;
mod filter;
mod fine;
mod model;
mod ncc;
mod prepare;
mod register;
mod select;
mod sgm;
mod surface;
mod sweep;
mod warp;
mod window;

pub use confidence::{PixelFeatures, TOLERANCE_RATIO};
pub use config::{PoseStd, StereoConfig};
pub use error::StereoError;
pub use model::{OmittedView, StereoModel, StereoOutput, ViewFeatures};
