//! Which keyframes of the map show what a query shows.

use super::map::{MapKeyframe, MapPoint};
use super::{Query, QueryFeature};
use crate::bundle_adjustment::TrackKey;
use nalgebra::Vector3;
use std::sync::Arc;
use vidar_core::LieGroup;

/// Comparisons that may differ between two views of a patch, of 256, and the largest share of the second best's: corners of
/// other places differ in about half.
const MAX_DISTANCE: u32 = 70;
const MAX_SHARE_OF_SECOND: f64 = 0.85;

/// Fewest matches of a keyframe, and keyframes whose points are taken together.
const MIN_MATCHES: usize = 8;
const KEYFRAMES: usize = 5;

/// Keyframes that are compared: beyond it every second, third and so on.
const MAX_COMPARED: usize = 400;

/// A feature of the query and a landmark of the map.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pair {
    pub feature: usize,
    pub key: Option<TrackKey>,
    /// In the world of the segment, m.
    pub point: Vector3<f64>,
}

/// What the best keyframes of one segment show.
#[derive(Debug)]
pub(super) struct Best {
    pub segment: u32,
    pub pairs: Vec<Pair>,
    /// Features of the query that were matched.
    pub features: usize,
}

/// The keyframes of other segments that share most with the query.
pub(super) fn best_keyframes(query: &Query, map: &[Arc<MapKeyframe>]) -> Option<Best> {
    let others: Vec<&MapKeyframe> =
        map.iter().map(Arc::as_ref).filter(|k| k.segment != query.segment).collect();
    let stride = others.len().div_ceil(MAX_COMPARED).max(1);
    let mut matched: Vec<(&MapKeyframe, Vec<(usize, usize)>)> = (others.iter().step_by(stride))
        .map(|keyframe| (*keyframe, mutual(&query.features, &keyframe.points)))
        .filter(|(_, pairs)| pairs.len() >= MIN_MATCHES)
        .collect();
    // The sort is stable: of equal ones the earlier.
    matched.sort_by_key(|(_, pairs)| std::cmp::Reverse(pairs.len()));
    let segment = matched.first()?.0.segment;
    let mut pairs = Vec::new();
    for (keyframe, found) in matched.iter().filter(|(k, _)| k.segment == segment).take(KEYFRAMES) {
        pairs.extend(found.iter().map(|(feature, point)| {
            let MapPoint { key, in_camera, .. } = &keyframe.points[*point];
            let point = keyframe.world_from_camera.act(in_camera);
            Pair { feature: *feature, key: *key, point }
        }));
    }
    let mut features: Vec<usize> = pairs.iter().map(|p| p.feature).collect();
    features.sort_unstable();
    features.dedup();
    Some(Best { segment, pairs, features: features.len() })
}

/// Features and points that are each other's best, and clearly so.
fn mutual(features: &[QueryFeature], points: &[MapPoint]) -> Vec<(usize, usize)> {
    let mut best_of_point: Vec<(u32, usize)> = vec![(u32::MAX, usize::MAX); points.len()];
    let mut best_of_feature: Vec<Option<usize>> = vec![None; features.len()];
    for (s, feature) in features.iter().enumerate() {
        let (mut first, mut second, mut at) = (u32::MAX, u32::MAX, 0);
        for (p, point) in points.iter().enumerate() {
            let Some(distance) = feature.descriptors.iter().map(|d| d.distance(&point.descriptor)).min()
            else {
                break;
            };
            if distance < first {
                (second, first, at) = (first, distance, p);
            } else if distance < second {
                second = distance;
            }
            if distance < best_of_point[p].0 {
                best_of_point[p] = (distance, s);
            }
        }
        let is_clear = f64::from(first) < MAX_SHARE_OF_SECOND * f64::from(second);
        best_of_feature[s] = (first <= MAX_DISTANCE && is_clear).then_some(at);
    }
    let is_mutual = |(s, p): &(usize, usize)| best_of_point[*p].1 == *s;
    let chosen = best_of_feature.iter().enumerate().filter_map(|(s, p)| Some((s, (*p)?)));
    chosen.filter(is_mutual).collect()
}
