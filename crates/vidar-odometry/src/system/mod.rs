//! The odometry as a whole: events in, a state per image out.

mod config;
mod error;
mod output;

pub use config::{ImuUse, OdometryConfig};
pub use error::OdometryError;
pub use output::{DivergenceSign, InitCondition, InitProgress, LossReason, OdometryOutput, Status, Tracking};
