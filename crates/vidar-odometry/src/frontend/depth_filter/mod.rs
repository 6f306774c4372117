//! Depth of features that are seen from more and more aside.
//!
//! A seed holds a belief of its inverse distance: a Gaussian mixed with a uniform share of wrong matches (Vogiatzis &
//! Hernández, "Video-based, real-time multi-view stereo", 2011). Each image is searched along the piece of the epipolar curve
//! that the belief allows; what is found there updates the belief with the variance that the alignment gives.

#[cfg(test)]
mod tests;

use super::config::{DepthFilterConfig, MatchingConfig};
use super::feature::{Feature, PixelMeasurement};
use super::feature_alignment::{MatchFailure, align_feature, correlation};
use super::pyramid::{Pyramid, level_scale, to_level};
use super::template::{SIDE, Template, Warp};
use nalgebra::Vector2;
use vidar_core::camera::Pixel;
use vidar_core::{CameraModel, Se3};

/// What is believed of a feature's inverse distance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Seed {
    /// Mean inverse distance along the bearing, 1/m.
    pub mean: f64,
    /// Its variance, 1/m².
    pub variance: f64,
    /// Pseudo-count of good measurements.
    pub good: f64,
    /// Pseudo-count of wrong ones.
    pub bad: f64,
    /// Width of the interval in which wrong measurements lie, 1/m.
    pub range: f64,
}

impl Seed {
    /// A seed about which only the scene is known: its typical and its nearest distance, metres.
    pub fn new(typical_m: f64, nearest_m: f64) -> Self {
        // Half the nearest distance is still possible; ±3σ cover everything from there to infinity.
        let range = 1.0 / (0.5 * nearest_m.max(1e-3));
        Self { mean: 1.0 / typical_m.max(1e-3), variance: range * range / 36.0, good: 10.0, bad: 10.0, range }
    }

    /// Share of measurements that are good, as far as is known.
    pub fn inlier_ratio(&self) -> f64 {
        self.good / (self.good + self.bad)
    }

    /// Standard deviation over the mean.
    pub fn relative_sigma(&self) -> f64 {
        self.variance.sqrt() / self.mean.max(1e-9)
    }

    /// Takes a measured inverse distance with its variance into the belief (Vogiatzis & Hernández 2011, eq. 17-26).
    pub fn fuse(&mut self, measured: f64, variance: f64) {
        let (a, b) = (self.good, self.bad);
        let total = self.variance + variance;
        let deviation = measured - self.mean;
        let likelihood =
            (-0.5 * deviation * deviation / total).exp() / (std::f64::consts::TAU * total).sqrt();
        let (c1, c2) = (a / (a + b) * likelihood, b / (a + b) / self.range);
        let norm = c1 + c2;
        if !(norm > 0.0 && norm.is_finite()) {
            return;
        }
        let (c1, c2) = (c1 / norm, c2 / norm);
        let s2 = 1.0 / (1.0 / self.variance + 1.0 / variance);
        let m = s2 * (self.mean / self.variance + measured / variance);
        let n = a + b;
        let f = c1 * (a + 1.0) / (n + 1.0) + c2 * a / (n + 1.0);
        let e = c1 * (a + 1.0) * (a + 2.0) / ((n + 1.0) * (n + 2.0))
            + c2 * a * (a + 1.0) / ((n + 1.0) * (n + 2.0));
        let mean = c1 * m + c2 * self.mean;
        let updated = c1 * (s2 + m * m) + c2 * (self.variance + self.mean * self.mean) - mean * mean;
        // Rounding can leave nothing of a difference of squares; the sharper of the two beliefs bounds it.
        self.variance = updated.max(s2 * 0.5);
        self.mean = mean.max(0.0);
        let good = (e - f) / (f - e / f);
        if good.is_finite() && good > 0.0 {
            self.good = good;
            self.bad = good * (1.0 - f) / f;
        }
    }

    /// Counts an image in which nothing was found although it should have been.
    pub fn miss(&mut self) {
        self.bad += 1.0;
    }
}

/// What an image said about a seed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SeedOutcome {
    /// It was found and the belief updated.
    Updated(SeedMeasurement),
    /// It is not in view, or the motion says nothing about it; the belief stays.
    Skipped,
    /// It should have been found and was not; the belief counts a miss.
    Missed(MatchFailure),
}

/// A seed found in an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SeedMeasurement {
    /// Where.
    pub measurement: PixelMeasurement,
    /// Inverse distance that this position alone gives, 1/m.
    pub inverse_distance: f64,
    /// Its standard deviation, 1/m.
    pub sigma: f64,
    /// Length of the piece of the epipolar curve that was searched, level-0 pixels.
    pub searched_px: f64,
}

