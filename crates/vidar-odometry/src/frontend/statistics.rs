//! How good an image is, and how much the picture moved: what health and standstill detection look at.

use super::config::{KltConfig, MatchingConfig};
use super::feature::{Feature, FeatureKind};
use super::feature_alignment::align_feature;
use super::pyramid::{Pyramid, to_level};
use super::template::{Template, Warp};
use nalgebra::Vector3;
use vidar_core::Image;
use vidar_core::camera::Pixel;

/// Statistics of one image, over a regular eighth of its pixels.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ImageQuality {
    /// Mean grey level.
    pub mean_gray: f64,
    /// Standard deviation of the grey levels.
    pub contrast_gray: f64,
    /// Share of pixels at 2 or less, which know nothing of the scene.
    pub dark_ratio: f64,
    /// Share of pixels at 253 or more.
    pub bright_ratio: f64,
    /// Standard deviation of the noise, grey levels (Immerkær 1996, with a quantile for the mean, so that texture counts little).
    pub noise_gray: f64,
    /// Root mean square gradient of level 1, noise taken out, grey levels per pixel of that level.
    pub texture_gray: f64,
    /// Gradients of level 0 over those of level 1, noise taken out: about 0.7 for sharp edges, 0.5 and less for blurred.
    pub sharpness: f64,
}

impl ImageQuality {
    /// Measures an image.
    pub fn of(pyramid: &Pyramid) -> Self {
        let image = pyramid.level(0);
        let mut quality = Self::default();
        quality.gather_levels(image);
        quality.noise_gray = noise(image);
        // A central difference of noise σ has variance σ²/2; level 1 averages four pixels.
        let noise2 = quality.noise_gray * quality.noise_gray;
        let fine = (gradient_square(image, 4) - 0.5 * noise2).max(0.0);
        let coarse =
            (gradient_square(pyramid.level(1.min(pyramid.level_count() - 1)), 2) - 0.125 * noise2).max(1e-6);
        quality.texture_gray = coarse.sqrt();
        quality.sharpness = (fine / coarse).sqrt();
        quality
    }

    fn gather_levels(&mut self, image: &Image<u8>) {
        let mut histogram = [0_u32; 256];
        for y in (0..image.height()).step_by(4) {
            for pixel in image.row(y).iter().step_by(2) {
                histogram[usize::from(*pixel)] += 1;
            }
        }
        let n = histogram.iter().sum::<u32>().max(1) as f64;
        let (mut sum, mut square) = (0.0, 0.0);
        for (level, count) in histogram.iter().enumerate() {
            sum += level as f64 * f64::from(*count);
            square += (level * level) as f64 * f64::from(*count);
        }
        self.mean_gray = sum / n;
        self.contrast_gray = (square / n - self.mean_gray * self.mean_gray).max(0.0).sqrt();
        self.dark_ratio = f64::from(histogram[..=2].iter().sum::<u32>()) / n;
        self.bright_ratio = f64::from(histogram[253..].iter().sum::<u32>()) / n;
    }
}

/// Quantile of the filter's response that tells the noise; the rest may be texture.
const NOISE_QUANTILE: f64 = 0.3;

/// The 0.3 quantile of the absolute value of a standard normal variable.
const NOISE_QUANTILE_SIGMAS: f64 = 0.385_320_5;

/// Noise from the mask [1 −2 1; −2 4 −2; 1 −2 1], whose response to noise σ has deviation 6 σ and to ramps none.
fn noise(image: &Image<u8>) -> f64 {
    let (width, height) = (image.width(), image.height());
    if width < 3 || height < 3 {
        return 0.0;
    }
    let mut histogram = [0_u32; 512];
    let mut n = 0_u32;
    for y in (1..height - 1).step_by(6) {
        let rows = [image.row(y - 1), image.row(y), image.row(y + 1)];
        for x in (1..width - 1).step_by(3) {
            let v = |r: usize, c: usize| i32::from(rows[r][x + c - 1]);
            // Clipped pixels carry no noise.
            if rows[1][x] <= 2 || rows[1][x] >= 253 {
                continue;
            }
            let corners = v(0, 0) + v(0, 2) + v(2, 0) + v(2, 2);
            let sides = v(0, 1) + v(1, 0) + v(1, 2) + v(2, 1);
            let response = (corners - 2 * sides + 4 * v(1, 1)).unsigned_abs() as usize;
            histogram[response.min(511)] += 1;
            n += 1;
        }
    }
    let wanted = NOISE_QUANTILE * f64::from(n);
    let mut below = 0.0;
    for (response, count) in histogram.iter().enumerate() {
        let count = f64::from(*count);
        if below + count >= wanted && count > 0.0 {
            // Responses are whole numbers: r stands for r − ½ … r + ½.
            let share = (wanted - below) / count;
            let quantile = if response == 0 { 0.5 * share } else { response as f64 - 0.5 + share };
            return quantile / (6.0 * NOISE_QUANTILE_SIGMAS);
        }
        below += count;
    }
    0.0
}

