//! Depth, weight and confidence of each pixel of a view.
//!
//! A confidence c is the probability of an error within a share t of the depth, the same t for all pixels. Where errors are normal with the
//! standard deviation σ of ln(depth), `c = erf(t / (σ √2))`, and with `erf(x)² ≈ 1 − exp(−4 x² / π)` (within 1 %)
//! `1/σ² ∝ −ln(1 − c²)`. The weight of a pixel with incidence angle θ between its ray and its surface normal and depth z is
//!
//! `w = ln(1 − c²) / ln(1 − c₁²) · cos θ · min(1, (1 m / z)²)`, at most 1 in its first factor,
//!
//! so it is the inverse of the depth's variance in metres, [`SURE`] being the c₁ beyond which σ is no longer told apart; the
//! angle as in Curless & Levoy (SIGGRAPH 1996, section 3.1: uncertainty grows as the surface turns away), the
//! depth as in Nießner et al. (TOG 2013, section 4: weight falls with depth, since depth noise grows with it).
//! It is stored as an integer, [`WEIGHT_ONE`] for w = 1, so that sums do not depend on their order.

use crate::FusionConfig;
use rayon::prelude::*;
use std::sync::LazyLock;
use vidar_core::simd::kernel;
use vidar_core::{AlignedView, Pinhole};

/// The integer that stands for a weight of 1 (12 bits).
pub(crate) const WEIGHT_ONE: f32 = 4095.0;
/// The integer that stands for a confidence of 1.
pub(crate) const CONFIDENCE_ONE: f32 = 255.0;
/// The confidence from which on all pixels are equally sure: a standard deviation of 0.39 tolerances.
const SURE: f64 = 0.99;
/// Pixels along the edge of a tile.
pub(crate) const TILE: usize = 8;
/// Depth steps between neighbouring pixels above this share of the depth are treated as the edge of an object.
const JUMP_RATIO: f32 = 0.05;
/// Adding this to a float below 2²² rounds it to the nearest integer, found in the low bits. Unlike `as`, which
/// must saturate, this becomes one vector addition.
pub(crate) const ROUND: f32 = 12_582_912.0;

/// Nearest integer of `x`, for |x| < 2²².
#[inline(always)]
pub(crate) fn round_to_i32(x: f32) -> i32 {
    ((x + ROUND).to_bits() as i32).wrapping_sub(ROUND.to_bits() as i32)
}

/// A pixel's input to fusion. Its layout is what the gathers of `update_avx2` read.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub(crate) struct Sample {
    /// z-depth, metres.
    pub depth: f32,
    /// Weight in its low 16 bits, 0 = unusable; confidence (of [`CONFIDENCE_ONE`]) above.
    pub weight_and_confidence: u32,
}

impl Sample {
    pub const NONE: Self = Self { depth: 0.0, weight_and_confidence: 0 };

    #[inline(always)]
    pub fn weight(self) -> u32 {
        self.weight_and_confidence & 0xffff
    }

    #[inline(always)]
    pub fn confidence(self) -> u32 {
        self.weight_and_confidence >> 16
    }
}

/// Depths of a square of pixels, for deciding what is empty.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Tile {
    /// Smallest depth of any pixel, usable or not; infinite when there is none.
    pub nearest: f32,
    /// Largest depth of a usable pixel; 0 when there is none.
    pub farthest: f32,
    /// Pixels of the square that lie in the image.
    pub pixels: u32,
    /// Usable pixels.
    pub usable: u32,
    /// Sum of the confidences of usable pixels.
    pub confidence: u32,
}

impl Tile {
    pub const EMPTY: Self =
        Self { nearest: f32::INFINITY, farthest: 0.0, pixels: 0, usable: 0, confidence: 0 };

    pub fn join(self, other: &Self) -> Self {
        Self {
            nearest: self.nearest.min(other.nearest),
            farthest: self.farthest.max(other.farthest),
            pixels: self.pixels + other.pixels,
            usable: self.usable + other.usable,
            confidence: self.confidence + other.confidence,
        }
    }
}

