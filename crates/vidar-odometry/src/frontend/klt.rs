//! Young tracks: features of unknown depth, followed from image to image (Lucas & Kanade 1981; Bouguet 2000).
//!
//! The rotation that the gyroscope measured says where a feature is and how its patch is turned, up to the parallax that its
//! unknown depth causes; a pyramid covers that. The way back must end where the way began.

use super::config::{KltConfig, MatchingConfig};
use super::feature::{Feature, FeatureKind};
use super::feature_alignment::{AlignedFeature, MatchFailure, align_feature};
use super::pyramid::Pyramid;
use super::template::{Template, Warp};
use nalgebra::Matrix2;
use vidar_core::camera::Pixel;

/// A feature followed into the next image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KltStep {
    /// Where it is now.
    pub found: AlignedFeature,
    /// Distance between where the way back ended and where the way began, level-0 pixels.
    pub round_trip_px: f64,
}

/// Follows features between images; holds the buffer of one patch.
#[derive(Clone, Debug)]
pub struct KltTracker {
    config: KltConfig,
    matching: MatchingConfig,
    template: Template,
}

impl KltTracker {
    /// A tracker that aligns as `matching` says.
    pub fn new(config: KltConfig, matching: MatchingConfig) -> Self {
        Self { config, matching, template: Template::empty() }
    }

    /// Follows `feature` of `previous` into `current`, where `warp` expects it ([`Warp::rotated`] of what the gyroscope says,
    /// shifted by what the track moved beyond rotation before). `noise_gray` is the deviation of the image noise.
    ///
    /// # Errors
    /// Says why it was not found.
    pub fn track(
        &mut self,
        previous: &Pyramid,
        current: &Pyramid,
        feature: &Feature,
        warp: &Warp,
        noise_gray: f64,
    ) -> Result<KltStep, MatchFailure> {
        let found = self.descend(previous, current, feature, warp, noise_gray)?;
        // The way back starts as far off as the way there did.
        let back = warp.d_current_d_keyframe.try_inverse().unwrap_or_else(Matrix2::identity);
        let pixel = found.measurement.pixel;
        let returning = Feature { pixel, level: found.level, kind: FeatureKind::Corner, ..*feature };
        let start = feature.pixel + back * (pixel - warp.pixel);
        let warp_back = Warp { pixel: start, d_current_d_keyframe: back };
        let returned = self.descend(current, previous, &returning, &warp_back, noise_gray)?;
        let apart = returned.measurement.pixel - feature.pixel;
        let round_trip_px = match feature.kind {
            FeatureKind::Corner => apart.norm(),
            // Along an edge nothing is measured.
            FeatureKind::Edgelet { normal } => apart.dot(&normal).abs(),
        };
        let limit = self.config.max_round_trip_px * super::pyramid::level_scale(found.level.into());
        if round_trip_px <= limit {
            Ok(KltStep { found, round_trip_px })
        } else {
            Err(MatchFailure::Diverged)
        }
    }

    /// From the coarsest level to the feature's own; a coarse level that fails is passed over.
    fn descend(
        &mut self,
        from: &Pyramid,
        to: &Pyramid,
        feature: &Feature,
        warp: &Warp,
        noise_gray: f64,
    ) -> Result<AlignedFeature, MatchFailure> {
        let mut start: Pixel = warp.pixel;
        let own = usize::from(feature.level);
        let coarsest = (own + self.config.extra_levels).min(from.level_count() - 1);
        for level in (own + 1..=coarsest).rev() {
            let coarse = Feature { level: level as u8, ..*feature };
            if self.template.fill(from, &coarse, warp)
                && let Ok(found) = align_feature(&self.template, to, &start, noise_gray, &self.matching)
            {
                start = found.measurement.pixel;
            }
        }
        if !self.template.fill(from, feature, warp) {
            return Err(MatchFailure::OutsideImage);
        }
        align_feature(&self.template, to, &start, noise_gray, &self.matching)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frontend::testbed::{median, scene};
    use nalgebra::Vector2;

    /// Errors of what was followed from the keyframe into `view`, and how many were tried.
    fn follow(view: usize, sigma: f64) -> (Vec<f64>, usize) {
        let scene = scene();
        let (previous, current) = (scene.spoiled(0, 1.0, sigma), scene.spoiled(view, 1.0, sigma));
        let motion = scene.motion(0, view);
        let mut tracker = KltTracker::new(KltConfig::default(), MatchingConfig::default());
        let (mut errors, mut tried) = (Vec::new(), 0);
        for (feature, ..) in scene.features(0).iter().filter(|(f, ..)| !f.is_edgelet()) {
            let Some(truth) = scene.truth(0, view, &feature.pixel) else { continue };
            let Some(warp) = Warp::rotated(&scene.camera, feature, &motion.rotation) else { continue };
            tried += 1;
            if let Ok(step) = tracker.track(&previous, &current, feature, &warp, sigma) {
                assert!(step.round_trip_px <= 2.0);
                errors.push((step.found.measurement.pixel - truth).norm());
            }
        }
        (errors, tried)
    }

    #[test]
    fn features_of_unknown_depth_are_followed_with_the_rotation_known() {
        for (view, sigma) in [(1, 0.0), (2, 2.0), (3, 0.0), (1, 8.0)] {
            let (errors, tried) = follow(view, sigma);
            let wrong = errors.iter().filter(|e| **e > 2.0).count();
            eprintln!(
                "view {view} noise {sigma}: {} of {tried}, median {:.3} px, {wrong} wrong",
                errors.len(),
                median(&errors)
            );
            assert!(errors.len() * 10 > tried * 6, "{} of {tried}", errors.len());
            assert!(median(&errors) < 0.35, "{}", median(&errors));
            assert!(wrong * 12 <= errors.len(), "{wrong} of {}", errors.len());
        }
    }

    #[test]
    fn what_is_gone_is_not_found() {
        let scene = scene();
        let gone = Pyramid::of(&vidar_core::Image::filled(376, 240, 90), 5);
        let mut tracker = KltTracker::new(KltConfig::default(), MatchingConfig::default());
        for (feature, ..) in scene.features(0) {
            let warp = Warp::shift(feature.pixel + Vector2::new(1.0, 0.0));
            assert!(tracker.track(&scene.pyramid(0), &gone, &feature, &warp, 1.0).is_err());
        }
    }
}
