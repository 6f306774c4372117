//! The scale of a chunk from landmarks whose metric depth is known.
//!
//! Odometry gives the depth of some points in metres; the model predicts the depth at the same pixels in its own unit. The
//! chunk's scale is the weighted median of `log d − log D` over all of them, which no camera motion makes degenerate: in
//! simulation its error is 0.8 to 0.9 % for any motion, where camera centres need 0.7 m of travel to match it. Its variance
//! is `1.57 σ²/n + s²/f`: σ from the median absolute deviation, n counted per landmark and not per observation
//! (a landmark's error is the same in all views), f views of jitter s each (1.57 = π/2, the price of a median).

use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use vidar_core::camera::Pixel;
use vidar_core::{FrameId, Image, LandmarkId, SparseLandmark, ViewGeometry};
use vidar_solve::statistics::{STD_PER_MAD, weighted_median};

/// How landmarks are compared with predicted depth.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct LandmarkConfig {
    /// Error of predicted depth at one pixel, as a share of it (0.005 to 0.3).
    pub model_noise: f64,
    /// Error that all pixels of one view share, as a share of depth (0 to 0.2).
    pub view_jitter: f64,
    /// Landmarks whose σ of inverse depth exceeds this share of it are not used (0.01 to 1).
    pub max_relative_std: f64,
    /// Fewest landmarks that correct a view's depth; 0 never corrects, else 15 or more.
    pub min_for_field: usize,
}

impl Default for LandmarkConfig {
    fn default() -> Self {
        Self { model_noise: 0.04, view_jitter: 0.015, max_relative_std: 0.25, min_for_field: 15 }
    }
}

/// ln(metres per chunk unit) with its uncertainty.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LogScale {
    /// The estimate.
    pub log_scale: f64,
    /// Standard deviation of it.
    pub std: f64,
    /// Landmarks that count as independent.
    pub effective: f64,
    /// Observations used.
    pub observations: usize,
    /// Standard deviation of an error that the landmarks of the whole run share: no number of them lowers it.
    pub shared_std: f64,
}

/// A point of known metric depth that no track connects to other frames: the surest pixels of multi-view stereo, for example.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthPoint {
    /// Its number, different for all points of a chunk.
    pub number: u32,
    /// Its position in the depth image.
    pub pixel: Pixel,
    /// Inverse of its z-depth, 1/m.
    pub inverse_depth: f64,
    /// Standard deviation of `inverse_depth`.
    pub inverse_depth_std: f64,
}

/// What a depth ratio was measured at.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum RatioSource {
    /// A landmark of the odometry, which several views may observe.
    Landmark(LandmarkId),
    /// A [`DepthPoint`], by its number.
    Point(u32),
}

/// Metric depth of a landmark or point against the depth predicted at its pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthRatio {
    /// In which view.
    pub frame_id: FrameId,
    /// At which landmark or point.
    pub source: RatioSource,
    /// Its pixel in the depth image.
    pub pixel: [f64; 2],
    /// log d − log D.
    pub log_ratio: f64,
    /// Standard deviation of it, from landmark and model.
    pub std: f64,
}

/// Fewest observations and landmarks that determine a scale.
const MIN_OBSERVATIONS: usize = 8;
const MIN_LANDMARKS: usize = 5;
/// Relative range of the 3 × 3 neighbours above which a landmark lies on a depth edge.
const EDGE_RANGE: f32 = 0.08;

/// Landmarks of a view against its depth. Those on depth edges, outside of the image, without depth or uncertain are left out.
pub fn depth_ratios(
    view: &ViewGeometry,
    landmarks: &[SparseLandmark],
    config: &LandmarkConfig,
) -> Vec<DepthRatio> {
    let ratio = |l: &SparseLandmark| {
        let source = RatioSource::Landmark(l.id);
        depth_ratio(view, source, l.pixel, (l.inverse_depth, l.inverse_depth_std), config)
    };
    landmarks.iter().filter_map(ratio).collect()
}

/// The same for points without tracks.
pub fn point_ratios(view: &ViewGeometry, points: &[DepthPoint], config: &LandmarkConfig) -> Vec<DepthRatio> {
    let ratio = |p: &DepthPoint| {
        let source = RatioSource::Point(p.number);
        depth_ratio(view, source, p.pixel, (p.inverse_depth, p.inverse_depth_std), config)
    };
    points.iter().filter_map(ratio).collect()
}

