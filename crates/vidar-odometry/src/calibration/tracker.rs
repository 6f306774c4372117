//! Corners followed from image to image without a camera model: pyramidal Lucas-Kanade (Bouguet 2001; inverse
//! compositional after Baker, Matthews 2004), free of offset and gain.
//!
//! Patches are compared with those of the last image that was kept, about 0.1 s ago, so errors add up ten times a second
//! and not with every image. A kept image checks every feature backwards and gets new corners where there are none.

use super::IMAGE_SPACING_SECS;
use crate::frontend::{
    Detection, Detector, DetectorConfig, FeatureKind, FrontendError, Pyramid, from_level, sample, to_level,
};
use nalgebra::{Matrix2, Vector2};
use rayon::prelude::*;
use vidar_core::camera::Pixel;
use vidar_core::{FrameImage, Image, LandmarkId, Timestamp};

/// Levels of the pyramid.
const LEVELS: usize = 6;
/// Half side of a patch, pixels of its level.
const HALF: i32 = 6;
const SIDE: usize = (2 * HALF + 1) as usize;
/// Steps per level, and the step that ends them, pixels.
const STEPS: usize = 12;
const SETTLED_PX: f64 = 0.01;
/// Correlation of the patches that a match needs.
const MIN_NCC: f64 = 0.85;
/// Distance that a feature followed there and back may end from where it began, pixels.
const MAX_RETURN_PX: f64 = 0.5;
/// Cells across the image, each with at most one new feature.
const CELLS_ACROSS: usize = 18;
/// Images wider than this are followed at half the resolution or less: a patch sees as much of the scene.
const MAX_WIDTH: usize = 1100;
/// Distance from the border where features end, pixels.
const BORDER_PX: f64 = 3.0;

/// A feature that is followed.
#[derive(Clone, Copy, Debug)]
struct Followed {
    id: LandmarkId,
    /// In the kept image.
    anchor: Pixel,
    /// In the newest image, and its motion to there from the image before.
    pixel: Pixel,
    moved: Vector2<f64>,
}

/// Follows features.
#[derive(Debug)]
pub struct FeatureTracker {
    detector: Detector,
    kept: Pyramid,
    newest: Pyramid,
    kept_time: Option<Timestamp>,
    followed: Vec<Followed>,
    next_id: u32,
    found: Vec<Detection>,
    base: usize,
}

impl FeatureTracker {
    /// For images of `width` × `height`.
    pub fn new(width: usize, height: usize) -> Self {
        let base = Pyramid::level_for(width, height, MAX_WIDTH);
        let cell_px = (width.max(height) / CELLS_ACROSS).clamp(8, 256);
        // One level is searched: the detector names the finest, and large images are followed on a coarser one.
        let config = DetectorConfig { cell_px, levels: base + 1 };
        Self {
            detector: Detector::new(config),
            kept: Pyramid::new(width, height, LEVELS + base),
            newest: Pyramid::new(width, height, LEVELS + base),
            kept_time: None,
            followed: Vec::new(),
            next_id: 0,
            found: Vec::new(),
            base,
        }
    }

    /// Follows all features into `image`. The features of images that are kept are returned, about ten a second.
    ///
    /// # Errors
    /// The image has another size than the tracker was made for.
    pub fn push(
        &mut self,
        stamp: Timestamp,
        image: &FrameImage,
    ) -> Result<Option<Vec<(LandmarkId, Pixel)>>, FrontendError> {
        self.newest.rebuild(image)?;
        let (kept, newest, base) = (&self.kept, &self.newest, self.base);
        let found = self.followed.par_iter().filter_map(|f| {
            let goes_on = follow(kept, newest, &f.anchor, &(f.pixel + f.moved), base);
            let pixel = goes_on.or_else(|| follow(kept, newest, &f.anchor, &f.pixel, base))?;
            Some(Followed { moved: pixel - f.pixel, pixel, ..*f })
        });
        self.followed = found.collect();
        let is_kept = self.kept_time.is_none_or(|t| (stamp - t).as_secs_f64() >= IMAGE_SPACING_SECS);
        if !is_kept {
            return Ok(None);
        }
        let returns = self.followed.par_iter().filter(|f| {
            let back = follow(newest, kept, &f.pixel, &f.anchor, base);
            back.is_some_and(|b| (b - f.anchor).norm() < MAX_RETURN_PX * (1 << base) as f64)
        });
        self.followed = returns.copied().collect();
        self.add_corners();
        std::mem::swap(&mut self.kept, &mut self.newest);
        self.followed.iter_mut().for_each(|f| f.anchor = f.pixel);
        self.kept_time = Some(stamp);
        Ok(Some(self.followed.iter().map(|f| (f.id, f.pixel)).collect()))
    }

