//! Point fusion.

use crate::{FusionConfig, FusionError, IntegrationStats};
use vidar_core::{AlignedView, PointCloud, Warning};

/// A voxel-hashed point cloud.
#[derive(Clone, Debug)]
pub struct PointFusion {
    config: FusionConfig,
}

impl PointFusion {
    /// An empty cloud; refuses a configuration that is out of range.
    pub fn new(config: &FusionConfig) -> Result<Self, FusionError> {
        config.validate()?;
        Ok(Self { config: config.clone() })
    }

    /// The settings.
    pub fn config(&self) -> &FusionConfig {
        &self.config
    }

    /// Fuses one view.
    pub fn integrate(&mut self, _view: &AlignedView) -> Result<IntegrationStats, FusionError> {
        Ok(IntegrationStats::default())
    }

    /// The fused points.
    pub fn finish(self) -> PointCloud {
        PointCloud::default()
    }

    /// Degradations so far.
    pub fn warnings(&self) -> Vec<Warning> {
        Vec::new()
    }

    /// Bytes held now.
    pub fn memory_bytes(&self) -> u64 {
        0
    }
}
