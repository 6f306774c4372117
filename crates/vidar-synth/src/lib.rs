//! Synthetic worlds in EuRoC layout: exact flight, camera, IMU, depth and scan; deterministic by seed.
//!
//! One smooth curve ([`FlightPath`]) is the truth from which everything follows: images and depth by ray casting a
//! furnished [`World`], IMU samples from the curve's derivatives, a reference cloud of the surface that the
//! camera saw. [`write_sequence`] writes all of it as a EuRoC folder; [`render_views`] keeps it in memory.
//!
//! Every random number is drawn from a stream that belongs to its purpose and frame, so that the same [`SynthConfig`]
//! gives the same bytes for any number of threads.

mod bounds;
pub mod clip;
mod config;
mod device;
mod error;
mod extent;
mod flight;
mod image_file;
mod imu;
mod layout;
mod photometry;
pub mod predict;
mod presets;
mod random;
mod render;
mod rig;
mod scan;
mod schedule;
mod sensors;
mod sequence;
mod simulation;
mod stabiliser;
mod staging;
mod stamps;
mod truth;
mod world;

pub use config::{FlightKind, SceneKind, Start, SynthConfig, Variety};
pub use device::{CalibrationKind, DeviceConfig, ImuTiming, Lens, Mount};
pub use error::SynthError;
pub use extent::Extent;
pub use flight::{FlightPath, FlightState};
pub use imu::{ImuRecord, simulate_imu};
pub use presets::PRESETS;
pub use render::{RenderedView, SynthView, render_views};
pub use rig::{euroc_body_from_camera, euroc_camera, euroc_rig};
pub use sequence::{SynthSummary, write_sequence};
pub use simulation::Simulation;
pub use world::{Hit, World};

#[cfg(test)]
mod tests;
