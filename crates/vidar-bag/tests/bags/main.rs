//! Containers of messages, whole, in pieces and broken.

#![allow(
    clippy::panic,
    clippy::unwrap_used,
    reason = "helpers of tests may stop at the first surprise, as tests may"
)]

mod containers;
mod never_panics;
mod stream;
