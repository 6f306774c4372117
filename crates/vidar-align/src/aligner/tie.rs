//! Two chunks tied by the frames both hold.

use super::AlignerConfig;
use super::memory::{OverlapConstraint, View};
use crate::overlap::{
    OverlapFit, PATCH_PIXELS, PointPairs, SampledView, fit_overlap, judge, pair_mapped, pair_views,
    shared_views,
};
use crate::streaming::{
    AlignMethod, IrlsConfig, PointMap, ScaleMethod, align_overlap, depth_scale, fit_irls, unproject,
};
use vidar_core::ViewGeometry;

/// The reference's confidence, 0 or more, of a probability: Depth Anything's conversion is `c = 1 − 1/(1 + odds)`.
fn odds(confidence: f32) -> f32 {
    let c = confidence.min(1.0 - 1e-6);
    c / (1.0 - c)
}

/// VIDAR's own estimate.
pub(super) fn robust(views: &[(&SampledView, &SampledView)], config: &AlignerConfig) -> Option<OverlapFit> {
    let pairs = pair_views(views, config.overlap.max_pairs);
    fit_overlap(&pairs, &config.overlap).ok()
}

/// The reference's estimate, on the samples.
pub(super) fn reference(
    views: &[(&SampledView, &SampledView)],
    config: &AlignerConfig,
) -> Option<OverlapFit> {
    let mut pairs = pair_mapped(views, odds, config.overlap.max_pairs);
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
pub(super) fn revisit(
    earlier: &[View],
    later: &[View],
    to: usize,
    config: &AlignerConfig,
) -> Option<OverlapConstraint> {
    let views = shared_views(earlier.iter().map(|v| &v.thin), later.iter().map(|v| &v.thin));
    let frames = views.len();
    (frames > 0).then(|| robust(&views, config)).flatten().map(|fit| OverlapConstraint { to, frames, fit })
}
