//! What was seen, how often and how surely.

use serde::{Deserialize, Serialize};

/// One voxel of a [`DensityMap`].
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct DensityCell {
    /// Lattice index; the voxel's centre lies at `index · voxel_size_m` in the world.
    pub index: [i32; 3],
    /// Views that saw the voxel within the truncation of their depth.
    pub observations: u32,
    /// Mean confidence of those views, 0…1.
    pub mean_confidence: f32,
}

/// Observation count and mean confidence of every voxel that the surface passes, sorted by index.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct DensityMap {
    /// Edge of a voxel, metres.
    pub voxel_size_m: f64,
    /// The voxels.
    pub cells: Vec<DensityCell>,
}

/// Coverage in a few numbers.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct CoverageReport {
    /// Area of the extracted mesh, m².
    pub surface_area_m2: f64,
    /// Space that was seen, free or surface, m³.
    pub observed_volume_m3: f64,
    /// Smallest and largest corner of the mesh in the world, metres; `None` when it is empty.
    pub bounds_m: Option<[[f32; 3]; 2]>,
    /// Surface voxels that were judged.
    pub surface_voxels: u64,
    /// Mean number of views of a surface voxel.
    pub mean_observations: f64,
    /// Mean confidence of surface voxels, 0…1.
    pub mean_confidence: f64,
    /// Share of surface voxels seen by at least three views, 0…1.
    pub share_seen_by_3_or_more: f64,
    /// Views that were fused.
    pub views: u32,
}
