//! Overlap constraints: two chunks and the frames that both hold.

use super::chunk::{Chunk, OverlapConstraint, View};
use super::config::AlignerConfig;
use super::history::{History, NEIGHBOURS};
use crate::overlap::{
    OverlapFit, SampledView, evaluate_fit, fit_overlap, pair_mapped, pair_views, shared_views,
};
use crate::streaming::{AlignMethod, IrlsConfig, ScaleMethod, StreamingError, depth_scale, fit_irls};

/// The reference's confidence, 0 or more, of a probability: Depth Anything's conversion is `c = 1 − 1/(1 + odds)`.
pub(super) fn odds(confidence: f32) -> f32 {
    let c = confidence.min(1.0 - 1e-6);
    c / (1.0 - c)
}

/// VIDAR's own estimate ([`crate::overlap`]).
///
/// # Errors
/// Those of [`fit_overlap`].
pub(super) fn fit_robust(
    views: &[(&SampledView, &SampledView)],
    config: &AlignerConfig,
) -> Result<OverlapFit, StreamingError> {
    fit_overlap(&pair_views(views, config.overlap.max_pairs), &config.overlap)
}

/// The reference's estimate, on samples instead of all pixels.
pub(super) fn fit_reference(
    views: &[(&SampledView, &SampledView)],
    config: &AlignerConfig,
) -> Option<OverlapFit> {
    let mut pairs = pair_mapped(views, odds, config.overlap.max_pairs);
    if pairs.len() < config.overlap.min_pairs.max(3) {
        return None;
    }
    let source_scale = match config.chain {
        AlignMethod::ScaleSe3 => {
            let narrow = |of: &[f64]| of.iter().map(|z| *z as f32).collect::<Vec<f32>>();
            let (earlier, later) = (narrow(&pairs.target_depth), narrow(&pairs.source_depth));
            let weight = narrow(&pairs.weight);
            let found = depth_scale((&earlier, &weight), (&later, &weight), ScaleMethod::Auto, config.compat);
            found.ok()?.scale
        }
        AlignMethod::Sim3 | AlignMethod::Se3 => 1.0,
    };
    pairs.source.iter_mut().for_each(|p| *p *= source_scale);
    let fit = fit_irls(&pairs.source, &pairs.target, &pairs.weight, config.chain, &IrlsConfig::default());
    let mut fit = fit.ok()?.target_from_source;
    pairs.source.iter_mut().for_each(|p| *p /= source_scale);
    fit.scale *= source_scale;
    fit.is_finite().then(|| evaluate_fit(&pairs, fit))
}

/// Constraints of a new chunk to older ones, but for its neighbours, whose overlaps connect them already.
pub(super) fn revisits(history: &History, chunk: &Chunk) -> Vec<OverlapConstraint> {
    let distant = history.chunks.len().saturating_sub(NEIGHBOURS - 1);
    let before = chunk.overlap.as_ref().map(|o| o.earlier);
    let older = history.chunks.iter().take(distant).enumerate();
    let older = older.filter(|(k, c)| Some(*k) != before && c.is_usable());
    older
        .filter_map(|(k, c)| by_sparse_samples(&c.views, &chunk.views, k, &history.config))
        .filter(|o| o.fit.inlier_ratio > history.config.loops.min_inlier_ratio)
        .collect()
}

fn by_sparse_samples(
    earlier_views: &[View],
    later_views: &[View],
    earlier: usize,
    config: &AlignerConfig,
) -> Option<OverlapConstraint> {
    let views =
        shared_views(earlier_views.iter().map(|v| &v.samples), later_views.iter().map(|v| &v.samples));
    let frames = views.len();
    if frames == 0 {
        return None;
    }
    // Frames that came back but do not agree constrain nothing.
    fit_robust(&views, config).ok().map(|fit| OverlapConstraint { earlier, frames, fit })
}
