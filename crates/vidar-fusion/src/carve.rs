//! Free space: cells (eighths of blocks) that lie entirely in front of the surface of a view.
//!
//! Space carving in the sense of Curless & Levoy (1996, section 4), at the resolution of cells: a cell in front
//! of the surface of every pixel it covers receives the free-space weight `c · min(1, (1 m / z)²)`; at extraction, the
//! weight is an observation of distance +1 for all nodes of the cell.
//! A floater is removed once its free-space weight exceeds its own. Free-space weights are stored beside the blocks,
//! because the result must not depend on whether a block exists yet. Blocks that a view touches are carved node by node and are no
//! part of this, so nothing is counted twice and no margin is needed before the surface.

use crate::FusionConfig;
use crate::grid::{BlockKey, CELLS, CameraFromWorld, EDGE};
use crate::sample::{CONFIDENCE_ONE, SampledView, Tile, WEIGHT_ONE, round_to_i32};
use nalgebra::Vector3;
use rayon::prelude::*;
use vidar_core::AlignedView;

/// Blocks that one view may examine; a smaller range is carved where the frustum holds more.
const MAX_EXAMINED: f64 = (1u32 << 19) as f64;
/// The tiles in which a block is looked up are so large that it covers about this many along each axis.
const TILES_ACROSS: usize = 4;

/// A block with free cells, and the weight of each cell in units of [`WEIGHT_ONE`], 0 where it is not free.
pub(crate) type FreeBlock = (BlockKey, [u32; CELLS]);

/// The free space of a view. It depends on the view and the configuration only.
#[derive(Default)]
pub(crate) struct FreeSpace {
    /// The blocks, sorted.
    pub blocks: Vec<FreeBlock>,
    /// Whether the range had to be shortened to keep the work bounded.
    pub shortened: bool,
}

/// Finds the cells that are free in `view`, outside of the blocks that it touches (sorted).
pub(crate) fn free_space(
    view: &AlignedView,
    sampled: &SampledView,
    touched: &[BlockKey],
    config: &FusionConfig,
) -> FreeSpace {
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
        range: range as f32,
        cells: cell_centres(view, block_m),
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
                    let weights = test.weights(centre.map(|v| v as f32).into());
                    if weights != [0; CELLS] && touched.binary_search(&[x, y, z]).is_err() {
                        free.push(([x, y, z], weights));
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
    let mut range = config.carve_range_m.min(f64::from(farthest));
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

/// The centres of a block's cells in the camera, seen from the block's centre, metres.
fn cell_centres(view: &AlignedView, block_m: f64) -> [[f32; 3]; CELLS] {
    let rotation = CameraFromWorld::new(view).rotation;
    std::array::from_fn(|cell| {
        let offset = [cell & 1, cell >> 1 & 1, cell >> 2 & 1].map(|o| (o as f64 - 0.5) * 0.5 * block_m);
        (rotation * Vector3::from(offset)).map(|v| v as f32).into()
    })
}

struct FreeSpaceTest<'a> {
    pyramid: &'a Pyramid,
    size: [f32; 2],
    k: [f32; 4],
    /// Of the sphere around a block.
    radius: f32,
    range: f32,
    cells: [[f32; 3]; CELLS],
}

/// What a view says of a sphere.
enum Sight {
    /// Nothing, or that it is behind the surface: so it is for everything within.
    Hidden,
    /// In front of the surface, with the weight of that.
    Free(u32),
    /// In front of it in parts.
    Mixed,
}

impl FreeSpaceTest<'_> {
    /// The free-space weights of the cells of a block whose centre lies there in the camera.
    #[inline(always)]
    fn weights(&self, centre: [f32; 3]) -> [u32; CELLS] {
        match self.sight(centre, self.radius) {
            Sight::Hidden => [0; CELLS],
            Sight::Free(weight) => [weight; CELLS],
            Sight::Mixed => self.cells.map(|cell| {
                let centre = [0, 1, 2].map(|a| centre[a] + cell[a]);
                if let Sight::Free(weight) = self.sight(centre, 0.5 * self.radius) { weight } else { 0 }
            }),
        }
    }

    #[inline(always)]
    fn sight(&self, [x, y, z]: [f32; 3], radius: f32) -> Sight {
        let front = z - radius;
        if z + radius <= 1e-3 || front > self.range {
            return Sight::Hidden;
        }
        if front <= 1e-3 || z > self.range {
            return Sight::Mixed;
        }
        let [fx, fy, cx, cy] = self.k;
        let (rx, ry) = (x / z, y / z);
        // |Δ(X/Z)| ≤ (r + |X/Z| r) / (Z − r) bounds the projection of the sphere.
        let (hu, hv) = (fx * radius * (1.0 + rx.abs()) / front, fy * radius * (1.0 + ry.abs()) / front);
        let (u, v) = (fx * rx + cx, fy * ry + cy);
        let (u0, u1, v0, v1) = (u - hu, u + hu, v - hv, v + hv);
        let (right, bottom) = (self.size[0] - 1.0, self.size[1] - 1.0);
        if u1 < 0.0 || v1 < 0.0 || u0 > right || v0 > bottom {
            return Sight::Hidden;
        }
        let pixel = |u: f32, v: f32| [u.clamp(0.0, right) as usize, v.clamp(0.0, bottom) as usize];
        let tile = self.pyramid.over(pixel(u0, v0), pixel(u1, v1));
        if tile.farthest <= front {
            return Sight::Hidden;
        }
        let is_inside = u0 >= 0.0 && v0 >= 0.0 && u1 <= right && v1 <= bottom;
        // Pixels without depth may hide a surface: half of the pixels must have a usable depth.
        if !is_inside || tile.nearest <= z + radius || 2 * tile.usable < tile.pixels {
            return Sight::Mixed;
        }
        let confidence = tile.confidence as f32 / (tile.usable as f32 * CONFIDENCE_ONE);
        let near = (1.0 / (z * z)).min(1.0);
        Sight::Free(round_to_i32(confidence * near * WEIGHT_ONE).max(1) as u32)
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
