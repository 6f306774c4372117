//! Which blocks a view touches: those that a pixel's ray crosses within the truncation of its depth.

use crate::FusionConfig;
use crate::grid::{BlockKey, EDGE, median_depth};
use crate::sample::{SampledView, TILE, round_to_i32};
use nalgebra::Vector3;
use rayon::prelude::*;
use vidar_core::AlignedView;
use vidar_core::simd::kernel;

/// Neighbouring rays that start a search lie at most this share of a block apart at the median depth…
const RAY_SPACING: f64 = 1.0 / 5.0;
/// …and at most this many pixels; rows are staggered, so that thin upright objects are hit by the next row.
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
    let rays = Rays::new(view, config, (stride_px as usize).clamp(1, MAX_STRIDE_PX));
    let rows: Vec<usize> = (0..sampled.height).step_by(rays.stride).collect();
    let found: Vec<Vec<Code>> = rows
        .par_chunks(8 * TILE / rays.stride)
        .map(|rows| {
            let mut found = TouchedCodes::default();
            for &y in rows {
                rays.touch_row(sampled, y, &mut found);
            }
            found.codes
        })
        .collect();
    let mut codes: Vec<Code> = found.into_iter().flatten().collect();
    codes.par_sort_unstable();
    codes.dedup();
    codes.into_iter().map(|code| rays.key(code)).collect()
}

/// A block as a number: its offset from the camera's block, x above y above z, so that codes sort as keys do.
type Code = u64;

/// Bits of a coordinate. Depths reach 2¹⁶ blocks (`check_view`), so only rays 85° off the axis could leave these.
const CODE_BITS: u32 = 21;
const CODE_MASK: u64 = (1 << CODE_BITS) - 1;
const CODE_ORIGIN: i32 = 1 << (CODE_BITS - 1);
/// The code of no block.
const NO_BLOCK: Code = u64::MAX;

/// The rays of a view, in units of blocks and from the block of the camera, where single precision is plenty.
struct Rays {
    /// Pixels from ray to ray, and rows from row to row.
    stride: usize,
    camera_block: BlockKey,
    start: [f32; 3],
    /// End of a ray of z-depth 1 m: that of pixel (0, 0), and what a column and a row add.
    corner: Vector3<f64>,
    column: [f32; 3],
    row: Vector3<f64>,
    truncation: f32,
    /// Points of a ray that are looked up, and z-depth from one to the next.
    points: usize,
    spacing: f32,
}

impl Rays {
    fn new(view: &AlignedView, config: &FusionConfig, stride: usize) -> Self {
        let per_block = 1.0 / (config.voxel_size_m * EDGE as f64);
        let truncation = config.truncation_m() as f32;
        let k = view.intrinsics();
        let rotation = view.world_from_camera().rotation.matrix() * per_block;
        let origin = view.world_from_camera().translation * per_block;
        let camera_block = origin.map(f64::floor);
        // Half a block per step and less than a block across: no block of a smooth surface is skipped.
        let steps = (4.0 * truncation * per_block as f32).ceil().max(1.0);
        Self {
            stride,
            camera_block: camera_block.map(|c| c as i32).into(),
            start: (origin - camera_block).map(|c| c as f32).into(),
            corner: rotation * k.ray(0.0, 0.0),
            column: (rotation.column(0) / k.fx).map(|c| c as f32).into(),
            row: rotation.column(1) / k.fy,
            truncation,
            points: steps as usize + 1,
            spacing: 2.0 * truncation / steps,
        }
    }

    fn touch_row(&self, sampled: &SampledView, y: usize, found: &mut TouchedCodes) {
        let stagger = (y / self.stride * 2 + y / self.stride / 3) % self.stride;
        let samples = &sampled.samples[y * sampled.width..][..sampled.width];
        found.depths.clear();
        found.depths.extend(samples.iter().skip(stagger).step_by(self.stride).map(|s| s.depth));
        found.row.resize(found.depths.len(), NO_BLOCK);
        let first: [f32; 3] = (self.corner + self.row * y as f64).map(|c| c as f32).into();
        for point in 0..self.points {
            // Point by point, not ray by ray: neighbours in the row mostly lie in the same block.
            let offset = point as f32 * self.spacing;
            encode(self, first, stagger, offset, &found.depths, &mut found.row);
            found.add_row();
        }
    }

    /// The block of each ray's point at `offset` behind the beginning of its truncation.
    #[inline(always)]
    fn encode(&self, first: [f32; 3], stagger: usize, offset: f32, depths: &[f32], codes: &mut [Code]) {
        for (i, (code, &depth)) in codes.iter_mut().zip(depths).enumerate() {
            let z = (depth - self.truncation).max(0.0) + offset;
            let x = (stagger + i * self.stride) as i32 as f32;
            let mut packed = 0;
            for axis in 0..3 {
                let at = self.start[axis] + (first[axis] + x * self.column[axis]) * z;
                packed = packed << CODE_BITS | (floor(at) + CODE_ORIGIN) as u32 as u64 & CODE_MASK;
            }
            // Unusable samples have a depth of 0.
            *code = if depth > 0.0 { packed } else { NO_BLOCK };
        }
    }

    fn key(&self, code: Code) -> BlockKey {
        let at = |shift: u32| (code >> shift & CODE_MASK) as i32 - CODE_ORIGIN;
        let [x, y, z] = self.camera_block;
        [x + at(2 * CODE_BITS), y + at(CODE_BITS), z + at(0)]
    }
}

kernel! {
    fn encode(rays: &Rays, first: [f32; 3], stagger: usize, offset: f32, depths: &[f32], codes: &mut [Code]) {
        rays.encode(first, stagger, offset, depths, codes);
    }
}

/// Blocks in the order of discovery, few of them twice: neighbouring rays cross the same blocks.
struct TouchedCodes {
    codes: Vec<Code>,
    /// The last code of each residue, which drops nearly all repetitions without a hash table.
    recent: [Code; Self::RECENT],
    /// Depths of a row's rays, and the blocks of one point of each.
    depths: Vec<f32>,
    row: Vec<Code>,
}

impl Default for TouchedCodes {
    fn default() -> Self {
        Self { codes: Vec::new(), recent: [NO_BLOCK; Self::RECENT], depths: Vec::new(), row: Vec::new() }
    }
}

impl TouchedCodes {
    /// 8 × 8 × 8 blocks.
    const RECENT: usize = 512;

    fn add_row(&mut self) {
        let mut last = NO_BLOCK;
        for &code in &self.row {
            if code == last || code == NO_BLOCK {
                continue;
            }
            last = code;
            let residue = |shift: u32| (code >> shift & 7) as usize;
            let recent = &mut self.recent[residue(0) | residue(CODE_BITS) << 3 | residue(2 * CODE_BITS) << 6];
            if *recent != code {
                *recent = code;
                self.codes.push(code);
            }
        }
    }
}

/// Floor without the library call that `f32::floor` is on the baseline instruction set, for |x| < 2²².
#[inline(always)]
fn floor(x: f32) -> i32 {
    let nearest = round_to_i32(x);
    nearest - i32::from(nearest as f32 > x)
}
