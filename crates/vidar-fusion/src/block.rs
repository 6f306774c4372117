//! The sums that a block keeps, and how one view is added to them.
//!
//! Every sum is an integer, so adding views commutes and associates: any order of views, any number of threads,
//! the same bits. A node at projective distance s = depth of its pixel − its own z (metres, positive in front of the
//! surface; Nießner et al. 2013, section 4) adds
//!
//! `d = clamp(s / truncation, −1, 1)`, `Σ w·d`, `Σ w`   (Curless & Levoy 1996, eq. 1–2),
//!
//! with w of [`crate::sample`], falling linearly to 0 from one voxel behind the surface to the truncation, where
//! nothing is known. Nodes within the truncation also count the view and sum its confidence and colour.

use crate::grid::{EDGE, NODES};
use crate::sample::{Sample, round_to_i32};
use crate::simd::dispatch;

/// The integer that stands for a distance of one truncation: 1/4096 of it is finer than any depth sensor.
pub(crate) const DISTANCE_ONE: f32 = 4096.0;
/// Nodes closer to the camera plane than this, metres, are not looked up.
const NEAR_M: f32 = 1e-3;

/// Sums of red, green, blue times confidence, and of confidence, of one node.
pub(crate) type ColorSum = [u32; 4];

/// The sums of 8³ nodes, x fastest.
#[derive(Clone, Debug)]
pub(crate) struct Block {
    /// Σ w·d, of weight · [`DISTANCE_ONE`]. 65535 views of 2²⁴ fit.
    pub weighted_distance: [i64; NODES],
    /// Σ w.
    pub weight: [u32; NODES],
    /// Σ confidence of the views within the truncation.
    pub confidence: [u32; NODES],
    /// Views within the truncation.
    pub count: [u16; NODES],
    /// Colours, once a coloured view came.
    pub color: Option<Box<[ColorSum; NODES]>>,
}

impl Block {
    /// Bytes of a block without colour, with its pointer.
    pub const BYTES: u64 = (size_of::<Self>() + size_of::<usize>()) as u64;
    /// Bytes that colour adds.
    pub const COLOR_BYTES: u64 = size_of::<[ColorSum; NODES]>() as u64;

    pub fn new() -> Self {
        Self {
            weighted_distance: [0; NODES],
            weight: [0; NODES],
            confidence: [0; NODES],
            count: [0; NODES],
            color: None,
        }
    }

    pub fn add_color(&mut self) {
        self.color.get_or_insert_with(|| Box::new([[0; 4]; NODES]));
    }

    /// Signed distance of a node in truncations, with `free` (weight seen through the whole block) as distance 1;
    /// `None` when fewer than `min_observations` views saw it near a surface.
    #[inline(always)]
    pub fn distance(&self, node: usize, free: u32, min_observations: u32) -> Option<f32> {
        let weight = self.weight[node];
        if weight == 0 || u32::from(self.count[node]) < min_observations {
            return None;
        }
        let sum = self.weighted_distance[node] + i64::from(free) * DISTANCE_ONE as i64;
        let value = sum as f32 / ((u64::from(weight) + u64::from(free)) as f32 * DISTANCE_ONE);
        // A surface through a node would give up to six vertices in one place; a hair in front of it gives one
        // vertex per edge, all distinct.
        Some(if sum == 0 { ZERO_NUDGE } else { value })
    }

    /// Mean confidence of a node, 0…1.
    pub fn mean_confidence(&self, node: usize) -> f32 {
        let count = f32::from(self.count[node].max(1));
        self.confidence[node] as f32 / (count * crate::sample::CONFIDENCE_ONE)
    }

    /// Mean colour of a node, if any coloured view saw it.
    pub fn mean_color(&self, node: usize) -> Option<[f32; 3]> {
        let [r, g, b, weight] = self.color.as_ref()?[node];
        (weight > 0).then(|| [r, g, b].map(|c| c as f32 / weight as f32))
    }
}

/// What replaces a distance of exactly zero, in truncations.
const ZERO_NUDGE: f32 = 1.0 / (4.0 * DISTANCE_ONE);

/// One view, ready to be added to blocks.
pub(crate) struct BlockUpdate<'a> {
    pub samples: &'a [Sample],
    pub colors: Option<&'a [[u8; 3]]>,
    pub width: usize,
    pub height: usize,
    /// fx, fy, cx, cy.
    pub k: [f32; 4],
    /// Motion in the camera, metres, of one step along each axis of the lattice.
    pub steps: [[f32; 3]; 3],
    pub truncation_m: f32,
    pub voxel_m: f32,
}