    fn add_corners(&mut self) {
        let mut taken = self.detector.grid(self.newest.width(), self.newest.height());
        for f in &self.followed {
            taken.take(&f.pixel);
        }
        self.detector.detect(&self.newest, &taken, &mut self.found);
        let corners = self.found.iter().filter(|d| d.kind == FeatureKind::Corner);
        for corner in corners {
            let id = LandmarkId(self.next_id);
            self.next_id = self.next_id.wrapping_add(1);
            let pixel = corner.pixel;
            self.followed.push(Followed { id, anchor: pixel, pixel, moved: Vector2::zeros() });
        }
    }
}

/// Where the patch of `from` at `anchor` lies in `to`, starting at `guess`.
fn follow(from: &Pyramid, to: &Pyramid, anchor: &Pixel, guess: &Pixel, base: usize) -> Option<Pixel> {
    let mut pixel = *guess;
    let mut is_found = false;
    for level in (base..from.level_count().min(to.level_count())).rev() {
        let Some(template) = Template::at(from.level(level), &to_level(anchor, level)) else {
            continue;
        };
        match template.find(to.level(level), &to_level(&pixel, level)) {
            Some((place, ncc)) => {
                is_found = level == base && ncc > MIN_NCC;
                pixel = from_level(&place, level);
            }
            // A coarse level may have nothing to hold on to.
            None => is_found = false,
        }
    }
    let (width, height) = (to.width() as f64, to.height() as f64);
    let is_inside = pixel.x > BORDER_PX
        && pixel.y > BORDER_PX
        && pixel.x < width - 1.0 - BORDER_PX
        && pixel.y < height - 1.0 - BORDER_PX;
    (is_found && is_inside).then_some(pixel)
}

/// A zero-mean patch with zero-mean gradients.
struct Template {
    grey: [f32; SIDE * SIDE],
    gx: [f32; SIDE * SIDE],
    gy: [f32; SIDE * SIDE],
    energy: f64,
    inverse: Matrix2<f64>,
}

impl Template {
    fn at(image: &Image<u8>, centre: &Pixel) -> Option<Self> {
        if !fits(image, centre, HALF + 1) {
            return None;
        }
        const WIDE: usize = SIDE + 2;
        let place = |centre: f64, k: usize| (centre + f64::from(k as i32 - HALF - 1)) as f32;
        let x = std::array::from_fn(|k| place(centre.x, k % WIDE));
        let y = std::array::from_fn(|k| place(centre.y, k / WIDE));
        let wide: [f32; WIDE * WIDE] = sample(image, &x, &y);
        let (mut grey, mut gx, mut gy) = ([0.0; SIDE * SIDE], [0.0; SIDE * SIDE], [0.0; SIDE * SIDE]);
        for y in 0..SIDE {
            for x in 0..SIDE {
                let (at, to) = ((y + 1) * WIDE + x + 1, y * SIDE + x);
                grey[to] = wide[at];
                gx[to] = 0.5 * (wide[at + 1] - wide[at - 1]);
                gy[to] = 0.5 * (wide[at + WIDE] - wide[at - WIDE]);
            }
        }
        for values in [&mut grey, &mut gx, &mut gy] {
            let mean = values.iter().sum::<f32>() / (SIDE * SIDE) as f32;
            values.iter_mut().for_each(|v| *v -= mean);
        }
        let h = Matrix2::new(dot(&gx, &gx), dot(&gx, &gy), dot(&gx, &gy), dot(&gy, &gy));
        let energy = dot(&grey, &grey);
        let weak = 0.5 * (h.trace() - ((h.m11 - h.m22).powi(2) + 4.0 * h.m12 * h.m12).sqrt());
        // Below a grey level per pixel of gradient, noise decides where the patch goes.
        if !(weak > (SIDE * SIDE) as f64 && energy > 1.0) {
            return None;
        }
        Some(Self { grey, gx, gy, energy, inverse: h.try_inverse()? })
    }

