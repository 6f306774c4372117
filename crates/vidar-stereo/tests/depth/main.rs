//! Depth by stereo against scenes whose depth is known, and against a sensor.

#![allow(clippy::expect_used, reason = "helpers of tests may stop at the first surprise, as tests may")]

mod real_frames;
mod scene;
mod scenes;
mod stream;
