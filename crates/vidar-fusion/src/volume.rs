//! The TSDF volume.

use crate::{CoverageReport, DensityMap, FusionConfig, FusionError};
use serde::{Deserialize, Serialize};
use vidar_core::{AlignedView, PointCloud, TriangleMesh, Warning};

/// What one call of `integrate` did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct IntegrationStats {
    /// Pixels whose depth was used.
    pub pixels_used: u64,
    /// Blocks (or, for points, voxels) that the view changed.
    pub blocks_touched: u64,
    /// Blocks (or voxels) that exist now.
    pub blocks_total: u64,
    /// Blocks (or voxels) that the view needed and the memory budget refused.
    pub dropped_by_budget: u64,
    /// Blocks that the view saw entirely empty.
    pub blocks_carved: u64,
}

/// A truncated signed distance field over hashed blocks of voxels.
#[derive(Clone, Debug)]
pub struct TsdfVolume {
    config: FusionConfig,
}

impl TsdfVolume {
    /// An empty volume; refuses a configuration that is out of range.
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

    /// The surface as a mesh.
    pub fn extract_mesh(&self) -> TriangleMesh {
        TriangleMesh::default()
    }

    /// The vertices of the mesh.
    pub fn extract_cloud(&self) -> PointCloud {
        PointCloud::default()
    }

    /// Per-voxel observation counts.
    pub fn density_map(&self) -> DensityMap {
        DensityMap::default()
    }

    /// Coverage, given the mesh that [`Self::extract_mesh`] made.
    pub fn coverage(&self, _mesh: &TriangleMesh) -> CoverageReport {
        CoverageReport::default()
    }

    /// Degradations so far.
    pub fn warnings(&self) -> Vec<Warning> {
        Vec::new()
    }

    /// Bytes held now.
    pub fn memory_bytes(&self) -> u64 {
        0
    }

    /// Most bytes held at once so far, with the scratch of `integrate`.
    pub fn peak_memory_bytes(&self) -> u64 {
        0
    }
}
