//! Laws of the shared types, and their answers to degenerate input.

#![allow(clippy::unwrap_used, reason = "helpers of tests may stop at the first surprise, as tests may")]

mod camera_laws;
mod lie_laws;
mod remap;
mod trajectory;
mod umeyama;
