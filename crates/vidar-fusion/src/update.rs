//! How one view is added to a block.
//!
//! A node at projective distance s = depth of its pixel − its own z (metres, positive in front of the surface;
//! Nießner et al. 2013, section 4) adds
//!
//! `d = clamp(s / truncation, −1, 1)`, `Σ w·d`, `Σ w`   (Curless & Levoy 1996, eq. 1–2),
//!
//! with w of [`crate::sample`], falling linearly to 0 from one voxel behind the surface to the truncation, where
//! nothing was observed. Nodes within the truncation also count the view and sum its confidence and colour.
//!
//! A row of eight nodes at a time: in plain Rust here, and with AVX2 in [`crate::update_avx2`], where the gathers
//! make it about twice as fast. Both do the same operations in the same order and give the same bits (tested).

use crate::block::{Block, ColorRow, DISTANCE_ONE, Lanes, Row};
use crate::grid::EDGE;
use crate::sample::{Sample, round_to_i32};

/// Nodes closer to the camera plane than this, metres, are not updated.
pub(crate) const NEAR_M: f32 = 1e-3;

/// One view, ready to be added to blocks.
pub(crate) struct BlockUpdate<'a> {
    pub samples: &'a [Sample],
    /// As [`SampledView::colors`](crate::sample::SampledView::colors).
    pub colors: Option<&'a [u8]>,
    pub width: usize,
    pub height: usize,
    /// fx, fy, cx, cy.
    pub k: [f32; 4],
    /// Motion in the camera, metres, of one step along each axis of the lattice.
    pub steps: [[f32; 3]; 3],
    pub truncation_m: f32,
    pub voxel_m: f32,
}

impl BlockUpdate<'_> {
    /// Adds the view to `block`, whose first node lies at `origin` in the camera, metres.
    pub fn add_to(&self, block: &mut Block, origin: [f32; 3]) {
        block.before_view();
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") && crate::update_avx2::can_add(self) {
            // SAFETY: the processor has AVX2, as checked on the line above.
            unsafe { crate::update_avx2::add_rows(self, block, origin) };
            return;
        }
        self.add_rows(block, origin);
    }

    fn add_rows(&self, block: &mut Block, origin: [f32; 3]) {
        let mut colors = block.color.as_deref_mut();
        for (at, row) in block.rows.iter_mut().enumerate() {
            let start = self.row_start(at, origin);
            self.add_row(row, colors.as_mut().map(|c| &mut c[at]), start);
        }
    }

    /// Where row `at` starts in the camera, metres.
    #[inline(always)]
    pub fn row_start(&self, at: usize, origin: [f32; 3]) -> [f32; 3] {
        let (y, z) = ((at % EDGE) as f32, (at / EDGE) as f32);
        [0, 1, 2].map(|a| origin[a] + y * self.steps[1][a] + z * self.steps[2][a])
    }

    #[inline(always)]
    fn add_row(&self, row: &mut Row, color: Option<&mut ColorRow>, start: [f32; 3]) {
        let (pixel, depth_of_node) = self.project_row(start);
        let mut depth: Lanes<f32> = [0.0; EDGE];
        let mut packed: Lanes<u32> = [0; EDGE];
        let mut any = 0;
        for i in 0..EDGE {
            let sample = self.samples.get(pixel[i] as usize).copied().unwrap_or(Sample::NONE);
            depth[i] = sample.depth;
            packed[i] = sample.weight_and_confidence;
            any |= packed[i];
        }
        if any == 0 {
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
            row.distance[i] += product[i];
            row.weight[i] += weight[i];
            row.near[i] += near[i] * (packed[i] & 0xffff_0000 | 1);
        }
        if let (Some(sums), Some(colors)) = (color, self.colors) {
            for i in (0..EDGE).filter(|&i| near[i] != 0) {
                let (rgb, confidence) = (&colors[pixel[i] as usize * 3..][..3], packed[i] >> 16);
                for c in 0..3 {
                    sums[c][i] += u32::from(rgb[c]) * confidence;
                }
                sums[3][i] += confidence;
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
            // Wrapping: values outside the image are arbitrary here and not used.
            let index = round_to_i32(v).wrapping_mul(width).wrapping_add(round_to_i32(u));
            pixel[i] = if inside { index as u32 } else { u32::MAX };
            depth[i] = z;
        }
        (pixel, depth)
    }
}

#[cfg(all(test, target_arch = "x86_64"))]
mod tests {
    use super::*;
    use crate::sample::{CONFIDENCE_ONE, WEIGHT_ONE};
    use vidar_core::random::SplitMix64;

    #[test]
    fn the_avx2_path_gives_the_bits_of_the_portable_path() {
        if !std::arch::is_x86_feature_detected!("avx2") {
            eprintln!("skipped: this processor has no AVX2");
            return;
        }
        let mut random = SplitMix64::new(1);
        let mut next = || random.uniform() as f32;
        let (mut nodes_changed, mut colors_changed) = (0, 0);
        for (width, height) in [(61, 47), (8, 8), (2, 1), (640, 3)] {
            let samples: Vec<Sample> = (0..width * height)
                .map(|_| {
                    let (weight, confidence) =
                        ((next() * WEIGHT_ONE) as u32, (next() * CONFIDENCE_ONE) as u32);
                    let usable = next() > 0.2;
                    let packed = if usable { weight.max(1) | confidence.max(1) << 16 } else { 0 };
                    Sample {
                        depth: if usable { 0.9 + 0.4 * next() } else { 0.0 },
                        weight_and_confidence: packed,
                    }
                })
                .collect();
            let colors: Vec<u8> = (0..width * height * 3 + 1).map(|_| (next() * 255.0) as u8).collect();
            for round in 0..400 {
                let mut steps = [[0.0; 3]; 3];
                steps.iter_mut().flatten().for_each(|s| *s = (next() - 0.5) * 0.08);
                let focal = 20.0 + 60.0 * next();
                let update = BlockUpdate {
                    samples: &samples,
                    colors: (round % 3 != 0).then_some(&colors[..]),
                    width,
                    height,
                    k: [focal, focal, width as f32 * next(), height as f32 * next()],
                    steps,
                    truncation_m: 0.08,
                    voxel_m: 0.02,
                };
                let mut portable = Block::new();
                if round % 2 == 0 {
                    portable.add_color();
                }
                let mut vector = portable.clone();
                // Some blocks lie beside the image, across the camera plane, or behind it.
                let origin = [next() - 0.5, next() - 0.5, 1.4 * next() - 0.2];
                update.add_rows(&mut portable, origin);
                assert!(crate::update_avx2::can_add(&update));
                // SAFETY: checked above.
                unsafe { crate::update_avx2::add_rows(&update, &mut vector, origin) };
                for (a, b) in portable.rows.iter().zip(&vector.rows) {
                    assert_eq!((a.distance, a.weight, a.near), (b.distance, b.weight, b.near));
                    nodes_changed += a.weight.iter().filter(|&&w| w > 0).count();
                }
                assert_eq!(portable.color, vector.color);
                let sums = portable.color.iter().flat_map(|rows| rows.iter());
                colors_changed += sums.flat_map(|row| row[3]).filter(|&sum| sum > 0).count();
            }
        }
        assert!(nodes_changed > 10_000 && colors_changed > 1_000, "{nodes_changed} {colors_changed}");
    }
}
