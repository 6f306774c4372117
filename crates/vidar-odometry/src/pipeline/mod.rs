//! The odometry as a push machine: sensor events in, one output per image out.

mod calibration;
pub(crate) mod health;
mod keyframes;
mod odometry;
mod orientation_check;
mod output;
mod time_calibration;
mod working_size;

pub(crate) use keyframes::public_state;
pub use odometry::{InputCounts, Odometry};
pub use output::{DivergenceSign, Joined, LossReason, OdometryOutput, Status, TrackSummary, Tracking};
pub use time_calibration::CameraTiming;