/// Mean square of the gradient over both directions, every `step`-th row.
fn gradient_square(image: &Image<u8>, step: usize) -> f64 {
    let (width, height) = (image.width(), image.height());
    let (mut sum, mut n) = (0_u64, 0_u64);
    for y in (1..height.saturating_sub(1)).step_by(step) {
        let (above, here, below) = (image.row(y - 1), image.row(y), image.row(y + 1));
        let mut row = 0_u32;
        for x in (1..width - 1).step_by(2) {
            let gx = i32::from(here[x + 1]) - i32::from(here[x - 1]);
            let gy = i32::from(below[x]) - i32::from(above[x]);
            row += (gx * gx + gy * gy).unsigned_abs();
            n += 1;
        }
        sum += u64::from(row);
    }
    // Differences are twice the gradient; two directions share the sum.
    sum as f64 / (8.0 * n.max(1) as f64)
}

/// How the picture moved between two images, without any model of the motion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImageMotion {
    /// Median displacement of the patches, level-0 pixels.
    pub median_px: f64,
    /// Share of patches that moved more than `moved_px` of the meter, or were not found again.
    pub moved_ratio: f64,
    /// Patches with texture that were compared.
    pub patches: usize,
    /// Whether the two images are equal in every pixel: a frozen or repeated image.
    pub identical: bool,
}

/// Measures how much the picture moves; its buffers are kept.
#[derive(Clone, Debug)]
pub struct MotionMeter {
    matching: MatchingConfig,
    klt: KltConfig,
    template: Template,
    moved_px: f64,
    scratch: Vec<f64>,
}

/// Places along each side of the grid of patches: 35 patches are enough for a median.
const GRID: [usize; 2] = [7, 5];

/// Candidates per place of the grid, of which the one with the most texture is compared.
const CANDIDATES: usize = 4;

impl MotionMeter {
    /// A meter for which a patch has moved when it is displaced by more than `moved_px` level-0 pixels.
    pub fn new(klt: KltConfig, matching: MatchingConfig, moved_px: f64) -> Self {
        let scratch = Vec::with_capacity(GRID[0] * GRID[1]);
        Self { matching, klt, template: Template::empty(), moved_px, scratch }
    }

    /// Compares patches on a regular grid, on level 1 after coarser levels.
    pub fn measure(&mut self, previous: &Pyramid, current: &Pyramid, noise_gray: f64) -> ImageMotion {
        let identical = previous.level(0) == current.level(0);
        let level = 1.min(previous.level_count() - 1);
        self.scratch.clear();
        let (mut moved, mut patches) = (0_usize, 0_usize);
        for row in 0..GRID[1] {
            for column in 0..GRID[0] {
                let Some(pixel) = textured_place(previous, level, [column, row]) else { continue };
                patches += 1;
                match self.displacement(previous, current, pixel, level, noise_gray) {
                    Some(d) => {
                        moved += usize::from(d > self.moved_px);
                        self.scratch.push(d);
                    }
                    None => moved += 1,
                }
            }
        }
        let median_px = if self.scratch.is_empty() {
            0.0
        } else {
            let middle = self.scratch.len() / 2;
            *self.scratch.select_nth_unstable_by(middle, f64::total_cmp).1
        };
        ImageMotion { median_px, moved_ratio: moved as f64 / patches.max(1) as f64, patches, identical }
    }

    fn displacement(
        &mut self,
        previous: &Pyramid,
        current: &Pyramid,
        pixel: Pixel,
        level: usize,
        noise_gray: f64,
    ) -> Option<f64> {
        let mut start = pixel;
        let coarsest = (level + self.klt.extra_levels).min(previous.level_count() - 1);
        for l in (level..=coarsest).rev() {
            let feature = Feature { pixel, bearing: Vector3::z(), level: l as u8, kind: FeatureKind::Corner };
            if !self.template.fill(previous, &feature, &Warp::shift(start)) {
                continue;
            }
            match align_feature(&self.template, current, &start, noise_gray, &self.matching) {
                Ok(found) => start = found.measurement.pixel,
                Err(_) if l > level => {}
                Err(_) => return None,
            }
        }
        Some((start - pixel).norm())
    }
}