/// All samples of a view, row by row, and their tiles. Kept from view to view, so that its memory is allocated once.
#[derive(Clone, Debug, Default)]
pub(crate) struct SampledView {
    pub width: usize,
    pub height: usize,
    pub samples: Vec<Sample>,
    /// Red, green and blue of each pixel, and one byte more, so that any pixel can be read as four bytes. Empty for
    /// a view without colour.
    pub colors: Vec<u8>,
    pub tiles: Vec<Tile>,
    pub tile_columns: usize,
    pub pixels_used: u64,
}

impl SampledView {
    /// Weighs every pixel of `view`, replacing the samples of the previous view.
    pub fn fill(&mut self, view: &AlignedView, config: &FusionConfig) {
        let (width, height) = (view.intrinsics().width, view.intrinsics().height);
        let weigher = PixelWeighting::new(view, config);
        let (tile_columns, tile_rows) = (width.div_ceil(TILE), height.div_ceil(TILE));
        (self.width, self.height, self.tile_columns) = (width, height, tile_columns);
        self.samples.resize(width * height, Sample::NONE);
        self.tiles.resize(tile_columns * tile_rows, Tile::EMPTY);
        let strips = self.samples.par_chunks_mut(width * TILE).zip(self.tiles.par_chunks_mut(tile_columns));
        strips.enumerate().with_min_len(4).for_each(|(tile_row, (samples, tiles))| {
            for (row, samples) in samples.chunks_mut(width).enumerate() {
                weigher.row(tile_row * TILE + row, samples);
            }
            fill_tiles(&weigher, tile_row, samples, tiles);
        });
        self.fill_colors(view);
        self.pixels_used = self.tiles.iter().map(|t| u64::from(t.usable)).sum();
    }

    /// Copies the colours. Blocks access them in an order that is not prefetched; reading them once sequentially brings
    /// them into the cache.
    fn fill_colors(&mut self, view: &AlignedView) {
        let bytes = view.color().map_or(&[][..], |c| c.data().as_flattened());
        self.colors.resize(if bytes.is_empty() { 0 } else { bytes.len() + 1 }, 0);
        let chunk = 16 * TILE * self.width * 3;
        (self.colors.par_chunks_mut(chunk).zip(bytes.par_chunks(chunk)))
            .for_each(|(into, from)| into[..from.len()].copy_from_slice(from));
    }

    /// Bytes held while the view is integrated.
    pub fn scratch_bytes(&self) -> u64 {
        (self.samples.len() * size_of::<Sample>() + self.colors.len() + self.tiles.len() * size_of::<Tile>())
            as u64
    }
}

/// Distance in pixels over which depth is differenced: about 3 at VGA, where neighbouring pixels hold mostly noise.
pub(crate) fn gradient_step(width: usize) -> usize {
    ((width + 100) / 200).clamp(1, 8)
}

/// Slope of depth per pixel, from the depths before, at and behind a pixel (NaN = none).
///
/// Central where the surface is smooth, the gentler side at an edge, 0 without neighbours.
#[inline(always)]
pub(crate) fn slope(before: f32, here: f32, after: f32, per_step: f32) -> f32 {
    let (left, right) = (here - before, after - here);
    let left_known = !left.is_nan();
    let right_known = !right.is_nan();
    let gentler = if left.abs() < right.abs() { left } else { right };
    let smooth = (left - right).abs() <= JUMP_RATIO * here;
    let both = if smooth { 0.5 * (left + right) } else { gentler };
    let one = if left_known { left } else { right };
    let any = if left_known & right_known { both } else { one };
    if left_known | right_known { any * per_step } else { 0.0 }
}

/// The surface normal in the camera (not unit, facing the camera) of a pixel of depth `z` and slopes `gx`, `gy`.
///
/// With P(u, v) = z(u, v)·r(u, v), r = ((u−cx)/fx, (v−cy)/fy, 1): ∂P/∂v × ∂P/∂u up to scale.
#[inline(always)]
pub(crate) fn camera_normal(k: &[f32; 4], du: f32, dv: f32, z: f32, gx: f32, gy: f32) -> [f32; 3] {
    [k[0] * gx, k[1] * gy, -(z + du * gx + dv * gy)]
}

/// The inverse variance of a pixel by its confidence in steps of 1 / [`CONFIDENCE_ONE`], 1 for [`SURE`] ones.
static INVERSE_VARIANCE: LazyLock<[f32; 256]> = LazyLock::new(|| {
    std::array::from_fn(|step| {
        let confidence = (step as f64 / f64::from(CONFIDENCE_ONE)).min(SURE);
        ((1.0 - confidence * confidence).ln() / (1.0 - SURE * SURE).ln()) as f32
    })
});

