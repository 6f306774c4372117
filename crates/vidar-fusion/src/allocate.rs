//! Which blocks a view touches: those that a pixel's ray crosses within the truncation of its depth.

use crate::FusionConfig;
use crate::grid::{BlockKey, EDGE, median_depth};
use crate::sample::{SampledView, TILE};
use nalgebra::Vector3;
use rayon::prelude::*;
use vidar_core::AlignedView;

/// Neighbouring rays that start a search lie at most this share of a block apart at the median depth…
const RAY_SPACING: f64 = 1.0 / 5.0;
/// …and at most this many pixels; rows are staggered, so that thin upright objects are met by the next row.
const MAX_STRIDE_PX: usize = 6;

/// The blocks that `view` touches, sorted, each once. At most a few per pixel, however small the voxels.
pub(crate) fn touched_blocks(
    view: &AlignedView,
    sampled: &SampledView,
    config: &FusionConfig,
) -> Vec<BlockKey> {
    let Some(median) = median_depth(view, config.max_depth_m as f32) else { return Vec::new() };
    let k = view.intrinsics();
    let block_m = config.voxel_size_m * EDGE as f64;
    let stride_px = block_m * RAY_SPACING * k.fx.min(k.fy) / f64::from(median);
    let stride = (stride_px as usize).clamp(1, MAX_STRIDE_PX);
    let rows: Vec<usize> = (0..sampled.height).step_by(stride).collect();
    let found: Vec<Vec<BlockKey>> = rows
        .par_chunks(8 * TILE / stride)
        .map(|rows| {
            let mut found = Found::default();
            for &y in rows {
                touch_row(view, sampled, config, y, stride, &mut found);
            }
            found.keys
        })
        .collect();
    let mut keys: Vec<BlockKey> = found.into_iter().flatten().collect();
    keys.par_sort_unstable();
    keys.dedup();
    keys
}

fn touch_row(
    view: &AlignedView,
    sampled: &SampledView,
    config: &FusionConfig,
    y: usize,
    stride: usize,
    found: &mut Found,
) {
    // In units of blocks, from the block of the camera, where single precision is plenty.
    let per_block = 1.0 / (config.voxel_size_m * EDGE as f64);
    let truncation = config.truncation_m() as f32;
    let k = view.intrinsics();
    let rotation = view.world_from_camera().rotation.matrix() * per_block;
    let origin = view.world_from_camera().translation * per_block;
    let camera_block = origin.map(f64::floor);
    let start: Vector3<f32> = (origin - camera_block).map(|c| c as f32);
    let camera_block = camera_block.map(|c| c as i32);
    let row_ray: Vector3<f32> = (rotation * k.ray(0.0, y as f64)).map(|c| c as f32);
    let column_ray: Vector3<f32> = (rotation.column(0) / k.fx).map(|c| c as f32);
    // Half a block per step and less than a block across: no block of a smooth surface is jumped over.
    let steps = (4.0 * truncation * per_block as f32).ceil().max(1.0) as usize;
    let per_step = 2.0 * truncation / steps as f32;
    let mut last = [i32::MAX; 3];
    let stagger = (y / stride * 2 + y / stride / 3) % stride;
    for x in (stagger..sampled.width).step_by(stride) {
        let sample = sampled.samples[y * sampled.width + x];
        if sample.weight() == 0 {
            continue;
        }
        let ray = row_ray + column_ray * x as f32;
        let mut at = start + ray * (sample.depth - truncation).max(0.0);
        let step = ray * per_step;
        for _ in 0..=steps {
            let key = [floor(at.x), floor(at.y), floor(at.z)];
            if key != last {
                found.add([0, 1, 2].map(|a| camera_block[a] + key[a]));
                last = key;
            }
            at += step;
        }
    }
}

/// Keys in the order of discovery, few of them twice: neighbouring rays cross the same blocks.
struct Found {
    keys: Vec<BlockKey>,
    /// The last key seen of each residue, which drops nearly all repetitions without a hash table.
    recent: [BlockKey; Self::RECENT],
}

impl Default for Found {
    fn default() -> Self {
        Self { keys: Vec::new(), recent: [[i32::MAX; 3]; Self::RECENT] }
    }
}

impl Found {
    /// 8 × 8 × 8 blocks.
    const RECENT: usize = 512;

    #[inline(always)]
    fn add(&mut self, key: BlockKey) {
        let slot = (key[0] & 7 | (key[1] & 7) << 3 | (key[2] & 7) << 6) as usize;
        if self.recent[slot] != key {
            self.recent[slot] = key;
            self.keys.push(key);
        }
    }
}

/// Floor without the library call that `f32::floor` is on the baseline instruction set.
#[inline(always)]
fn floor(x: f32) -> i32 {
    let truncated = x as i32;
    truncated - i32::from(truncated as f32 > x)
}
