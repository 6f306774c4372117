//! Chunks aligned in every coupling: simulated worlds of which everything is known, and recordings of the official code.

#![allow(
    clippy::panic,
    clippy::print_stderr,
    clippy::unwrap_used,
    reason = "helpers of tests may stop at the first surprise, as tests may"
)]

mod aligner_bad_input;
mod aligner_regimes;
mod coupled_simulation;
mod couplings;
mod flat;
mod streaming_goldens;
