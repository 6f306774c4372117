//! Agreement with the tools that others use.

#![allow(
    clippy::panic,
    clippy::print_stderr,
    clippy::unwrap_used,
    reason = "helpers of tests may stop at the first surprise, as tests may"
)]

mod evo_agreement;
mod open3d_agreement;