struct PixelWeighting<'a> {
    width: usize,
    height: usize,
    depth: &'a [f32],
    confidence: &'a [f32],
    /// Stands for rows outside the image.
    missing: Vec<f32>,
    k: [f32; 4],
    per_focal: [f32; 2],
    step: usize,
    min_confidence: f32,
    max_depth: f32,
    min_cos: f32,
    inverse_variance: &'static [f32; 256],
}

kernel! {
    fn weigh_inner(
        weighting: &PixelWeighting<'_>,
        range: std::ops::Range<usize>,
        y: f32,
        rows: [&[f32]; 3],
        confidence: &[f32],
        out: &mut [Sample],
    ) {
        weighting.inner(range, y, rows, confidence, out);
    }
}

kernel! {
    fn fill_tiles(weighting: &PixelWeighting<'_>, tile_row: usize, samples: &[Sample], tiles: &mut [Tile]) {
        weighting.fill_tiles(tile_row, samples, tiles);
    }
}

impl<'a> PixelWeighting<'a> {
    fn new(view: &'a AlignedView, config: &FusionConfig) -> Self {
        let k: &Pinhole = view.intrinsics();
        Self {
            width: k.width,
            height: k.height,
            depth: view.depth().image().data(),
            confidence: view.confidence().image().data(),
            missing: vec![f32::NAN; k.width],
            k: [k.fx as f32, k.fy as f32, k.cx as f32, k.cy as f32],
            per_focal: [1.0 / k.fx as f32, 1.0 / k.fy as f32],
            step: gradient_step(k.width),
            // A confidence of 0 is unusable, whatever the threshold.
            min_confidence: (config.min_confidence as f32).max(f32::MIN_POSITIVE),
            max_depth: config.max_depth_m as f32,
            inverse_variance: &INVERSE_VARIANCE,
            min_cos: (config.max_incidence_deg.to_radians().cos() as f32).max(0.0),
        }
    }

    fn row(&self, y: usize, out: &mut [Sample]) {
        let row = |y: usize| &self.depth[y * self.width..(y + 1) * self.width];
        let above = if y >= self.step { row(y - self.step) } else { &self.missing[..] };
        let below = if y + self.step < self.height { row(y + self.step) } else { &self.missing[..] };
        let rows = [above, row(y), below];
        let confidence = &self.confidence[y * self.width..(y + 1) * self.width];
        let (w, step) = (self.width, self.step);
        let inner = step.min(w)..w.saturating_sub(step).max(step.min(w));
        for x in (0..inner.start).chain(inner.end..w) {
            let at = |row: &[f32], x: Option<usize>| x.and_then(|x| row.get(x)).copied().unwrap_or(f32::NAN);
            let line = [at(rows[1], x.checked_sub(step)), rows[1][x], at(rows[1], Some(x + step))];
            let column = [above[x], below[x]];
            out[x] = self.sample(x as f32, y as f32, line, column, confidence[x]);
        }
        weigh_inner(self, inner, y as f32, rows, confidence, out);
    }

    /// Pixels that have neighbours on both sides; cut to equal slices so that the loop has no bounds to check.
    #[inline(always)]
    fn inner(
        &self,
        range: std::ops::Range<usize>,
        y: f32,
        rows: [&[f32]; 3],
        confidence: &[f32],
        out: &mut [Sample],
    ) {
        let (first, n) = (range.start, range.len());
        if n == 0 {
            return;
        }
        let before = &rows[1][first - self.step..][..n];
        let here = &rows[1][first..][..n];
        let after = &rows[1][first + self.step..][..n];
        let (above, below) = (&rows[0][first..][..n], &rows[2][first..][..n]);
        let (confidence, out) = (&confidence[first..][..n], &mut out[first..][..n]);
        for i in 0..n {
            let line = [before[i], here[i], after[i]];
            out[i] = self.sample((first + i) as i32 as f32, y, line, [above[i], below[i]], confidence[i]);
        }
    }

