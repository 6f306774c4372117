//! Multi-view stereo from known poses: a geometry model that needs no weights.

mod confidence;
mod config;
mod consistency;
mod error;
mod estimate;
mod model;
mod prepare;
mod refine;
mod select;
mod sgm;
mod sweep;
mod warp;

pub use confidence::TOLERANCE_RATIO;
pub use config::StereoConfig;
pub use error::StereoError;
pub use model::{OmittedView, StereoModel, StereoOutput};
