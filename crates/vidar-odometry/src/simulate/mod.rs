//! Feature-level simulation: a flight becomes IMU readings and pixels of landmarks, without images.

mod random;

pub use random::Random;
