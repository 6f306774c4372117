//! The pixels of a view, summed by voxel before they are added to the point cloud.
//!
//! A voxel of usual size is observed by dozens of neighbouring pixels. A strip of rows therefore sums them in a small
//! direct-mapped table; when another voxel takes its slot, a voxel's partial sum is evicted and later added to the
//! cloud's hash tables. Sums are integers, so the result does not depend on how pixels are grouped.

use crate::grid::BlockKey;
use crate::sample::{Sample, SampledView, camera_normal, gradient_step, round_to_i32, slope};
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;
use rustc_hash::FxBuildHasher;
use std::hash::BuildHasher;
use vidar_core::AlignedView;
use vidar_core::simd::kernel;

/// Voxels are distributed over this many tables, which are filled in parallel.
pub(crate) const SHARDS: usize = 16;

/// The integer that stands for one voxel edge in sums of positions, and for 1 in sums of normals.
pub(crate) const FRACTION_ONE: f32 = 4096.0;
/// Rows of a strip.
const STRIP: usize = 32;
/// Pixels that a partial sum takes: 127 weights (12 bits) of normals (12 bits and sign) fit 32 bits.
const MAX_PIXELS: u32 = 127;
/// Slots of a strip's table: a few times the voxels that a row of pixels crosses, and still in the second cache.
const SLOTS: usize = 1024;

/// Sums over some pixels of one voxel.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct PartialSum {
    pub key: BlockKey,
    /// Σ w · (position − centre of the voxel), Σ w · normal, Σ w, 0: one vector.
    pub sums: [i32; 8],
    /// Σ w · colour, and Σ w of the pixels that had one.
    pub color: [u32; 4],
    pub confidence: u32,
    pub pixels: u32,
}

impl PartialSum {
    pub fn offset(&self) -> [i32; 3] {
        [0, 1, 2].map(|a| self.sums[a])
    }

    pub fn normal(&self) -> [i32; 3] {
        [3, 4, 5].map(|a| self.sums[a])
    }

    pub fn weight(&self) -> u32 {
        self.sums[6] as u32
    }
}

/// The partial sums of a view, by strip and shard. Kept from view to view to reuse its memory.
#[derive(Clone, Debug, Default)]
pub(crate) struct Strips {
    strips: Vec<Strip>,
}

#[derive(Clone, Debug, Default)]
struct Strip {
    partial_sums: Vec<Vec<PartialSum>>,
    slots: Vec<PartialSum>,
    row: Row,
}

/// Positions and normals of the pixels of a row; unspecified where there is no depth.
#[derive(Clone, Debug, Default)]
struct Row {
    /// Depths with a margin of NaN on both sides.
    depth: Vec<f32>,
    pixels: Vec<Pixel>,
}

/// Position and normal of a pixel.
#[derive(Clone, Copy, Debug, Default)]
struct Pixel {
    /// Voxels from that of the camera.
    voxel: [i32; 3],
    /// Offset from the voxel's centre and unit normal, of [`FRACTION_ONE`], 1, 0: what [`PartialSum::sums`] sums.
    terms: [i32; 8],
}

impl Strips {
    /// Sums the pixels of `view` by voxel, replacing those of the previous view.
    pub fn fill(&mut self, view: &AlignedView, sampled: &SampledView, voxel_m: f64) {
        let backprojector = Backprojector::new(view, voxel_m);
        self.strips.resize_with(sampled.height.div_ceil(STRIP), Strip::default);
        let rows = sampled.samples.par_chunks(sampled.width * STRIP);
        self.strips.par_iter_mut().zip(rows).enumerate().for_each(|(at, (strip, samples))| {
            strip.clear();
            for (row, samples) in samples.chunks_exact(sampled.width).enumerate() {
                let y = at * STRIP + row;
                backproject(&backprojector, y, samples, &mut strip.row);
                let colors = view.color().map(|c| &c.data()[y * sampled.width..][..sampled.width]);
                add_row(strip, samples, colors, backprojector.camera_voxel);
            }
            strip.finish();
        });
    }

    /// The partial sums of one shard, in the order of strips.
    pub fn of_shard(&self, shard: usize) -> impl Iterator<Item = &PartialSum> {
        self.strips.iter().flat_map(move |strip| &strip.partial_sums[shard])
    }
}

kernel! {
    fn backproject(backprojector: &Backprojector<'_>, y: usize, samples: &[Sample], row: &mut Row) {
        backprojector.backproject(y, samples, row);
    }
}

kernel! {
    fn add_row(strip: &mut Strip, samples: &[Sample], colors: Option<&[[u8; 3]]>, camera_voxel: BlockKey) {
        strip.add(samples, colors, camera_voxel);
    }
}

impl Strip {
    fn clear(&mut self) {
        self.partial_sums.resize_with(SHARDS, Vec::new);
        self.partial_sums.iter_mut().for_each(Vec::clear);
        self.slots.clear();
        self.slots.resize(SLOTS, PartialSum::default());
    }

