//! Rendered worlds and recordings.

#![allow(
    clippy::panic,
    clippy::unwrap_used,
    reason = "helpers of tests may stop at the first surprise, as tests may"
)]

mod predictions;
mod recording;
mod varieties;