fn depth_ratio(
    view: &ViewGeometry,
    source: RatioSource,
    pixel: Pixel,
    (inverse_depth, inverse_depth_std): (f64, f64),
    config: &LandmarkConfig,
) -> Option<DepthRatio> {
    let relative = inverse_depth_std / inverse_depth;
    let usable = inverse_depth.is_finite() && inverse_depth > 0.0 && relative >= 0.0;
    if !usable || relative > config.max_relative_std {
        return None;
    }
    let predicted = smooth_depth(view.depth.image(), pixel.x, pixel.y)?;
    let ratio = DepthRatio {
        frame_id: view.frame_id,
        source,
        pixel: [pixel.x, pixel.y],
        log_ratio: -inverse_depth.ln() - f64::from(predicted).ln(),
        std: relative.hypot(config.model_noise),
    };
    ratio.log_ratio.is_finite().then_some(ratio)
}

/// Depth at the nearest pixel, unless an edge runs through its neighbourhood.
pub(crate) fn smooth_depth(depth: &Image<f32>, x: f64, y: f64) -> Option<f32> {
    let (x, y) = (x.round(), y.round());
    if !(x >= 0.0 && y >= 0.0) {
        return None;
    }
    let (x, y) = (x as usize, y as usize);
    let z = *depth.get(x, y)?;
    if !z.is_finite() {
        return None;
    }
    let (mut low, mut high) = (z, z);
    for ny in y.saturating_sub(1)..(y + 2).min(depth.height()) {
        for v in &depth.row(ny)[x.saturating_sub(1)..(x + 2).min(depth.width())] {
            low = low.min(*v);
            high = high.max(*v);
        }
    }
    (high - low <= EDGE_RANGE * z).then_some(z)
}

