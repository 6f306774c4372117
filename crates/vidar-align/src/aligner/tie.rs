//! Two chunks tied by the frames both hold.

use super::AlignerConfig;
use super::memory::{Tie, View};
use crate::overlap::{OverlapFit, PointPairs, SampledView, fit_overlap, judge};
use crate::streaming::{
    AlignMethod, IrlsConfig, PointMap, ScaleMethod, align_overlap, depth_scale, fit_irls, unproject,
};
use vidar_core::ViewGeometry;

/// Share of the smaller median that a confidence must exceed (the reference's 0.1).
const CONFIDENCE_SHARE: f32 = 0.1;
/// Pixels of an independent patch: errors of a network are shared within one token.
const PATCH_PIXELS: usize = 14 * 14;

/// The reference's confidence, 0 or more, of a probability: Depth Anything's conversion is `c = 1 − 1/(1 + odds)`.
fn odds(confidence: f32) -> f32 {
    let c = confidence.min(1.0 - 1e-6);
    c / (1.0 - c)
}

fn median(mut values: Vec<f32>) -> f32 {
    let middle = values.len() / 2;
    if values.is_empty() { 0.0 } else { *values.select_nth_unstable_by(middle, f32::total_cmp).1 }
}

/// Views of the same frames, earlier then later chunk.
pub(super) fn shared<'a>(
    earlier: impl Iterator<Item = &'a SampledView> + Clone,
    later: impl Iterator<Item = &'a SampledView>,
) -> Vec<(&'a SampledView, &'a SampledView)> {
    later.filter_map(|l| earlier.clone().find(|e| e.frame_id == l.frame_id).map(|e| (e, l))).collect()
}

/// Pairs of all shared views, `map` applied to confidences, thinned to `max_pairs`.
fn pairs(views: &[(&SampledView, &SampledView)], map: fn(f32) -> f32, max_pairs: usize) -> PointPairs {
    let earlier = median(views.iter().flat_map(|v| v.0.confidences()).collect());
    let later = median(views.iter().flat_map(|v| v.1.confidences()).collect());
    let lower = earlier.min(later);
    // `map` grows, so the threshold on mapped values is one on the values themselves.
    let threshold = CONFIDENCE_SHARE * map(lower);
    let total: usize = views.iter().map(|v| v.0.len()).sum();
    let stride = total.div_ceil(max_pairs.max(1)).max(1);
    let mut found = PointPairs::default();
    for (earlier, later) in views {
        let weigh = |a: f32, b: f32| f64::from((map(a) * map(b)).sqrt());
        earlier.pair_with(later, stride, |c| map(c) > threshold, weigh, &mut found);
    }
    let pixels = views.first().map_or(0, |v| v.0.intrinsics.width * v.0.intrinsics.height);
    found.independent = (pixels / PATCH_PIXELS).max(7);
    found
}

/// VIDAR's own estimate.
pub(super) fn robust(views: &[(&SampledView, &SampledView)], config: &AlignerConfig) -> Option<OverlapFit> {
    let pairs = pairs(views, |c| c, config.overlap.max_pairs);
    fit_overlap(&pairs, &config.overlap).ok()
}

/// The reference's estimate, on the samples.
pub(super) fn reference(
    views: &[(&SampledView, &SampledView)],
    config: &AlignerConfig,
) -> Option<OverlapFit> {
    let mut pairs = pairs(views, odds, config.overlap.max_pairs);
    if pairs.len() < config.overlap.min_pairs.max(3) {
        return None;
    }
    let before = match config.chain {
        AlignMethod::ScaleSe3 => {
            let narrow = |of: &[f64]| of.iter().map(|z| *z as f32).collect::<Vec<f32>>();
            let (earlier, later) = (narrow(&pairs.target_depth), narrow(&pairs.source_depth));
            let weight = narrow(&pairs.weight);
            let found = depth_scale((&earlier, &weight), (&later, &weight), ScaleMethod::Auto, config.compat);
            found.ok()?.scale
        }
        AlignMethod::Sim3 | AlignMethod::Se3 => 1.0,
    };
    pairs.source.iter_mut().for_each(|p| *p *= before);
    let fit = fit_irls(&pairs.source, &pairs.target, &pairs.weight, config.chain, &IrlsConfig::default());
    let mut fit = fit.ok()?.target_from_source;
    pairs.source.iter_mut().for_each(|p| *p /= before);
    fit.scale *= before;
    fit.is_finite().then(|| judge(&pairs, fit))
}

/// The reference's estimate as it is: every pixel, quirks included.
pub(super) fn verbatim(
    views: &[(&ViewGeometry, &ViewGeometry)],
    config: &AlignerConfig,
) -> Option<OverlapFit> {
    let map = |side: Vec<&ViewGeometry>| {
        let mut map = PointMap::default();
        let mut depths: Vec<f32> = Vec::new();
        for v in side {
            let depth = v.depth.image().data();
            map.frame_len = depth.len();
            map.points.extend(unproject(depth, &v.intrinsics, &v.chunk_from_camera));
            map.confidence.extend(v.confidence.image().data().iter().map(|c| odds(*c)));
            depths.extend_from_slice(depth);
        }
        (map, depths)
    };
    let (target, target_depth) = map(views.iter().map(|v| v.0).collect());
    let (source, source_depth) = map(views.iter().map(|v| v.1).collect());
    let before = match config.chain {
        AlignMethod::ScaleSe3 => {
            let found = depth_scale(
                (&target_depth, &target.confidence),
                (&source_depth, &source.confidence),
                ScaleMethod::Auto,
                config.compat,
            );
            found.ok()?.scale
        }
        AlignMethod::Sim3 | AlignMethod::Se3 => 1.0,
    };
    let irls = IrlsConfig { compat: config.compat, ..IrlsConfig::default() };
    let fit = align_overlap(&target, &source, config.chain, before, &irls).ok()?;
    let mut judged = PointPairs::default();
    let stride = target.points.len().div_ceil(config.overlap.max_pairs.max(1)).max(1);
    for i in (0..target.points.len().min(source.points.len())).step_by(stride) {
        let (zt, zs) = (f64::from(target_depth[i]), f64::from(source_depth[i]));
        if zt.is_finite() && zs.is_finite() {
            judged.push(source.points[i], target.points[i], zs, zt, 1.0);
        }
    }
    judged.independent = (target.frame_len / PATCH_PIXELS).max(7);
    Some(judge(&judged, fit.target_from_source))
}

/// Ties by thin samples: a chunk that comes back to frames of an older one.
pub(super) fn revisit(earlier: &[View], later: &[View], to: usize, config: &AlignerConfig) -> Option<Tie> {
    let views = shared(earlier.iter().map(|v| &v.thin), later.iter().map(|v| &v.thin));
    let frames = views.len();
    (frames > 0).then(|| robust(&views, config)).flatten().map(|fit| Tie { to, frames, fit })
}
