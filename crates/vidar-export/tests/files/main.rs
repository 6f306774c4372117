//! Files as they are written and read back.

#![allow(
    clippy::panic,
    clippy::print_stderr,
    clippy::unwrap_used,
    reason = "helpers of tests may stop at the first surprise, as tests may"
)]

#[path = "../common/mod.rs"]
mod common;
mod golden;
mod official;
mod round_trip;