/// Searches for seeds; holds the buffer of one patch.
#[derive(Clone, Debug)]
pub struct DepthFilter {
    config: DepthFilterConfig,
    matching: MatchingConfig,
    template: Template,
}

/// A piece of an epipolar curve.
struct Segment {
    near: f64,
    far: f64,
    near_px: Pixel,
    far_px: Pixel,
}

impl DepthFilter {
    /// A filter that aligns as `matching` says.
    pub fn new(config: DepthFilterConfig, matching: MatchingConfig) -> Self {
        Self { config, matching, template: Template::empty() }
    }

    /// Whether a seed is known well enough to become a landmark.
    pub fn is_converged(&self, seed: &Seed) -> bool {
        seed.relative_sigma() < self.config.converged_relative_sigma
            && seed.inlier_ratio() > self.config.min_inlier_ratio
    }

    /// Whether a seed is mostly matched wrongly and should be dropped.
    pub fn is_hopeless(&self, seed: &Seed) -> bool {
        seed.inlier_ratio() < self.config.hopeless_inlier_ratio || !seed.variance.is_finite()
    }

    /// Looks for `feature` of `keyframe` in `current` and updates `seed`.
    #[allow(clippy::too_many_arguments)] // Two images, what relates them and what is looked for; a struct would only rename them.
    pub fn update(
        &mut self,
        seed: &mut Seed,
        camera: &CameraModel,
        feature: &Feature,
        keyframe: &Pyramid,
        current: &Pyramid,
        current_from_keyframe: &Se3,
        noise_gray: f64,
    ) -> SeedOutcome {
        let Some(warp) = Warp::new(camera, feature, seed.mean, current_from_keyframe) else {
            return SeedOutcome::Skipped;
        };
        if !camera.contains(&warp.pixel, self.config.border_px) {
            return SeedOutcome::Skipped;
        }
        let Some(segment) = self.segment(seed, camera, feature, current_from_keyframe) else {
            return SeedOutcome::Skipped;
        };
        let along = segment.far_px - segment.near_px;
        let searched_px = along.norm();
        if !self.template.fill(keyframe, feature, &warp) {
            return SeedOutcome::Skipped;
        }
        if let (Some(n), Some(direction)) = (self.template.normal, along.try_normalize(1e-9))
            && n.dot(&direction).abs() < MIN_EDGE_COSINE
        {
            // Along the edge everything looks the same.
            return SeedOutcome::Skipped;
        }
        let scale = level_scale(self.template.level);
        let start = if searched_px <= DIRECT_PX * scale {
            Ok(warp.pixel)
        } else {
            self.scan(camera, feature, &segment, current, current_from_keyframe, searched_px)
        };
        let found = start
            .and_then(|start| align_feature(&self.template, current, &start, noise_gray, &self.matching));
        let measured = found.and_then(|f| {
            self.locate(camera, feature, seed.mean, current_from_keyframe, f.measurement, searched_px)
        });
        match measured {
            Ok(m) => {
                seed.fuse(m.inverse_distance, m.sigma * m.sigma);
                SeedOutcome::Updated(m)
            }
            Err(MatchFailure::OutsideImage) => SeedOutcome::Skipped,
            Err(failure) => {
                seed.miss();
                SeedOutcome::Missed(failure)
            }
        }
    }

    /// The belief's interval on the epipolar curve; `None` when an end cannot be seen at all.
    fn segment(
        &self,
        seed: &Seed,
        camera: &CameraModel,
        feature: &Feature,
        current_from_keyframe: &Se3,
    ) -> Option<Segment> {
        let reach = self.config.search_sigmas * seed.variance.sqrt();
        let project = |inverse: f64| {
            let p = current_from_keyframe.rotation * feature.bearing
                + current_from_keyframe.translation * inverse;
            camera.project(&p)
        };
        let far = (seed.mean - reach).max(0.0);
        let mut near = seed.mean + reach;
        let far_px = project(far)?;
        // The near end may lie behind the camera; half of what is left of the interval then.
        for _ in 0..6 {
            if let Some(near_px) = project(near) {
                return Some(Segment { near, far, near_px, far_px });
            }
            near = 0.5 * (near + seed.mean);
        }
        None
    }

