//! The odometry as a whole: events in, a state per image out.

mod calibration;
mod config;
mod error;
mod health;
mod keyframes;
mod mono_start;
mod odometry;
mod output;
mod rotation_check;
mod running;
mod stages;
pub(crate) mod starting;
pub(crate) mod stillness;
mod track;
mod tracker;

pub use config::{ImuUse, OdometryConfig};
pub use error::OdometryError;
pub use odometry::{InputCounts, Odometry};
pub use output::{DivergenceSign, LossReason, OdometryOutput, Status, TrackSummary, Tracking};
pub use stages::{Stage, StageTimes};
pub use track::TrackRecord;