/// Eight neighbours along x.
type Lanes<T> = [T; EDGE];

impl BlockUpdate<'_> {
    /// Adds the view to `block`, whose first node lies at `origin` in the camera, metres.
    pub fn add_to(&self, block: &mut Block, origin: [f32; 3]) {
        dispatch!(self.add_rows(block, origin));
    }

    #[inline(always)]
    fn add_rows(&self, block: &mut Block, origin: [f32; 3]) {
        for row in 0..EDGE * EDGE {
            let (y, z) = ((row % EDGE) as f32, (row / EDGE) as f32);
            let start = [0, 1, 2].map(|a| origin[a] + y * self.steps[1][a] + z * self.steps[2][a]);
            self.add_row(block, row * EDGE, start);
        }
    }

    #[inline(always)]
    fn add_row(&self, block: &mut Block, first: usize, start: [f32; 3]) {
        let (pixel, depth_of_node) = self.project_row(start);
        let mut depth: Lanes<f32> = [0.0; EDGE];
        let mut packed: Lanes<u32> = [0; EDGE];
        let mut seen = 0;
        for i in 0..EDGE {
            let sample = self.samples.get(pixel[i] as usize).copied().unwrap_or(Sample::NONE);
            depth[i] = sample.depth;
            packed[i] = sample.weight_and_confidence;
            seen |= packed[i];
        }
        if seen == 0 {
            return;
        }
        let per_truncation = 1.0 / self.truncation_m;
        let per_fade = 1.0 / (self.truncation_m - self.voxel_m);
        let mut weight: Lanes<u32> = [0; EDGE];
        let mut product: Lanes<i32> = [0; EDGE];
        let mut near: Lanes<u32> = [0; EDGE];
        for i in 0..EDGE {
            let distance = depth[i] - depth_of_node[i];
            let fade = ((distance + self.truncation_m) * per_fade).clamp(0.0, 1.0);
            let d = (distance * per_truncation).clamp(-1.0, 1.0);
            let w = round_to_i32((packed[i] & 0xffff) as f32 * fade);
            product[i] = w * round_to_i32(d * DISTANCE_ONE);
            weight[i] = w as u32;
            near[i] = u32::from((distance <= self.truncation_m) & (w > 0));
        }
        // Rows behind the surface are many and change nothing.
        if weight == [0; EDGE] {
            return;
        }
        for i in 0..EDGE {
            block.weighted_distance[first + i] += i64::from(product[i]);
            block.weight[first + i] += weight[i];
            block.count[first + i] += near[i] as u16;
            block.confidence[first + i] += near[i] * (packed[i] >> 16);
        }
        if let (Some(sums), Some(colors)) = (&mut block.color, self.colors) {
            for i in 0..EDGE {
                if near[i] != 0 {
                    add_color(&mut sums[first + i], colors[pixel[i] as usize], packed[i] >> 16);
                }
            }
        }
    }

    /// For eight nodes from `start`: the pixel each falls on (`u32::MAX` = none), and its z.
    #[inline(always)]
    fn project_row(&self, start: [f32; 3]) -> (Lanes<u32>, Lanes<f32>) {
        let [fx, fy, cx, cy] = self.k;
        let (right, bottom) = (self.width as f32 - 0.5, self.height as f32 - 0.5);
        let width = self.width as i32;
        let mut pixel: Lanes<u32> = [u32::MAX; EDGE];
        let mut depth: Lanes<f32> = [0.0; EDGE];
        for i in 0..EDGE {
            let t = i as f32;
            let x = start[0] + t * self.steps[0][0];
            let y = start[1] + t * self.steps[0][1];
            let z = start[2] + t * self.steps[0][2];
            let per_z = 1.0 / z;
            let (u, v) = (fx * x * per_z + cx, fy * y * per_z + cy);
            let inside = (z > NEAR_M) & (u > -0.5) & (v > -0.5) & (u < right) & (v < bottom);
            // Wrapping: what lies outside the image is garbage here and not taken.
            let index = round_to_i32(v).wrapping_mul(width).wrapping_add(round_to_i32(u));
            pixel[i] = if inside { index as u32 } else { u32::MAX };
            depth[i] = z;
        }
        (pixel, depth)
    }
}

#[inline(always)]
fn add_color(sum: &mut ColorSum, rgb: [u8; 3], confidence: u32) {
    for c in 0..3 {
        sum[c] += u32::from(rgb[c]) * confidence;
    }
    sum[3] += confidence;
}
