//! Multi-view stereo from known poses: a geometry model that needs no weights.
//!
//! ```text
//! views ─▶ grey, working size ─▶ probe the scene's depth ─▶ choose neighbours ─▶ plane sweep ─▶ semi-global
//!          matching ─▶ winner, sub-plane ─▶ slanted refinement ─▶ checks between views ─▶ confidence ─▶ depth
//! ```
//!
//! - **Neighbours** (`select`): by overlap and parallax at the depth that a quick look at a quarter of the size finds;
//!   each further neighbour should stand elsewhere than those before it.
//! - **Plane sweep** (`sweep`; Collins 1996, Gallup 2007): zero-mean normalised correlation in small windows at half
//!   the working size, planes even in inverse depth, the better half of the neighbours averaged. Gain and offset of
//!   the exposure drop out.
//! - **Semi-global matching** (`sgm`; Hirschmüller 2008): eight paths in integers.
//! - **Refinement** (`refine`; after Bleyer 2011): planes in space at the working size, judged by weighted windows.
//! - **Checks between views** (`consistency`; Schönberger 2016): there and back through the neighbours' own depths;
//!   agreeing views are averaged.
//! - **Confidence** (`confidence`): the probability of an error below [`TOLERANCE_RATIO`].
//!
//! - **Poses** (`register`): corrected by a small bundle adjustment within the spread that the settings grant, before
//!   anything else is matched; the prediction carries the corrected ones.
//!
//! The prediction is in the frame of the prior poses and in metres. It is a function of the call's input alone, the same
//! bits for any number of threads: a model keeps nothing between calls. Corrected poses are a chunk's own, so a view
//! seen by two chunks may stand a few millimetres apart in them.
//!
//! Memory for one reference of `w × h` working pixels and `d` planes is about `w/2 · h/2 · d · 5` bytes for costs and
//! sums and 24 bytes a pixel for each view's finished estimate, until the call ends.

mod chunk;
mod confidence;
mod config;
mod consistency;
mod error;
mod estimate;
mod filter;
mod model;
mod prepare;
mod refine;
mod register;
mod select;
mod sgm;
mod sweep;
mod warp;

pub use confidence::{Evidence, TOLERANCE_RATIO};
pub use config::StereoConfig;
pub use error::StereoError;
pub use model::{OmittedView, StereoModel, StereoOutput, ViewEvidence};