    #[inline(always)]
    fn sample(&self, x: f32, y: f32, line: [f32; 3], column: [f32; 2], confidence: f32) -> Sample {
        let z = line[1];
        let per_step = 1.0 / self.step as f32;
        let gx = slope(line[0], z, line[2], per_step);
        let gy = slope(column[0], z, column[1], per_step);
        let (du, dv) = (x - self.k[2], y - self.k[3]);
        let n = camera_normal(&self.k, du, dv, z, gx, gy);
        let (rx, ry) = (du * self.per_focal[0], dv * self.per_focal[1]);
        // n · r = −z for every slope, hence cos θ = z / (|n| |r|).
        let norms = ((n[0] * n[0] + n[1] * n[1] + n[2] * n[2]) * (rx * rx + ry * ry + 1.0)).sqrt();
        let steep = z < self.min_cos * norms;
        let usable = (z <= self.max_depth) & (confidence >= self.min_confidence) & !steep;
        // cos θ · min(1, 1 / z²) with a single division: they and the root dominate the time of this kernel.
        let far = if z > 1.0 { z * z } else { 1.0 };
        // Below 0, above 1 and NaN are not in a `Confidence`.
        let confidence = round_to_i32(confidence * CONFIDENCE_ONE).max(1) as u32;
        let sure = self.inverse_variance[(confidence & 255) as usize];
        let weight = round_to_i32(sure * z / (norms * far) * WEIGHT_ONE).max(1) as u32;
        let packed = weight | (confidence << 16);
        // Every field of an unusable sample is a number, so that kernels may compute with it and weigh it 0.
        Sample { depth: if usable { z } else { 0.0 }, weight_and_confidence: if usable { packed } else { 0 } }
    }

    /// Summarises the strip of rows that starts at `tile_row` · [`TILE`].
    #[inline(always)]
    fn fill_tiles(&self, tile_row: usize, samples: &[Sample], tiles: &mut [Tile]) {
        let w = self.width;
        let depth = &self.depth[tile_row * TILE * w..][..samples.len()];
        for (column, tile) in tiles.iter_mut().enumerate() {
            let columns = column * TILE..(column * TILE + TILE).min(w);
            let mut lanes = TileLanes::default();
            for (samples, depth) in samples.chunks_exact(w).zip(depth.chunks_exact(w)) {
                match (
                    <&[Sample; TILE]>::try_from(&samples[columns.clone()]),
                    depth[columns.clone()].try_into(),
                ) {
                    (Ok(samples), Ok(depth)) => lanes.add(samples, depth),
                    _ => {
                        // The last column of an image whose width is no multiple of the tile.
                        let mut padded = ([Sample::NONE; TILE], [f32::NAN; TILE]);
                        padded.0[..columns.len()].copy_from_slice(&samples[columns.clone()]);
                        padded.1[..columns.len()].copy_from_slice(&depth[columns.clone()]);
                        lanes.add(&padded.0, &padded.1);
                    }
                }
            }
            *tile = lanes.tile((columns.len() * samples.len() / w) as u32);
        }
    }
}

/// A tile in the making, one lane a column.
struct TileLanes {
    nearest: [f32; TILE],
    farthest: [f32; TILE],
    usable: [u32; TILE],
    confidence: [u32; TILE],
}

impl Default for TileLanes {
    fn default() -> Self {
        Self {
            nearest: [f32::INFINITY; TILE],
            farthest: [0.0; TILE],
            usable: [0; TILE],
            confidence: [0; TILE],
        }
    }
}

impl TileLanes {
    #[inline(always)]
    fn add(&mut self, samples: &[Sample; TILE], depth: &[f32; TILE]) {
        for i in 0..TILE {
            let usable = samples[i].weight_and_confidence != 0;
            // Comparisons with NaN are false.
            self.nearest[i] = if depth[i] < self.nearest[i] { depth[i] } else { self.nearest[i] };
            let farther = usable & (depth[i] > self.farthest[i]);
            self.farthest[i] = if farther { depth[i] } else { self.farthest[i] };
            self.usable[i] += u32::from(usable);
            self.confidence[i] += samples[i].confidence();
        }
    }

    fn tile(&self, pixels: u32) -> Tile {
        Tile {
            nearest: self.nearest.iter().copied().fold(f32::INFINITY, f32::min),
            farthest: self.farthest.iter().copied().fold(0.0, f32::max),
            pixels,
            usable: self.usable.iter().sum(),
            confidence: self.confidence.iter().sum(),
        }
    }
}
