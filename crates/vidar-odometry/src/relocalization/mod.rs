//! Relocalisation: where a camera is in a map of earlier keyframes, without knowing anything of its place.
//!
//! A keyframe keeps the landmarks that it shows, each with its position and a binary [`descriptor`] of its patch. A later image is compared
//! with all of them ([`matching`]); the pose follows from the points of the best keyframes ([`leveled_pose`]). Roll and pitch are known
//! from the IMU, so two points determine the pose, and a dozen that agree are hardly there by chance. What is found is believed when a
//! second image, independent of the first, says the same.

mod descriptor;
mod leveled_pose;
mod map;
mod matching;
mod saved;

use crate::bundle_adjustment::TrackKey;
use nalgebra::{Matrix2, Vector3};
use vidar_core::camera::Pixel;
use vidar_core::{LieGroup, Se3};

pub(crate) use descriptor::{Descriptor, downward};
pub(crate) use map::{KeyframeMap, MapKeyframe, MapPoint};
pub use saved::SavedMap;

use leveled_pose::{Correspondence, LeveledPose};
use std::sync::Arc;

/// Octaves that a feature of the query is described at: a patch may be seen from half or twice the distance.
pub(crate) const QUERY_LEVELS: usize = 3;

/// Fewest features of the query that agree with one pose, and their least share of all matches.
const MIN_INLIERS: usize = 15;
const MIN_INLIER_SHARE: f64 = 0.2;

/// Least root mean square angle of the agreeing rays about their mean, rad: what lies in one corner of the image determines no pose.
const MIN_SPREAD_RAD: f64 = 0.1;

/// Largest difference of ln(distance) between own landmarks and the map: both are metric.
const MAX_SCALE_DIFFERENCE: f64 = 0.2;

/// Two results agree within this distance, m and share of the distance of what is seen, and within this turn, rad.
const SAME_PLACE_M: f64 = 0.05;
const SAME_PLACE_SHARE: f64 = 0.05;
const SAME_HEADING_RAD: f64 = 0.035;

/// A feature of an image that is looked for in the map.
#[derive(Clone, Debug)]
pub(crate) struct Sighting {
    /// Unit ray in the own, levelled world.
    pub ray: Vector3<f64>,
    /// Own estimate of its distance, m, where there is one.
    pub distance: Option<f64>,
    /// At several octaves; none where the patch leaves the image.
    pub descriptors: Vec<Descriptor>,
    /// Where the image shows it, as read out, with covariance.
    pub pixel: Pixel,
    pub covariance: Matrix2<f64>,
}

/// An image that is looked for in the map.
#[derive(Clone, Debug)]
pub(crate) struct Query {
    /// Its segment, which is not looked for.
    pub segment: u32,
    /// Place of its camera in the own, levelled world, m.
    pub position: Vector3<f64>,
    pub sightings: Vec<Sighting>,
    /// Standard deviation of a ray, rad: corners are found again to a few pixels.
    pub ray_sigma_rad: f64,
}

/// A landmark of the map that the query shows.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Match {
    pub key: TrackKey,
    pub pixel: Pixel,
    pub covariance: Matrix2<f64>,
}

/// A pose in the map.
#[derive(Clone, Debug)]
pub(crate) struct Relocalized {
    /// Segment of the map.
    pub segment: u32,
    /// From the own world to that of the segment: a turn about the vertical and a shift.
    pub map_from_own: Se3,
    /// Place of the camera in the own world, m.
    position: Vector3<f64>,
    /// Median distance of what agrees, m.
    median_distance: f64,
    /// Features of the query that agree.
    pub inliers: usize,
    /// Those that show landmarks of this recording.
    pub matches: Vec<Match>,
}

impl Relocalized {
    /// Whether two results say the same.
    pub fn agrees_with(&self, other: &Self) -> bool {
        let apart = self.map_from_own.inverse() * other.map_from_own;
        let moved = (apart.act(&self.position) - self.position).norm();
        self.segment == other.segment
            && moved <= SAME_PLACE_M + SAME_PLACE_SHARE * self.median_distance.min(other.median_distance)
            && apart.rotation.log().norm() <= SAME_HEADING_RAD
    }
}

/// Where the map shows what the query shows; `None` where it does not, or not surely.
pub(crate) fn relocalize(query: &Query, map: &[Arc<MapKeyframe>]) -> Option<Relocalized> {
    let best = matching::best_keyframes(query, map)?;
    let pairs: Vec<Correspondence> = (best.pairs.iter())
        .map(|p| Correspondence { ray: query.sightings[p.sighting].ray, point: p.point })
        .collect();
    let found = leveled_pose::estimate(&pairs, query.ray_sigma_rad)?;
    // A landmark of several keyframes counts once.
    let mut inliers: Vec<usize> = found.inliers.clone();
    inliers.sort_by_key(|k| best.pairs[*k].sighting);
    inliers.dedup_by_key(|k| best.pairs[*k].sighting);
    let is_sure = inliers.len() >= MIN_INLIERS
        && inliers.len() as f64 >= MIN_INLIER_SHARE * best.sightings as f64
        && spread_rad(inliers.iter().map(|k| pairs[*k].ray)) >= MIN_SPREAD_RAD;
    if !is_sure {
        return None;
    }
    let LeveledPose { map_from_leveled, position } = found.pose;
    let mut distances: Vec<f64> = inliers.iter().map(|k| (pairs[*k].point - position).norm()).collect();
    let ratios = inliers.iter().filter_map(|k| {
        let own = query.sightings[best.pairs[*k].sighting].distance?;
        Some(((pairs[*k].point - position).norm() / own).ln())
    });
    let mut ratios: Vec<f64> = ratios.collect();
    if vidar_solve::statistics::median(&mut ratios).is_some_and(|ratio| ratio.abs() > MAX_SCALE_DIFFERENCE) {
        return None;
    }
    let matched = |k: &usize| {
        let seen = &query.sightings[best.pairs[*k].sighting];
        Some(Match { key: best.pairs[*k].key?, pixel: seen.pixel, covariance: seen.covariance })
    };
    Some(Relocalized {
        segment: best.segment,
        map_from_own: Se3::new(map_from_leveled, position - map_from_leveled.act(&query.position)),
        position: query.position,
        median_distance: vidar_solve::statistics::median(&mut distances)?,
        inliers: inliers.len(),
        matches: inliers.iter().filter_map(matched).collect(),
    })
}

/// Root mean square angle of unit rays about their mean, rad.
fn spread_rad(rays: impl Iterator<Item = Vector3<f64>> + Clone) -> f64 {
    let count = rays.clone().count().max(1) as f64;
    let mean = rays.clone().sum::<Vector3<f64>>() / count;
    (rays.map(|r| (r - mean).norm_squared()).sum::<f64>() / count).sqrt()
}

#[cfg(test)]
mod tests;
