//! Fused surfaces against shapes whose truth is known, and against bad input.

#![allow(clippy::unwrap_used, reason = "helpers of tests may stop at the first surprise, as tests may")]

mod common;
mod double_wall;
mod robustness;
mod sub_volumes;
mod surface;
mod texture;
