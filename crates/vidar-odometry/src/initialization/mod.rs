//! How the odometry gets its first metric state.
//!
//! [`initialize_static`] reads it from a body that stands still. [`InFlightInitializer`] finds it in motion, from tracks and IMU measurements of the
//! last seconds:
//! 1. gyroscope bias from epipolar planes alone ([`gyro_bias`], after Kneip & Lynen, ICCV 2013);
//! 2. velocity, gravity and accelerometer bias from one linear system over all rays with |g| known ([`linear`], after
//!    Dong-Si & Mourikis, IROS 2012);
//! 3. maximum a posteriori of the whole window with the smoother's own factors;
//! 4. acceptance only if the scale's own standard deviation, the fit, the biases and a second solution agree.
//!
//! An initialisation failure names its reason, with the measured value and the limit. The smoother that solved the window goes
//! on as the running one, so nothing is linearised at a scale that was not yet known.

mod failure;
mod gyro_bias;
mod in_flight;
mod initializer;
mod linear;
mod log;
mod monocular;
mod static_start;
mod views;

pub use failure::{InitFailure, InitFailureReason};
pub use in_flight::{InFlightInitializer, InFlightSolution, InitOutcome, MAX_LOG_SCALE_SIGMA, WINDOW_SECS};
pub(crate) use initializer::{InitialState, Initializer, STILL_SECS};
pub use log::{LoggedFrame, TrackObservation};
pub(crate) use monocular::INITIAL_INVERSE_DISTANCE;
pub(crate) use static_start::initialize_slow;
pub use static_start::{StaticInitConfig, StaticState, initialize_static};

#[cfg(test)]
mod tests;
