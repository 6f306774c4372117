//! Recordings of every layout and source: what is read, in which frame and unit, and what is said of faults.

#![allow(
    clippy::panic,
    clippy::print_stderr,
    clippy::unwrap_used,
    reason = "helpers of tests may stop at the first surprise, as tests may"
)]

mod ahead;
mod arriving;
mod bags;
mod calibrations;
mod common;
mod convert;
mod datasets;
mod faults;
mod layouts;
mod never_panics;
mod phones;
mod photos;
mod real_sets;
