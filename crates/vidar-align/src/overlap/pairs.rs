//! Sampled views of the same frames into point pairs.

use super::{PointPairs, SampledView};
use vidar_solve::statistics::median_upper;

/// Share of the smaller median that a confidence must exceed (the reference's 0.1).
const CONFIDENCE_SHARE: f32 = 0.1;
/// Pixels of an independent patch: errors of a network are shared within one token.
pub(crate) const PATCH_PIXELS: usize = 14 * 14;

/// Views of the same frames, (earlier, later) of two chunks.
pub fn shared_views<'a>(
    earlier: impl Iterator<Item = &'a SampledView> + Clone,
    later: impl Iterator<Item = &'a SampledView>,
) -> Vec<(&'a SampledView, &'a SampledView)> {
    later.filter_map(|l| earlier.clone().find(|e| e.frame_id == l.frame_id).map(|e| (e, l))).collect()
}

/// Pairs "later chunk (source), earlier chunk (target)" of all shared views, thinned evenly to about `max_pairs`.
///
/// A sample takes part when both confidences exceed a tenth of the smaller of the two medians; it weighs their geometric
/// mean.
pub fn pair_views(views: &[(&SampledView, &SampledView)], max_pairs: usize) -> PointPairs {
    pair_mapped(views, |c| c, max_pairs)
}

/// The same with confidences mapped by a growing function first.
pub(crate) fn pair_mapped(
    views: &[(&SampledView, &SampledView)],
    map: fn(f32) -> f32,
    max_pairs: usize,
) -> PointPairs {
    let earlier = median(views.iter().flat_map(|v| v.0.confidences()).collect());
    let later = median(views.iter().flat_map(|v| v.1.confidences()).collect());
    // `map` grows, so the median of mapped values is the mapped median.
    let threshold = CONFIDENCE_SHARE * map(earlier.min(later));
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

fn median(mut values: Vec<f32>) -> f32 {
    median_upper(&mut values).unwrap_or(0.0)
}
