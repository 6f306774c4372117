//! Confidence-weighted TSDF and point fusion, mesh extraction, coverage.

mod allocate;
mod block;
mod carve;
mod config;
mod coverage;
mod cubes;
mod error;
mod extract;
mod field;
mod grid;
mod points;
mod sample;
mod simd;
mod tidy;
mod volume;

pub use config::FusionConfig;
pub use coverage::{CoverageReport, DensityCell, DensityMap, surface_area_m2};
pub use error::FusionError;
pub use points::PointFusion;
pub use volume::{IntegrationStats, TsdfVolume};