    /// The place of the patch's centre, and the correlation there.
    fn find(&self, image: &Image<u8>, start: &Pixel) -> Option<(Pixel, f64)> {
        let mut place = *start;
        for _ in 0..STEPS {
            let (step, ncc) = self.step(image, &place)?;
            place -= step;
            if !((place - start).norm() < 2.0 * SIDE as f64) {
                return None;
            }
            if step.norm() < SETTLED_PX {
                return Some((place, ncc));
            }
        }
        let (step, ncc) = self.step(image, &place)?;
        // What still moves by a pixel found nothing.
        (step.norm() < 0.5).then_some((place, ncc))
    }

    fn step(&self, image: &Image<u8>, place: &Pixel) -> Option<(Vector2<f64>, f64)> {
        if !fits(image, place, HALF) {
            return None;
        }
        let (x0, y0) = (place.x - f64::from(HALF), place.y - f64::from(HALF));
        let (left, top) = (x0 as usize, y0 as usize);
        let (fx, fy) = ((x0 - left as f64) as f32, (y0 - top as f64) as f32);
        let (mut sum, mut square, mut with_grey, mut bx, mut by) =
            (0.0_f32, 0.0_f32, 0.0_f32, 0.0_f32, 0.0_f32);
        for y in 0..SIDE {
            let upper = &image.row(top + y)[left..=left + SIDE];
            let lower = &image.row(top + y + 1)[left..=left + SIDE];
            for x in 0..SIDE {
                let a = f32::from(upper[x]) * (1.0 - fx) + f32::from(upper[x + 1]) * fx;
                let b = f32::from(lower[x]) * (1.0 - fx) + f32::from(lower[x + 1]) * fx;
                let value = a * (1.0 - fy) + b * fy;
                let k = y * SIDE + x;
                sum += value;
                square += value * value;
                with_grey += value * self.grey[k];
                bx += value * self.gx[k];
                by += value * self.gy[k];
            }
        }
        let n = (SIDE * SIDE) as f64;
        let energy = (f64::from(square) - f64::from(sum) * f64::from(sum) / n).max(1.0);
        let with_grey = f64::from(with_grey);
        let ncc = with_grey / (energy * self.energy).sqrt();
        // Far from the match the correlation, and with it the gain, is too small and the step too long.
        let gain = (with_grey / self.energy).max(0.5 * (energy / self.energy).sqrt()).max(0.05);
        let own = Vector2::new(dot(&self.grey, &self.gx), dot(&self.grey, &self.gy));
        let error = Vector2::new(f64::from(bx), f64::from(by)) / gain - own;
        Some((self.inverse * error, ncc))
    }
}

fn dot(a: &[f32], b: &[f32]) -> f64 {
    f64::from(a.iter().zip(b).map(|(a, b)| a * b).sum::<f32>())
}

/// Whether a patch of half side `half` with its right and lower neighbours lies in the image; written so that NaN fails.
fn fits(image: &Image<u8>, centre: &Pixel, half: i32) -> bool {
    let half = f64::from(half);
    centre.x >= half
        && centre.y >= half
        && centre.x + half + 1.0 < image.width() as f64 - 1.0
        && centre.y + half + 1.0 < image.height() as f64 - 1.0
}
