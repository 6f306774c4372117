//! The map of another recording of the same place: looking for oneself in it, and leaving one.

use super::Odometry;
use super::joined_segments::KeyframeSearch;
use super::relocalization::{MATCH_SIGMA_PX, MAX_SCALE_DIFFERENCE};
use crate::bundle_adjustment::Adjusted;
use crate::pipeline::output::Joined;
use crate::relocalization::{MapKeyframe, MapPoint, Place, SavedMap, consensus};
use nalgebra::Vector3;
use std::collections::BTreeMap;
use std::sync::Arc;
use vidar_core::camera::Pixel;
use vidar_core::{FrameId, OdometryKeyframe, SparseLandmark};

/// Own keyframes that are looked for in the map after the end: each takes some 50 ms.
const MAX_QUERIES: usize = 60;

/// A landmark of the adjustment is a point of the keyframe in this direction, rad: the live estimates of both were a pixel or two apart.
const SAME_DIRECTION_RAD: f64 = 0.01;

/// Fewest points of a keyframe whose distances the adjustment has.
const MIN_DISTANCES: usize = 8;

impl Odometry {
    /// An odometry that looks for itself in the map of another recording of the place. Once it is found there, its poses are in the
    /// world of the map, which is [`SavedMap::SEGMENT`].
    #[must_use]
    pub fn with_map(mut self, map: &SavedMap) -> Self {
        self.relocalizer.map = map.as_segment(SavedMap::SEGMENT);
        (self.segment, self.next_segment) = (SavedMap::SEGMENT + 1, SavedMap::SEGMENT + 2);
        self
    }

    /// Where the adjusted states lie in the map that was given: as most of the keyframes say. `None` where two do not say the same.
    pub fn place_in_map(&self, adjusted: &Adjusted) -> Option<Joined> {
        let keyframes = self.relocalizer.map.keyframes();
        let map: Vec<_> = keyframes.iter().filter(|k| k.own.is_none()).cloned().collect();
        if map.is_empty() {
            return None;
        }
        let own = adjusted_keyframes(keyframes, adjusted);
        let ray_sigma_rad = MATCH_SIGMA_PX / self.camera.model.intrinsics().fx;
        // Nowhere yet: found live, it is of the map's segment.
        let search =
            KeyframeSearch { segment: u32::MAX, ray_sigma_rad, max_scale_difference: MAX_SCALE_DIFFERENCE };
        let stride = own.len().div_ceil(MAX_QUERIES).max(1);
        // What is found becomes no observation: the map is not adjusted.
        let nowhere = |_: &MapPoint| Some(Pixel::zeros());
        let found: Vec<_> = (own.iter().step_by(stride))
            .filter_map(|keyframe| search.find(keyframe, nowhere, &map))
            .collect();
        let Place { map_from_own, inliers, .. } = consensus(&found, false)?;
        Some(Joined {
            segment: adjusted.segment,
            into: SavedMap::SEGMENT,
            into_from_segment: map_from_own,
            matches: inliers,
        })
    }

    /// Keyframes of one world, for [`Odometry::with_map`] of another recording: those that were adjusted, or of the segment with the most; and
    /// those of the map in which this recording was found.
    pub fn saved_map(&self, adjusted: Option<&Adjusted>) -> SavedMap {
        let keyframes = self.relocalizer.map.keyframes();
        let Some(adjusted) = adjusted else {
            let mut counts: BTreeMap<u32, usize> = BTreeMap::new();
            for keyframe in keyframes.iter().filter(|k| k.own.is_some()) {
                *counts.entry(keyframe.segment).or_default() += 1;
            }
            let most = counts.iter().max_by_key(|(segment, n)| (**n, std::cmp::Reverse(**segment)));
            let of_most = keyframes.iter().filter(|k| most.is_some_and(|(most, _)| k.segment == *most));
            return SavedMap::new(of_most.map(AsRef::as_ref));
        };
        let own = adjusted_keyframes(keyframes, adjusted);
        let is_in_map = adjusted.segment == SavedMap::SEGMENT;
        let earlier = keyframes.iter().filter(|k| k.own.is_none() && is_in_map);
        SavedMap::new(earlier.map(AsRef::as_ref).chain(&own))
    }
}

/// The own keyframes with the poses and distances of the adjustment; those are left out that it does not have.
fn adjusted_keyframes(keyframes: &[Arc<MapKeyframe>], adjusted: &Adjusted) -> Vec<MapKeyframe> {
    let by_frame: BTreeMap<FrameId, &OdometryKeyframe> =
        adjusted.keyframes.iter().map(|k| (k.frame_id, k)).collect();
    let camera = &adjusted.calibration.camera;
    let found = keyframes.iter().filter_map(|keyframe| {
        let place = by_frame.get(&keyframe.own?.1)?;
        let in_camera = |l: &SparseLandmark| {
            let ray = camera.unproject(&l.pixel)?;
            (ray.z > 0.0 && l.inverse_depth > 0.0).then(|| ray / (ray.z * l.inverse_depth))
        };
        let landmarks: Vec<Vector3<f64>> = place.landmarks.iter().filter_map(in_camera).collect();
        Some(MapKeyframe {
            segment: adjusted.segment,
            world_from_camera: place.world_from_camera,
            points: with_distances(&keyframe.points, &landmarks)?,
            ..keyframe.as_ref().clone()
        })
    });
    found.collect()
}

/// Points at the distances of the landmarks in the same directions; where there is none, the distance changes as in the median of the others.
fn with_distances(points: &[MapPoint], landmarks: &[Vector3<f64>]) -> Option<Vec<MapPoint>> {
    let ratio = |point: &MapPoint| {
        let ray = point.in_camera.normalize();
        let apart = |l: &Vector3<f64>| (l.normalize() - ray).norm();
        let nearest = landmarks.iter().min_by(|a, b| apart(a).total_cmp(&apart(b)))?;
        (apart(nearest) <= SAME_DIRECTION_RAD).then(|| nearest.norm() / point.in_camera.norm())
    };
    let ratios: Vec<Option<f64>> = points.iter().map(ratio).collect();
    let mut known: Vec<f64> = ratios.iter().flatten().copied().collect();
    if known.len() < MIN_DISTANCES {
        return None;
    }
    let median = vidar_solve::statistics::median(&mut known)?;
    let scaled = |(point, ratio): (&MapPoint, &Option<f64>)| MapPoint {
        in_camera: point.in_camera * ratio.unwrap_or(median),
        ..point.clone()
    };
    Some(points.iter().zip(&ratios).map(scaled).collect())
}
