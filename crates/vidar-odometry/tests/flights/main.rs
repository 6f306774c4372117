//! Simulated and rendered flights and recordings: accuracy, consistency, starts, robustness, calibration. The short forms are
//! part of the suite; the long ones are `cargo test --release -p vidar-odometry --test flights MODULE -- --ignored --nocapture`.

#![allow(
    clippy::panic,
    clippy::print_stderr,
    clippy::print_stdout,
    clippy::unwrap_used,
    reason = "helpers of tests may stop at the first surprise, as tests may"
)]

mod adjustment;
mod calibration;
mod ladder;
mod monte_carlo;
mod ordinary;
mod starts;
mod steady;
