//! The voxel lattice: nodes at `index · voxel`, grouped in cubic blocks of 8³ nodes that are hashed by their position.

use crate::{FusionConfig, FusionError};
use nalgebra::Vector3;
use vidar_core::AlignedView;

/// Nodes along the edge of a block.
pub(crate) const EDGE: usize = 8;
/// Nodes of a block.
pub(crate) const NODES: usize = EDGE * EDGE * EDGE;
/// Nodes along the edge of a cell, the unit of free space: half a block, so that one fits between a surface and what floats
/// before it.
pub(crate) const CELL: usize = 4;
/// Cells of a block, two along each axis, x fastest.
pub(crate) const CELLS: usize = 8;
/// Most views a volume takes: 16-bit counts and 32-bit colour sums (255 · 255 · 65535 < 2³²) cannot overflow then.
pub(crate) const MAX_VIEWS: u32 = 65_535;
/// Reach of the lattice in voxels: single precision still resolves eighths of a voxel there.
const REACH_VOXELS: f64 = (1u32 << 21) as f64;
/// A voxel may be this many times smaller than the distance of neighbouring pixels; beyond that, the surface has holes.
const MAX_OVERSAMPLING: f64 = 8.0;

/// Position of a block: node indices divided by [`EDGE`].
pub(crate) type BlockKey = [i32; 3];

/// Position of the node `local` (0…511, x fastest) of block `key` on the lattice.
pub(crate) fn node_of(key: BlockKey, local: usize) -> [i32; 3] {
    let offset = [local % EDGE, local / EDGE % EDGE, local / (EDGE * EDGE)];
    [0, 1, 2].map(|a| key[a] * EDGE as i32 + offset[a] as i32)
}

/// The cell of a block that node `local` lies in.
pub(crate) fn cell_of(local: usize) -> usize {
    let [x, y, z] = [local % EDGE, local / EDGE % EDGE, local / (EDGE * EDGE)].map(|i| i / CELL);
    (z * 2 + y) * 2 + x
}

/// Rejects views that the lattice cannot hold: too far out, or with pixels much coarser than the voxels.
pub(crate) fn check_view(config: &FusionConfig, view: &AlignedView) -> Result<(), FusionError> {
    let limit_m = REACH_VOXELS * config.voxel_size_m;
    let distance_m = view.world_from_camera().translation.norm() + config.max_depth_m * 4.0;
    if !(distance_m <= limit_m) {
        return Err(FusionError::TooFar {
            frame: view.frame_id(),
            distance_m: view.world_from_camera().translation.norm(),
            voxel_size_m: config.voxel_size_m,
            limit_m,
        });
    }
    let Some(depth) = median_depth(view, config.max_depth_m as f32) else { return Ok(()) };
    let focal = view.intrinsics().fx.max(view.intrinsics().fy);
    let footprint_m = f64::from(depth) / focal;
    let smallest_m = footprint_m / MAX_OVERSAMPLING;
    if config.voxel_size_m < smallest_m {
        return Err(FusionError::VoxelTooSmall {
            frame: view.frame_id(),
            voxel_size_m: config.voxel_size_m,
            footprint_m,
            smallest_m,
        });
    }
    Ok(())
}

/// Median of a regular sample of a view's depths up to `max_depth`, m; `None` when there are none.
pub fn median_depth(view: &AlignedView, max_depth: f32) -> Option<f32> {
    let data = view.depth().image().data();
    // About a thousand samples determine the median well within the tolerance of its uses; the stride is
    // odd so that it does not fall on one column only.
    let stride = (data.len() / 1024).max(1) | 1;
    let mut sample: Vec<f32> = data.iter().step_by(stride).copied().filter(|&z| z <= max_depth).collect();
    if sample.is_empty() {
        sample = data.iter().copied().filter(|&z| z <= max_depth).collect();
    }
    let half = sample.len() / 2;
    if sample.is_empty() {
        return None;
    }
    Some(*sample.select_nth_unstable_by(half, f32::total_cmp).1)
}

/// Bytes that a `hashbrown` table of `entries` entries of `entry_bytes` takes (7/8 load, power-of-two buckets).
pub(crate) fn table_bytes(entries: usize, entry_bytes: usize) -> u64 {
    if entries == 0 {
        return 0;
    }
    let buckets = (entries * 8 / 7 + 1).next_power_of_two().max(4);
    (buckets * (entry_bytes + 1)) as u64
}

/// A rigid motion from the world to the camera as a matrix and a vector, f64.
pub(crate) struct CameraFromWorld {
    pub rotation: nalgebra::Matrix3<f64>,
    pub translation: Vector3<f64>,
}

impl CameraFromWorld {
    pub fn new(view: &AlignedView) -> Self {
        let world_from_camera = view.world_from_camera();
        let rotation = world_from_camera.rotation.matrix().transpose();
        Self { rotation, translation: -(rotation * world_from_camera.translation) }
    }

    pub fn apply(&self, p: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * p + self.translation
    }
}