    /// The best of places along the curve by correlation, unless another far from it is nearly as good.
    fn scan(
        &self,
        camera: &CameraModel,
        feature: &Feature,
        segment: &Segment,
        current: &Pyramid,
        current_from_keyframe: &Se3,
        length_px: f64,
    ) -> Result<Pixel, MatchFailure> {
        let level = self.template.level;
        let wanted = (length_px / level_scale(level) / STEP_PX).ceil() as usize;
        let steps = wanted.clamp(1, self.config.max_steps);
        let mut best = (-1.0, Pixel::zeros());
        let mut rival = -1.0_f64;
        let (mut last_best, mut inside) = (None::<usize>, 0);
        let (mut last_corner, half) = ([usize::MAX; 2], 0.5 * (SIDE as f64 - 1.0));
        for k in 0..=steps {
            // Places even in the image are even in inverse distance wherever the segment is short.
            let share = k as f64 / steps as f64;
            let inverse = segment.far + share * (segment.near - segment.far);
            let scaled = current_from_keyframe.rotation * feature.bearing
                + current_from_keyframe.translation * inverse;
            let Some(pixel) = camera.project(&scaled) else { continue };
            let corner = to_level(&pixel, level).map(|c| (c - half).round());
            if !(corner.x >= 0.0 && corner.y >= 0.0) {
                continue;
            }
            let corner = [corner.x as usize, corner.y as usize];
            if corner == last_corner {
                continue;
            }
            last_corner = corner;
            let Some(ncc) = correlation(&self.template, current, corner) else { continue };
            inside += 1;
            if ncc > best.0 {
                // The one before becomes a rival if it is not a neighbour.
                if last_best.is_none_or(|b| k - b > NEIGHBOUR_STEPS) {
                    rival = rival.max(best.0);
                }
                (best, last_best) = ((ncc, pixel), Some(k));
            } else if last_best.is_none_or(|b| k - b > NEIGHBOUR_STEPS) {
                rival = rival.max(ncc);
            }
        }
        if inside == 0 {
            return Err(MatchFailure::OutsideImage);
        }
        if best.0 < self.config.min_scan_ncc || (1.0 - best.0) > self.config.second_best_ratio * (1.0 - rival)
        {
            return Err(MatchFailure::Dissimilar);
        }
        Ok(best.1)
    }

    /// The inverse distance that a position says: Gauss-Newton on one unknown, weighted as the alignment measured.
    fn locate(
        &self,
        camera: &CameraModel,
        feature: &Feature,
        start: f64,
        current_from_keyframe: &Se3,
        measurement: PixelMeasurement,
        searched_px: f64,
    ) -> Result<SeedMeasurement, MatchFailure> {
        let sigma = self.config.motion_sigma_px;
        let covariance = measurement.covariance() + nalgebra::Matrix2::identity() * (sigma * sigma);
        let information = covariance.try_inverse().ok_or(MatchFailure::NoTexture)?;
        let mut inverse = start;
        let (mut strength, mut left) = (0.0, Vector2::zeros());
        for _ in 0..4 {
            let scaled = current_from_keyframe.rotation * feature.bearing
                + current_from_keyframe.translation * inverse;
            let (pixel, d_pixel_d_point) =
                camera.project_with_jacobian(&scaled).ok_or(MatchFailure::NotVisible)?;
            let slope = d_pixel_d_point * current_from_keyframe.translation;
            left = measurement.pixel - pixel;
            strength = slope.dot(&(information * slope));
            if !(strength > 0.0) {
                break;
            }
            let step = slope.dot(&(information * left)) / strength;
            // Not more than half way to the camera or past infinity in one step.
            inverse += step.clamp(-0.5 * inverse.max(1e-3), inverse.max(1e-3));
        }
        // What is left lies across the curve: too much of it is a wrong match.
        if left.dot(&(information * left)) > OFF_CURVE_CHI2 {
            return Err(MatchFailure::Diverged);
        }
        // Without parallax the position says nothing; a large deviation says so.
        let sigma = if strength > 1e-12 { (1.0 / strength).sqrt() } else { 1e6 };
        Ok(SeedMeasurement { measurement, inverse_distance: inverse, sigma, searched_px })
    }
}

/// Shortest segment that is scanned, pixels of the search level; alignment alone reaches as far.
const DIRECT_PX: f64 = 2.0;

/// Step of the scan, pixels of the search level: less than a whole pixel, so that none is stepped over.
const STEP_PX: f64 = 0.7;

/// Steps within which two good places are the same peak: two pixels.
const NEIGHBOUR_STEPS: usize = 3;

/// Least cosine between an edge's normal and the epipolar curve (Forster 2017).
const MIN_EDGE_COSINE: f64 = 0.7;

/// χ² of one degree of freedom at 99.9 %.
const OFF_CURVE_CHI2: f64 = 10.8;
