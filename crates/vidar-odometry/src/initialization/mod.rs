//! How the odometry gets its first metric state.
//!
//! [`rest`] reads it from a body that stands still. [`InFlightStart`] finds it in motion, from tracks and readings of the
//! last seconds:
//! 1. gyroscope bias from epipolar planes alone ([`gyro_bias`], after Kneip & Lynen, ICCV 2013);
//! 2. velocity, gravity and accelerometer bias from one linear system over all rays with |g| known ([`linear`], after
//!    Dong-Si & Mourikis, IROS 2012);
//! 3. maximum a posteriori of the whole window with the smoother's own factors;
//! 4. acceptance only if the scale's own standard deviation, the fit, the biases and a second solution agree.
//!
//! What stands in the way is told as a named condition with its measured value. The smoother that solved the window goes
//! on as the running one, so nothing is linearised at a scale that was not yet known.

mod failure;
mod gyro_bias;
mod in_flight;
mod initializer;
mod linear;
mod monocular;
mod static_start;

pub use failure::{Obstacle, Refusal};
pub use in_flight::{Attempt, InFlightConfig, InFlightStart, LoggedFrame, Seen, Started};
pub(crate) use initializer::{Found, STILL_SECS, Starting, UNKNOWN_INVERSE};
pub use static_start::{Rest, RestConfig, rest};

#[cfg(test)]
mod tests;
