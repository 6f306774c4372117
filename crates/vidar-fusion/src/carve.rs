//! Free space: blocks that lie entirely in front of the surface of a view.
//!
//! Space carving in the sense of Curless & Levoy (1996, section 4), at the resolution of blocks: a block in front
//! of the surface of every pixel it covers, by more than the truncation, receives the free-space weight
//! `c · min(1, (1 m / z)²)`; at extraction, the weight is an observation of distance +1 for all nodes of the block.
//! A floater is removed once its free-space weight exceeds its own. Free-space weights are stored beside the blocks,
//! because the result must not depend on whether a block exists yet. Within the blocks that a view touches, carving is per voxel.

use crate::FusionConfig;
use crate::grid::{BlockKey, CameraFromWorld, EDGE};
use crate::sample::{CONFIDENCE_ONE, SampledView, Tile, WEIGHT_ONE, round_to_i32};
use nalgebra::Vector3;
use rayon::prelude::*;
use vidar_core::AlignedView;

/// Blocks that one view may examine; a smaller range is carved where the frustum holds more.
const MAX_EXAMINED: f64 = (1u32 << 19) as f64;
/// The tiles in which a block is looked up are so large that it covers about this many along each axis.
const TILES_ACROSS: usize = 4;

/// A free block, with its weight in units of [`WEIGHT_ONE`].
pub(crate) type FreeBlock = (BlockKey, u32);

/// The free space of a view. It depends on the view and the configuration only.
#[derive(Default)]
pub(crate) struct FreeSpace {
    /// The blocks, sorted.
    pub blocks: Vec<FreeBlock>,
    /// Whether the range had to be shortened to keep the work bounded.
    pub shortened: bool,
}

/// Finds the blocks that are free in `view`.
pub(crate) fn free_space(view: &AlignedView, sampled: &SampledView, config: &FusionConfig) -> FreeSpace {
    let block_m = config.voxel_size_m * EDGE as f64;
    let Some(frustum) = frustum_blocks(view, sampled, config, block_m) else { return FreeSpace::default() };
    let Frustum { low, high, range, shortened } = frustum;
    let pyramid = Pyramid::new(sampled);
    let k = view.intrinsics();
    let test = FreeSpaceTest {
        pyramid: &pyramid,
        size: [sampled.width as f32, sampled.height as f32],
        k: [k.fx as f32, k.fy as f32, k.cx as f32, k.cy as f32],
        radius: (block_m * 0.5 * 3f64.sqrt()) as f32,
        truncation: config.truncation_m() as f32,
        range: range as f32,
    };
    let camera_from_world = CameraFromWorld::new(view);
    let step = camera_from_world.rotation.column(0) * block_m;
    let layers: Vec<Vec<FreeBlock>> = (low[2]..=high[2])
        .into_par_iter()
        .map(|z| {
            let mut free = Vec::new();
            for y in low[1]..=high[1] {
                let first = Vector3::new(low[0], y, z).map(|i| (f64::from(i) + 0.5) * block_m);
                let first = camera_from_world.apply(&first);
                for x in low[0]..=high[0] {
                    let centre = first + step * f64::from(x - low[0]);
                    if let Some(weight) = test.weight(centre.x as f32, centre.y as f32, centre.z as f32) {
                        free.push(([x, y, z], weight));
                    }
                }
            }
            free
        })
        .collect();
    let mut blocks: Vec<FreeBlock> = layers.into_iter().flatten().collect();
    blocks.par_sort_unstable();
    FreeSpace { blocks, shortened }
}

/// The box of blocks around a view's frustum, and the z that it reaches.
struct Frustum {
    low: BlockKey,
    high: BlockKey,
    range: f64,
    shortened: bool,
}

