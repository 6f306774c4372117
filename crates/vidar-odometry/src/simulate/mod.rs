//! Feature-level simulation: a flight becomes IMU measurements and pixels of landmarks, without images.
//!
//! A hundred times faster than rendering, so that the back end can be tried by Monte Carlo: [`Simulation`] makes the
//! sensors' data from any [`Flight`], [`FeatureOdometry`] runs start and smoother on them as the whole odometry does on
//! images.

mod course;
mod driver;
mod handheld;
mod logged;
mod random;
mod sensors;

pub use course::{Course, CourseKind, Flight, Motion};
pub use driver::{FeatureOdometry, FeatureOdometryConfig, StepOutput};
pub use handheld::{Handheld, HandheldRecording};
pub use logged::{AdjustSettings, Logged};
pub use random::Random;
pub use sensors::{SimulatedFrame, Simulation, SimulationConfig};
