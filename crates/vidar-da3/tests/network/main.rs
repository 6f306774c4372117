//! The network against its references, and as a user meets it.

#![allow(
    clippy::expect_used,
    clippy::print_stderr,
    clippy::unwrap_used,
    reason = "helpers of tests may stop at the first surprise, as tests may"
)]

mod chunks;
#[path = "../common/mod.rs"]
mod common;
mod inference;
mod nano_parity;
mod official_goldens;
mod official_units;
mod opening;
mod own_goldens;
