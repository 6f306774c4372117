//! Corners followed from image to image without a camera model: pyramidal Lucas-Kanade (Bouguet 2001; inverse
//! compositional after Baker, Matthews 2004), free of offset and gain.
//!
//! Patches are compared with those of the last image that was kept, about 0.1 s ago, so errors add up ten times a second
//! and not with every image. A kept image checks every feature backwards and gets new corners where there are none.

use super::IMAGE_SPACING_SECS;
use super::template::Template;
use crate::frontend::{
    Detection, Detector, DetectorConfig, FeatureKind, FrontendError, Pyramid, from_level, to_level,
};
use nalgebra::Vector2;
use rayon::prelude::*;
use std::sync::Arc;
use vidar_core::camera::Pixel;
use vidar_core::{FrameImage, LandmarkId, Timestamp};

/// Levels of the pyramid.
const LEVELS: usize = 6;
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
#[derive(Clone, Debug)]
struct Followed {
    id: LandmarkId,
    /// In the kept image.
    anchor: Pixel,
    patches: Arc<Patches>,
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
            let goes_on = f.patches.find(newest, &(f.pixel + f.moved));
            let pixel = goes_on.or_else(|| f.patches.find(newest, &f.pixel))?;
            Some(Followed { moved: pixel - f.pixel, pixel, ..f.clone() })
        });
        self.followed = found.collect();
        let is_kept = self.kept_time.is_none_or(|t| (stamp - t).as_secs_f64() >= IMAGE_SPACING_SECS);
        if !is_kept {
            return Ok(None);
        }
        let returns = self.followed.par_iter().filter_map(|f| {
            let patches = Patches::new(newest, &f.pixel, base);
            let back = patches.find(kept, &f.anchor)?;
            let is_same = (back - f.anchor).norm() < MAX_RETURN_PX * (1 << base) as f64;
            is_same.then(|| Followed { anchor: f.pixel, patches: Arc::new(patches), ..*f })
        });
        self.followed = returns.collect();
        self.add_corners();
        std::mem::swap(&mut self.kept, &mut self.newest);
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
            let patches = Arc::new(Patches::new(&self.newest, &pixel, self.base));
            self.followed.push(Followed { id, anchor: pixel, patches, pixel, moved: Vector2::zeros() });
        }
    }
}

/// A feature's patch on all levels from the one that is searched on; none where a level shows nothing to hold on to.
#[derive(Debug)]
struct Patches {
    levels: Vec<Option<Template>>,
    base: usize,
}

impl Patches {
    fn new(image: &Pyramid, at: &Pixel, base: usize) -> Self {
        let levels = base..image.level_count();
        let template = |level| Template::at(image.level(level), &to_level(at, level));
        Self { levels: levels.map(template).collect(), base }
    }

    /// Where they lie in an image, starting at `guess`.
    fn find(&self, to: &Pyramid, guess: &Pixel) -> Option<Pixel> {
        let mut pixel = *guess;
        let mut is_found = false;
        for (at, template) in self.levels.iter().enumerate().rev() {
            let level = self.base + at;
            let Some(template) = template else { continue };
            match template.find(to.level(level), &to_level(&pixel, level)) {
                Some((place, ncc)) => {
                    is_found = at == 0 && ncc > MIN_NCC;
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
}
