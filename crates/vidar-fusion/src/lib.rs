//! Confidence-weighted TSDF and point fusion, mesh extraction, coverage.

mod config;
mod coverage;
mod error;
mod points;
mod volume;

pub use config::FusionConfig;
pub use coverage::{CoverageReport, DensityCell, DensityMap};
pub use error::FusionError;
pub use points::PointFusion;
pub use volume::{IntegrationStats, TsdfVolume};