/// The chunk's scale; `None` with too few landmarks.
pub fn landmark_scale(ratios: &[DepthRatio], config: &LandmarkConfig) -> Option<LogScale> {
    let mut seen: BTreeMap<RatioSource, f64> = BTreeMap::new();
    ratios.iter().for_each(|r| *seen.entry(r.source).or_insert(0.0) += 1.0);
    if ratios.len() < MIN_OBSERVATIONS || seen.len() < MIN_LANDMARKS {
        return None;
    }
    // A landmark observed in many views is one landmark.
    let weight = |r: &DepthRatio| 1.0 / (r.std * r.std * seen[&r.source]);
    let weighted: Vec<(f64, f64)> = ratios.iter().map(|r| (r.log_ratio, weight(r))).collect();
    let log_scale = weighted_median(weighted.clone())?;
    let off = weighted.iter().map(|(l, w)| ((l - log_scale).abs(), *w)).collect();
    let sigma = STD_PER_MAD * weighted_median(off)?;
    let mut per_landmark: BTreeMap<RatioSource, f64> = BTreeMap::new();
    ratios.iter().for_each(|r| *per_landmark.entry(r.source).or_insert(0.0) += weight(r));
    let (sum, squares) = per_landmark.values().fold((0.0, 0.0), |(s, q), w| (s + w, q + w * w));
    let effective = sum * sum / squares;
    let views = ratios.iter().map(|r| r.frame_id).collect::<BTreeSet<_>>().len() as f64;
    let variance = std::f64::consts::FRAC_PI_2 * sigma * sigma / effective
        + config.view_jitter * config.view_jitter / views;
    // Perfect agreement of a few is no evidence below the resolution of the depths.
    let std = variance.sqrt().max(1e-3);
    Some(LogScale { log_scale, std, effective, observations: ratios.len(), shared_std: 0.0 })
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector2;
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::{RngCore, SeedableRng};
    use vidar_core::{Confidence, Pinhole, RelativeDepth, Se3};

    fn normal(rng: &mut ChaCha8Rng) -> f64 {
        let uniform = |r: &mut ChaCha8Rng| (r.next_u64() >> 11) as f64 / (1u64 << 53) as f64;
        let radius = (-2.0 * (1.0 - uniform(rng)).ln()).sqrt();
        radius * (std::f64::consts::TAU * uniform(rng)).cos()
    }

    /// 120 observations of 60 landmarks in 12 views: 4 % noise each side, 1.5 % per view, 12 % gross.
    fn ratios(seed: u64, truth: f64) -> Vec<DepthRatio> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let own: Vec<f64> = (0..60).map(|_| 0.04 * normal(&mut rng)).collect();
        let view: Vec<f64> = (0..12).map(|_| 0.015 * normal(&mut rng)).collect();
        (0..120)
            .map(|k| {
                let gross = if k % 8 == 0 { 0.6 * normal(&mut rng) } else { 0.0 };
                DepthRatio {
                    frame_id: FrameId(k % 12),
                    source: RatioSource::Landmark(LandmarkId(k % 60)),
                    pixel: [0.0, 0.0],
                    log_ratio: truth
                        + own[(k % 60) as usize]
                        + view[(k % 12) as usize]
                        + 0.04 * normal(&mut rng)
                        + gross,
                    std: 0.056,
                }
            })
            .collect()
    }

    #[test]
    fn the_scale_is_measured_to_about_a_percent_and_its_uncertainty_is_consistent() {
        let config = LandmarkConfig::default();
        let trials = 400;
        let (mut squares, mut chi2) = (0.0, 0.0);
        for seed in 0..trials {
            let found = landmark_scale(&ratios(seed, 0.7), &config).unwrap();
            let error = found.log_scale - 0.7;
            squares += error * error;
            chi2 += (error / found.std).powi(2);
        }
        let rms = (squares / trials as f64).sqrt();
        let chi2 = chi2 / trials as f64;
        assert!(rms < 0.0125, "{rms}");
        assert!(chi2 > 0.4 && chi2 < 1.6, "{chi2}");
    }

    #[test]
    fn one_landmark_observed_often_counts_as_one_landmark() {
        let mut many = ratios(3, 0.0);
        let once = landmark_scale(&many, &LandmarkConfig::default()).unwrap();
        for _ in 0..200 {
            many.push(DepthRatio { source: RatioSource::Landmark(LandmarkId(5)), log_ratio: 3.0, ..many[5] });
        }
        let often = landmark_scale(&many, &LandmarkConfig::default()).unwrap();
        assert!((often.log_scale - once.log_scale).abs() < 0.02);
        assert!(often.effective < 1.05 * once.effective);
        many.truncate(4);
        assert!(landmark_scale(&many, &LandmarkConfig::default()).is_none());
    }

    #[test]
    fn landmarks_on_edges_outside_or_uncertain_are_left_out() {
        let depth = Image::from_fn(40, 30, |x, y| match (x < 20, y) {
            (_, 25..) => f32::NAN,
            (true, _) => 2.0,
            (false, _) => 4.0,
        });
        let view = ViewGeometry {
            frame_id: FrameId(1),
            chunk_from_camera: Se3::IDENTITY,
            intrinsics: Pinhole::new(30.0, 30.0, 19.5, 14.5, 40, 30).unwrap(),
            depth: RelativeDepth::new(depth),
            confidence: Confidence::full(40, 30),
        };
        let at = |x: f64, y: f64, std: f64| SparseLandmark {
            id: LandmarkId(0),
            pixel: Vector2::new(x, y),
            inverse_depth: 0.25,
            inverse_depth_std: std,
        };
        let all = [
            at(5.2, 5.0, 0.01),
            at(20.0, 5.0, 0.01),
            at(5.0, 27.0, 0.01),
            at(-3.0, 5.0, 0.01),
            at(5.0, 5.0, 0.2),
            at(5.0, f64::NAN, 0.01),
            at(80.0, 5.0, 0.01),
        ];
        let kept = depth_ratios(&view, &all, &LandmarkConfig::default());
        assert_eq!(kept.len(), 1);
        assert!((kept[0].log_ratio - 2.0_f64.ln()).abs() < 1e-12);
    }

    #[test]
    fn points_and_landmarks_of_the_same_number_are_different_and_both_determine_the_scale() {
        let view = ViewGeometry {
            frame_id: FrameId(1),
            chunk_from_camera: Se3::IDENTITY,
            intrinsics: Pinhole::new(30.0, 30.0, 19.5, 14.5, 40, 30).unwrap(),
            depth: RelativeDepth::new(Image::filled(40, 30, 2.0)),
            confidence: Confidence::full(40, 30),
        };
        let config = LandmarkConfig::default();
        let pixel = |k: u32| Pixel::new(f64::from(3 * k + 2), 7.0);
        let (inverse_depth, inverse_depth_std) = (0.25, 0.005);
        let landmarks: Vec<SparseLandmark> = (0..10)
            .map(|k| SparseLandmark { id: LandmarkId(k), pixel: pixel(k), inverse_depth, inverse_depth_std })
            .collect();
        let points: Vec<DepthPoint> = (0..10)
            .map(|number| DepthPoint { number, pixel: pixel(number), inverse_depth, inverse_depth_std })
            .collect();
        let mut all = depth_ratios(&view, &landmarks, &config);
        all.extend(point_ratios(&view, &points, &config));
        let found = landmark_scale(&all, &config).unwrap();
        assert!((found.log_scale - 2.0_f64.ln()).abs() < 1e-12 && found.observations == 20);
        assert!((found.effective - 20.0).abs() < 1e-9, "{found:?}");
    }
}