/// The place with the most texture among a few in one cell of the grid; `None` where all are flat.
fn textured_place(pyramid: &Pyramid, level: usize, cell: [usize; 2]) -> Option<Pixel> {
    let image = pyramid.level(level);
    let size = [image.width(), image.height()];
    let (mut best, mut place) = (MIN_SPREAD, None);
    for k in 0..CANDIDATES {
        // Candidates lie on the cell's quarter points.
        let shift = [1 + 2 * (k % 2), 1 + 2 * (k / 2)];
        let [x, y] = [0, 1].map(|i| (4 * cell[i] + shift[i]) * size[i] / (4 * GRID[i]));
        if x < 8 || y < 8 || x + 8 >= size[0] || y + 8 >= size[1] {
            continue;
        }
        let structure = super::detect::Structure::around(image, x, y);
        if structure.weak > best {
            (best, place) = (structure.weak, Some(Pixel::new(x as f64, y as f64)));
        }
    }
    place.map(|p| super::pyramid::from_level(&p, level)).filter(|p| to_level(p, level).x >= 0.0)
}

/// Least Shi-Tomasi strength of a patch that is compared, grey levels per pixel.
const MIN_SPREAD: f64 = 1.5;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frontend::testbed::{Random, scene};

    #[test]
    fn noise_is_told_from_texture() {
        let scene = scene();
        let clean = ImageQuality::of(&scene.pyramid(0));
        assert!(clean.noise_gray < 1.0, "{clean:?}");
        for sigma in [2.0, 4.0, 8.0] {
            let noisy = ImageQuality::of(&scene.spoiled(0, 1.0, sigma));
            assert!((noisy.noise_gray / sigma - 1.0).abs() < 0.25, "{sigma}: {noisy:?}");
        }
    }

    #[test]
    fn exposure_and_texture_are_measured() {
        let scene = scene();
        let (plain, bright) =
            (ImageQuality::of(&scene.pyramid(0)), ImageQuality::of(&scene.spoiled(0, 2.5, 0.0)));
        assert!(bright.mean_gray > 1.4 * plain.mean_gray && bright.bright_ratio > 0.1, "{bright:?}");
        assert!(plain.bright_ratio < 0.05, "{plain:?}");
        let flat = ImageQuality::of(&Pyramid::of(&Image::filled(376, 240, 1), 3));
        assert!(flat.dark_ratio == 1.0 && flat.texture_gray < 0.01 && flat.contrast_gray == 0.0, "{flat:?}");
    }

    #[test]
    fn blur_lowers_the_sharpness_whatever_the_noise() {
        let scene = scene();
        let sharp = &scene.views[0].image;
        let blurred = Image::from_fn(sharp.width(), sharp.height(), |x, y| {
            let sum: u32 = (0..9).map(|k| u32::from(sharp[((x + k).min(sharp.width() - 1), y)])).sum();
            (sum / 9) as u8
        });
        let mut random = Random::new(4);
        let noisy = |image: &Image<u8>, random: &mut Random| {
            image.map(|p| (f64::from(*p) + 4.0 * random.gaussian()).round().clamp(0.0, 255.0) as u8)
        };
        let of = |image: &Image<u8>| ImageQuality::of(&Pyramid::of(image, 4));
        let (a, b) = (of(sharp), of(&blurred));
        let (c, d) = (of(&noisy(sharp, &mut random)), of(&noisy(&blurred, &mut random)));
        eprintln!(
            "sharp {:.3} blurred {:.3} noisy {:.3} {:.3}",
            a.sharpness, b.sharpness, c.sharpness, d.sharpness
        );
        assert!(a.texture_gray > 1.3 * b.texture_gray, "{a:?} {b:?}");
        assert!(c.texture_gray > 1.3 * d.texture_gray, "{c:?} {d:?}");
    }

    #[test]
    fn standing_still_is_told_from_moving_and_from_freezing() {
        let scene = scene();
        let mut meter = MotionMeter::new(KltConfig::default(), MatchingConfig::default(), 0.5);
        let frozen = meter.measure(&scene.pyramid(0), &scene.pyramid(0), 0.0);
        assert!(frozen.identical && frozen.median_px < 0.01 && frozen.moved_ratio == 0.0, "{frozen:?}");
        let mut random = Random::new(9);
        let mut again = || {
            let image = scene.views[0].image.map(|p| (f64::from(*p) + 2.0 * random.gaussian()).round() as u8);
            Pyramid::of(&image, 5)
        };
        let still = meter.measure(&again(), &again(), 2.0);
        assert!(!still.identical && still.median_px < 0.3 && still.patches > 15, "{still:?}");
        let moving = meter.measure(&scene.pyramid(0), &scene.pyramid(1), 0.0);
        assert!(moving.median_px > 1.0 && moving.moved_ratio > 0.8, "{moving:?}");
    }
}
