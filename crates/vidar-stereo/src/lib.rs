//! Multi-view stereo from known poses: a geometry model that needs no weights.
//!
//! ```text
//! views ─▶ grey, working size ─▶ probe the scene's depth ─▶ choose neighbours ─▶ plane sweep ─▶ semi-global
//!          matching ─▶ winner, sub-plane ─▶ slanted refinement ─▶ consistency checks ─▶ confidence ─▶ depth
//! ```
//!
//! - **Neighbours** (`select`): by overlap and parallax at the depth that the probe at a quarter of the size estimates;
//!   each further neighbour should have another position than those before it.
//! - **Plane sweep** (`sweep`; Collins 1996, Gallup 2007): zero-mean normalised correlation in small windows at half
//!   the working size, planes even in inverse depth, the better half of the neighbours averaged. Gain and offset of
//!   the exposure drop out.
//! - **Semi-global matching** (`sgm`; Hirschmüller 2008): eight paths in integers.
//! - **Refinement** (`refine`; after Bleyer 2011): planes in space at the working size, scored by weighted windows.
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
//! Memory for one reference of `w × h` working pixels and `d` planes is about `w/2 · h/2 · d · 5` bytes for costs and
//! sums and 24 bytes a pixel for each view's finished estimate, until the call ends.

mod chunk;
mod confidence;
mod config;
mod consistency;
mod elementary;
mod error;
mod estimate;
mod filter;
mod model;
mod ncc;
mod prepare;
mod register;
mod select;
mod sgm;
mod simd;
mod surface;
mod sweep;
mod warp;

pub use confidence::{PixelFeatures, TOLERANCE_RATIO};
pub use config::StereoConfig;
pub use error::StereoError;
pub use model::{OmittedView, StereoModel, StereoOutput, ViewFeatures};
