//! Settings of fusion.

use crate::FusionError;
use serde::{Deserialize, Serialize};

/// Settings of fusion, shared by the TSDF volume and the point cloud.
///
/// There is no maximum weight: a running average with a maximum depends on the order of the views, and the result of
/// this crate has the same bits for every order.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct FusionConfig {
    /// Edge of a voxel, metres, 0.0005 to 10. Smaller shows more detail and costs memory with its inverse square.
    pub voxel_size_m: f64,
    /// Truncation of the signed distance in voxels, 2 to 32. Raise it when depth noise exceeds a few voxels.
    pub truncation_voxels: f64,
    /// Depths beyond this z, metres, 0.05 to 1000, are ignored. Lower it when far depth is poor.
    pub max_depth_m: f64,
    /// Pixels below this confidence, 0 to 1, are ignored. Raise it when wrong depth reaches the map.
    pub min_confidence: f64,
    /// Pixels whose surface is seen at a steeper angle from its normal than this, degrees, 10 to 90, are ignored:
    /// they are the smeared edges of objects.
    pub max_incidence_deg: f64,
    /// Free space observed up to this z, metres, 0 to 100, removes surface that other views put there; 0 turns
    /// carving off. Raise it to clean large rooms.
    pub carve_range_m: f64,
    /// Views that must have observed a voxel near its surface before it is used, 1 to 1000. 1 keeps everything.
    pub min_observations: u32,
    /// Connected components of the mesh with fewer triangles than this are dropped, 0 to 1000000; 0 keeps all.
    pub min_component_triangles: u32,
    /// Bytes that the volume may hold, at least 1 MiB. When it is full, new space is not mapped, and reported.
    pub memory_budget_bytes: u64,
}

impl Default for FusionConfig {
    fn default() -> Self {
        Self {
            voxel_size_m: 0.02,
            truncation_voxels: 4.0,
            max_depth_m: 6.0,
            min_confidence: 0.2,
            max_incidence_deg: 80.0,
            carve_range_m: 4.0,
            min_observations: 2,
            min_component_triangles: 50,
            memory_budget_bytes: 2 << 30,
        }
    }
}

impl FusionConfig {
    /// Smallest budget that still holds the bookkeeping and a few dozen blocks.
    pub const MIN_MEMORY_BUDGET_BYTES: u64 = 1 << 20;

    /// Checks every field against the range in its description.
    pub fn validate(&self) -> Result<(), FusionError> {
        let ranges = [
            ("voxel_size_m", self.voxel_size_m, 0.0005, 10.0),
            ("truncation_voxels", self.truncation_voxels, 2.0, 32.0),
            ("max_depth_m", self.max_depth_m, 0.05, 1000.0),
            ("min_confidence", self.min_confidence, 0.0, 1.0),
            ("max_incidence_deg", self.max_incidence_deg, 10.0, 90.0),
            ("carve_range_m", self.carve_range_m, 0.0, 100.0),
            ("min_observations", f64::from(self.min_observations), 1.0, 1000.0),
            ("min_component_triangles", f64::from(self.min_component_triangles), 0.0, 1e6),
            (
                "memory_budget_bytes",
                self.memory_budget_bytes as f64,
                Self::MIN_MEMORY_BUDGET_BYTES as f64,
                f64::INFINITY,
            ),
        ];
        for (field, found, min, max) in ranges {
            // NaN is in no range.
            if !(min..=max).contains(&found) {
                return Err(FusionError::BadConfig { field, min, max, found });
            }
        }
        Ok(())
    }

    /// Truncation distance, metres.
    pub fn truncation_m(&self) -> f64 {
        self.voxel_size_m * self.truncation_voxels
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    type Change = fn(&mut FusionConfig);

    #[test]
    fn the_default_is_valid_and_every_field_is_checked() {
        assert_eq!(FusionConfig::default().validate(), Ok(()));
        let invalid: [(&str, Change); 9] = [
            ("voxel_size_m", |c| c.voxel_size_m = 0.0),
            ("truncation_voxels", |c| c.truncation_voxels = 1.0),
            ("max_depth_m", |c| c.max_depth_m = f64::INFINITY),
            ("min_confidence", |c| c.min_confidence = -0.1),
            ("max_incidence_deg", |c| c.max_incidence_deg = 91.0),
            ("carve_range_m", |c| c.carve_range_m = f64::NAN),
            ("min_observations", |c| c.min_observations = 0),
            ("min_component_triangles", |c| c.min_component_triangles = 2_000_000),
            ("memory_budget_bytes", |c| c.memory_budget_bytes = 0),
        ];
        for (name, change) in invalid {
            let mut config = FusionConfig::default();
            change(&mut config);
            match config.validate() {
                Err(FusionError::BadConfig { field, .. }) => assert_eq!(field, name),
                other => panic!("{name}: {other:?}"),
            }
        }
    }
}
