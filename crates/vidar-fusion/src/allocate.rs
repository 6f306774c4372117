//! Which blocks a view touches: those that a pixel's ray crosses within the truncation of its depth.

use crate::FusionConfig;
use crate::grid::{BlockKey, EDGE, median_depth};
use crate::sample::{SampledView, TILE};
use nalgebra::Vector3;
use rayon::prelude::*;
use rustc_hash::FxHashSet;
use vidar_core::AlignedView;

/// Neighbouring rays that start a search lie at most this share of a block apart at the median depth…
const RAY_SPACING: f64 = 1.0 / 8.0;
/// …and at most this many pixels, so that thin objects are met.
const MAX_STRIDE_PX: usize = 4;

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
    let found: Vec<FxHashSet<BlockKey>> = rows
        .par_chunks(4 * TILE / stride)
        .map(|rows| {
            let mut found = FxHashSet::default();
            for &y in rows {
                touch_row(view, sampled, config, y, stride, &mut found);
            }
            found
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
    found: &mut FxHashSet<BlockKey>,
) {
    // In units of blocks.
    let per_block = 1.0 / (config.voxel_size_m * EDGE as f64);
    let truncation = config.truncation_m();
    let rotation = view.world_from_camera().rotation.matrix() * per_block;
    let origin = view.world_from_camera().translation * per_block;
    // Half a block per step and less than a block across: no block of a smooth surface is jumped over.
    let steps = (4.0 * truncation * per_block).ceil().max(1.0) as usize;
    let per_step = 2.0 * truncation / steps as f64;
    let mut last = [[i32::MAX; 3]; 2];
    for x in (0..sampled.width).step_by(stride) {
        let sample = sampled.samples[y * sampled.width + x];
        if sample.weight() == 0 {
            continue;
        }
        let ray = rotation * view.intrinsics().ray(x as f64, y as f64);
        let nearest = (f64::from(sample.depth) - truncation).max(0.0);
        let mut at: Vector3<f64> = origin + ray * nearest;
        let step = ray * per_step;
        for _ in 0..=steps {
            let key = [floor(at.x), floor(at.y), floor(at.z)];
            // Neighbouring rays cross the same two blocks most of the time.
            if key != last[0] && key != last[1] {
                found.insert(key);
                last = [key, last[0]];
            }
            at += step;
        }
    }
}

/// Floor without the library call that `f64::floor` is on the baseline instruction set.
#[inline(always)]
fn floor(x: f64) -> i32 {
    let truncated = x as i32;
    truncated - i32::from(f64::from(truncated) > x)
}