fn frustum_blocks(
    view: &AlignedView,
    sampled: &SampledView,
    config: &FusionConfig,
    block_m: f64,
) -> Option<Frustum> {
    if config.carve_range_m == 0.0 {
        return None;
    }
    // Beyond the view's farthest depth no block is free.
    let farthest = sampled.tiles.iter().map(|t| t.farthest).fold(0.0, f32::max);
    let mut range = config.carve_range_m.min(f64::from(farthest) - config.truncation_m());
    if !(range > 0.0) {
        return None;
    }
    let (w, h) = (sampled.width as f64 - 1.0, sampled.height as f64 - 1.0);
    let world_from_camera = view.world_from_camera();
    let corners = [(0.0, 0.0), (w, 0.0), (0.0, h), (w, h)]
        .map(|(u, v)| world_from_camera.rotation.matrix() * view.intrinsics().ray(u, v));
    let extent = |range: f64| {
        let mut low = Vector3::zeros();
        let mut high = Vector3::zeros();
        for corner in &corners {
            low = low.inf(&(corner * range));
            high = high.sup(&(corner * range));
        }
        (low, high)
    };
    let (low, high) = extent(range);
    let examined = (high - low).map(|e| e / block_m + 1.0).product();
    let shortened = examined > MAX_EXAMINED;
    if shortened {
        range *= (MAX_EXAMINED / examined).cbrt();
    }
    let (low, high) = extent(range);
    let origin = world_from_camera.translation;
    let key = |p: Vector3<f64>| [p.x, p.y, p.z].map(|c| (c / block_m).floor() as i32);
    Some(Frustum { low: key(origin + low), high: key(origin + high), range, shortened })
}

struct FreeSpaceTest<'a> {
    pyramid: &'a Pyramid,
    size: [f32; 2],
    k: [f32; 4],
    radius: f32,
    truncation: f32,
    range: f32,
}

impl FreeSpaceTest<'_> {
    /// The free-space weight of a block whose centre lies at (x, y, z) in the camera.
    #[inline(always)]
    fn weight(&self, x: f32, y: f32, z: f32) -> Option<u32> {
        let front = z - self.radius;
        if front <= 1e-3 || z > self.range {
            return None;
        }
        let [fx, fy, cx, cy] = self.k;
        let (rx, ry) = (x / z, y / z);
        // |Δ(X/Z)| ≤ (r + |X/Z| r) / (Z − r) bounds the projection of the block's bounding sphere.
        let (hu, hv) =
            (fx * self.radius * (1.0 + rx.abs()) / front, fy * self.radius * (1.0 + ry.abs()) / front);
        let (u, v) = (fx * rx + cx, fy * ry + cy);
        let (u0, u1, v0, v1) = (u - hu, u + hu, v - hv, v + hv);
        if u0 < 0.0 || v0 < 0.0 || u1 > self.size[0] - 1.0 || v1 > self.size[1] - 1.0 {
            return None;
        }
        let tile = self.pyramid.over([u0 as usize, v0 as usize], [u1 as usize, v1 as usize]);
        // Pixels without depth may hide a surface: half of the pixels must have a usable depth.
        if tile.nearest <= z + self.radius + self.truncation || 2 * tile.usable < tile.pixels {
            return None;
        }
        let confidence = tile.confidence as f32 / (tile.usable as f32 * CONFIDENCE_ONE);
        let near = (1.0 / (z * z)).min(1.0);
        Some(round_to_i32(confidence * near * WEIGHT_ONE).max(1) as u32)
    }
}

/// Tiles merged two by two, level by level.
struct Pyramid {
    levels: Vec<Level>,
}

struct Level {
    columns: usize,
    tiles: Vec<Tile>,
}

impl Pyramid {
    fn new(sampled: &SampledView) -> Self {
        let mut levels = vec![Level { columns: sampled.tile_columns, tiles: sampled.tiles.clone() }];
        while let Some(last) = levels.last()
            && last.tiles.len() > 1
        {
            let rows = last.tiles.len() / last.columns;
            let (half_columns, half_rows) = (last.columns.div_ceil(2), rows.div_ceil(2));
            let mut tiles = vec![Tile::EMPTY; half_columns * half_rows];
            for (i, tile) in last.tiles.iter().enumerate() {
                let into = &mut tiles[i / last.columns / 2 * half_columns + i % last.columns / 2];
                *into = into.join(tile);
            }
            levels.push(Level { columns: half_columns, tiles });
        }
        Self { levels }
    }

    /// All pixels from `first` to `last` (and those that share their tiles).
    #[inline(always)]
    fn over(&self, first: [usize; 2], last: [usize; 2]) -> Tile {
        use crate::sample::TILE;
        let across = (last[0] - first[0]).max(last[1] - first[1]) / TILE + 1;
        let level = (across / TILES_ACROSS).checked_ilog2().map_or(0, |l| l as usize + 1);
        let level = level.min(self.levels.len() - 1);
        let Level { columns, tiles } = &self.levels[level];
        let size = TILE << level;
        let mut all = Tile::EMPTY;
        for row in first[1] / size..=last[1] / size {
            for column in first[0] / size..=last[0] / size {
                all = all.join(&tiles[row * columns + column]);
            }
        }
        all
    }
}
