//! The pipeline: configuration, the mapping engine, events, the run folder, and all stages connected.
//!
//! ```text
//! vidar-dataset ─▶ metric poses ─▶ vidar-stereo ─▶ vidar-align ─▶ vidar-fusion ─▶ vidar-eval · vidar-export · vidar-view
//!  Recording          MapKeyframe     GeometryPrediction  AlignedView    Surface          scores · files · figures
//! ```
//!
//! [`engine::Engine`] is the method as a push machine: sensor measurements in, map events out. [`run::run`] is a run of it:
//! recording → engine → evaluate → export. The program in `apps/vidar` only parses, calls it and prints.

pub mod batch;
pub mod bench;
pub mod calibrate;
mod camera_timing;
pub mod chunks;
pub mod compare;
pub mod config;
pub mod convert;
pub mod demo;
pub mod depth;
pub mod doctor;
pub mod engine;
pub mod error;
pub mod evaluate;
pub mod events;
pub mod export;
mod imu_noise;
pub mod input;
pub mod inspect;
mod interactive;
mod masks;
pub mod models;
pub mod odometry;
pub mod quality;
pub mod receive;
mod recorder;
pub mod run;
pub mod run_folder;
pub mod system;
pub mod verdict;
pub mod viewer;
pub mod worker;

pub use config::{Config, Layered};
pub use error::{Error, ExitStatus};
pub use events::{CancelToken, Event, Events};
pub use run::{RunOutcome, RunRequest, run};
pub use vidar_align as align;
pub use vidar_core as core;
pub use vidar_da3 as da3;
pub use vidar_dataset as dataset;
pub use vidar_eval as eval;
pub use vidar_export as export_formats;
pub use vidar_fusion as fusion;
pub use vidar_hub as hub;
pub use vidar_link as link;
pub use vidar_odometry as odometry_stage;
pub use vidar_synth as synth;

/// Version of the program.
pub const VERSION: &str = env!("CARGO_PKG_VERSION");
