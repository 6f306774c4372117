//! Videos: frames, times and telemetry, beside what FFmpeg reads.

#![allow(
    clippy::panic,
    clippy::print_stderr,
    clippy::unwrap_used,
    reason = "helpers of tests may stop at the first surprise, as tests may"
)]

mod clips;
mod ffmpeg;
mod real_clip;