    /// Adds the row that was back-projected last.
    #[inline(always)]
    fn add(&mut self, samples: &[Sample], colors: Option<&[[u8; 3]]>, camera_voxel: BlockKey) {
        for (x, (sample, pixel)) in samples.iter().zip(&self.row.pixels).enumerate() {
            let weight = sample.weight();
            if weight == 0 {
                continue;
            }
            let key = [0, 1, 2].map(|a| camera_voxel[a].wrapping_add(pixel.voxel[a]));
            let slot = &mut self.slots[slot_of(&key)];
            if slot.key != key || slot.pixels == MAX_PIXELS {
                if slot.pixels > 0 {
                    self.partial_sums[shard_of(&slot.key)].push(*slot);
                }
                *slot = PartialSum { key, ..PartialSum::default() };
            }
            for (sum, term) in slot.sums.iter_mut().zip(pixel.terms) {
                *sum += weight as i32 * term;
            }
            if let Some(colors) = colors {
                for (sum, channel) in slot.color.iter_mut().zip(colors[x]) {
                    *sum += weight * u32::from(channel);
                }
                slot.color[3] += weight;
            }
            slot.confidence += sample.confidence();
            slot.pixels += 1;
        }
    }

    /// Evicts the remaining slots.
    fn finish(&mut self) {
        for slot in self.slots.iter().filter(|slot| slot.pixels > 0) {
            self.partial_sums[shard_of(&slot.key)].push(*slot);
        }
    }
}

/// The slot of a voxel: Knuth's multiplicative hash, whose upper bits are the well-mixed ones.
#[inline(always)]
fn slot_of(key: &BlockKey) -> usize {
    const FACTORS: [u32; 3] = [0x9e37_79b1, 0x85eb_ca77, 0xc2b2_ae3d];
    let product = |a: usize| (key[a] as u32).wrapping_mul(FACTORS[a]);
    let hash = product(0).wrapping_add(product(1)).wrapping_add(product(2));
    (hash >> (u32::BITS - SLOTS.ilog2())) as usize % SLOTS
}

/// Back-projects pixels into voxels.
struct Backprojector<'a> {
    depth: &'a [f32],
    width: usize,
    height: usize,
    step: usize,
    /// fx, fy, cx, cy.
    k: [f32; 4],
    /// Stands for rows outside the image.
    missing: Vec<f32>,
    camera_voxel: BlockKey,
    /// Offset of the camera from the centre of its voxel, in voxels, where single precision is plenty.
    start: [f32; 3],
    rotation: [[f32; 3]; 3],
    per_voxel: f32,
}

impl<'a> Backprojector<'a> {
    fn new(view: &'a AlignedView, voxel_m: f64) -> Self {
        let k = view.intrinsics();
        let origin = view.world_from_camera().translation / voxel_m;
        let camera_voxel = origin.map(f64::round);
        let rotation: Matrix3<f64> = view.world_from_camera().rotation.matrix();
        let rotation = [0, 1, 2].map(|r| [0, 1, 2].map(|c| rotation[(r, c)] as f32));
        let start: Vector3<f32> = (origin - camera_voxel).map(|c| c as f32);
        Self {
            depth: view.depth().image().data(),
            width: k.width,
            height: k.height,
            step: gradient_step(k.width),
            k: [k.fx as f32, k.fy as f32, k.cx as f32, k.cy as f32],
            missing: vec![f32::NAN; k.width],
            camera_voxel: camera_voxel.map(|c| c as i32).into(),
            start: start.into(),
            rotation,
            per_voxel: (1.0 / voxel_m) as f32,
        }
    }

    /// Back-projects the pixels of row `y`.
    #[inline(always)]
    fn backproject(&self, y: usize, samples: &[Sample], row: &mut Row) {
        let (n, step) = (self.width, self.step);
        let line = |y: usize| &self.depth[y * n..][..n];
        row.depth.clear();
        row.depth.resize(n + 2 * step, f32::NAN);
        row.depth[step..step + n].copy_from_slice(line(y));
        row.pixels.resize(n, Pixel::default());
        let above = if y >= step { line(y - step) } else { &self.missing[..n] };
        let below = if y + step < self.height { line(y + step) } else { &self.missing[..n] };
        let (before, here, after) = (&row.depth[..n], &row.depth[step..][..n], &row.depth[2 * step..][..n]);
        let (samples, pixels) = (&samples[..n], &mut row.pixels[..n]);
        let per_step = 1.0 / step as f32;
        let per_focal = [1.0 / self.k[0], 1.0 / self.k[1]];
        let dv = y as f32 - self.k[3];
        for x in 0..n {
            let z = samples[x].depth;
            let du = x as i32 as f32 - self.k[2];
            let gx = slope(before[x], here[x], after[x], per_step);
            let gy = slope(above[x], here[x], below[x], per_step);
            let normal = camera_normal(&self.k, du, dv, z, gx, gy);
            // n · r = −z, so n is not zero where there is a depth.
            let squared = normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2];
            let scale = FRACTION_ONE / squared.sqrt();
            let along = z * self.per_voxel;
            let point = [du * per_focal[0] * along, dv * per_focal[1] * along, along];
            for a in 0..3 {
                let [r0, r1, r2] = self.rotation[a];
                let at = self.start[a] + (r0 * point[0] + r1 * point[1] + r2 * point[2]);
                let voxel = round_to_i32(at);
                pixels[x].voxel[a] = voxel;
                pixels[x].terms[a] = round_to_i32((at - voxel as f32) * FRACTION_ONE);
                let turned = r0 * normal[0] + r1 * normal[1] + r2 * normal[2];
                pixels[x].terms[3 + a] = round_to_i32(turned * scale);
            }
            pixels[x].terms[6] = 1;
        }
    }
}

/// The shard that a voxel belongs to.
fn shard_of(key: &BlockKey) -> usize {
    // The upper half, because the tables use the lower bits.
    (FxBuildHasher.hash_one(key) >> 32) as usize % SHARDS
}
