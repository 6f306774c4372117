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
use vidar_core::{LieGroup, Se3, So3};

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

/// Two results agree within this distance, m and share of the distance of what is seen, and within this turn, rad.
const SAME_PLACE_M: f64 = 0.05;
const SAME_PLACE_SHARE: f64 = 0.05;
const SAME_HEADING_RAD: f64 = 0.035;

/// A feature of an image that is looked for in the map.
#[derive(Clone, Debug)]
pub(crate) struct QueryFeature {
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
    pub features: Vec<QueryFeature>,
    /// Standard deviation of a ray, rad: corners are found again to a few pixels.
    pub ray_sigma_rad: f64,
    /// Largest difference of ln(distance) between own landmarks and the map.
    pub max_scale_difference: f64,
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
    /// Median of ln(distance in the map / own distance); 0 where no own distance is known.
    scale_difference: f64,
    /// Median distance of what agrees, m.
    median_distance: f64,
    /// Features of the query that agree.
    pub inliers: usize,
    /// Those that show landmarks of this recording.
    pub matches: Vec<Match>,
}

impl Relocalized {
    /// Whether two results say the same, of an own world that is `scale` times too small.
    pub fn agrees_with(&self, other: &Self, scale: f64) -> bool {
        let apart = self.map_from_scaled(scale).inverse() * other.map_from_scaled(scale);
        let position = scale * self.position;
        let moved = (apart.act(&position) - position).norm();
        self.segment == other.segment
            && moved <= SAME_PLACE_M + SAME_PLACE_SHARE * self.median_distance.min(other.median_distance)
            && apart.rotation.log().norm() <= SAME_HEADING_RAD
    }

    /// From the own world, enlarged by `scale`, to that of the segment.
    fn map_from_scaled(&self, scale: f64) -> Se3 {
        let turn = self.map_from_own.rotation;
        Se3::new(turn, self.map_from_own.act(&self.position) - turn.act(&(scale * self.position)))
    }
}

/// Where the map shows what the query shows; `None` where it does not, or not surely.
pub(crate) fn relocalize(query: &Query, map: &[Arc<MapKeyframe>]) -> Option<Relocalized> {
    let best = matching::best_keyframes(query, map)?;
    let pairs: Vec<Correspondence> = (best.pairs.iter())
        .map(|p| Correspondence { ray: query.features[p.feature].ray, point: p.point })
        .collect();
    let found = leveled_pose::estimate(&pairs, query.ray_sigma_rad)?;
    // A landmark of several keyframes counts once.
    let mut inliers: Vec<usize> = found.inliers.clone();
    inliers.sort_by_key(|k| best.pairs[*k].feature);
    inliers.dedup_by_key(|k| best.pairs[*k].feature);
    let is_sure = inliers.len() >= MIN_INLIERS
        && inliers.len() as f64 >= MIN_INLIER_SHARE * best.features as f64
        && spread_rad(inliers.iter().map(|k| pairs[*k].ray)) >= MIN_SPREAD_RAD;
    if !is_sure {
        return None;
    }
    let LeveledPose { map_from_leveled, position } = found.pose;
    let mut distances: Vec<f64> = inliers.iter().map(|k| (pairs[*k].point - position).norm()).collect();
    let ratios = inliers.iter().filter_map(|k| {
        let own = query.features[best.pairs[*k].feature].distance?;
        Some(((pairs[*k].point - position).norm() / own).ln())
    });
    let mut ratios: Vec<f64> = ratios.collect();
    let scale_difference = vidar_solve::statistics::median(&mut ratios).unwrap_or(0.0);
    if scale_difference.abs() > query.max_scale_difference {
        return None;
    }
    let matched = |k: &usize| {
        let seen = &query.features[best.pairs[*k].feature];
        Some(Match { key: best.pairs[*k].key?, pixel: seen.pixel, covariance: seen.covariance })
    };
    Some(Relocalized {
        segment: best.segment,
        map_from_own: Se3::new(map_from_leveled, position - map_from_leveled.act(&query.position)),
        position: query.position,
        scale_difference,
        median_distance: vidar_solve::statistics::median(&mut distances)?,
        inliers: inliers.len(),
        matches: inliers.iter().filter_map(matched).collect(),
    })
}

/// Where several images say that the own world lies in the map.
#[derive(Clone, Debug)]
pub(crate) struct Place {
    /// Segment of the map.
    pub segment: u32,
    /// A turn about the vertical and a shift, of the own world enlarged by `scale`.
    pub map_from_own: Se3,
    /// 1 unless it was asked for.
    pub scale: f64,
    /// Which of the results agree.
    pub agreeing: Vec<usize>,
    /// Features that agree, of all images.
    pub inliers: usize,
}

/// What most of several results say: their mean turn and shift, and with `fits_scale` their median scale. `None` where no two say the same.
pub(crate) fn consensus(found: &[Relocalized], fits_scale: bool) -> Option<Place> {
    let mut differences: Vec<f64> = found.iter().map(|one| one.scale_difference).collect();
    let scale = if fits_scale { vidar_solve::statistics::median(&mut differences)?.exp() } else { 1.0 };
    let supporters = |one: &Relocalized| found.iter().filter(|other| one.agrees_with(other, scale)).count();
    // Of equally many the first.
    let best = found.iter().rev().max_by_key(|one| supporters(one))?;
    let indices: Vec<usize> = (0..found.len()).filter(|i| best.agrees_with(&found[*i], scale)).collect();
    if indices.len() < 2 {
        return None;
    }
    let agreeing: Vec<&Relocalized> = indices.iter().map(|i| &found[*i]).collect();
    let count = agreeing.len() as f64;
    let turn_from_best =
        |one: &&Relocalized| (one.map_from_own.rotation * best.map_from_own.rotation.inverse()).log();
    let turn = agreeing.iter().map(turn_from_best).sum::<Vector3<f64>>() / count;
    let rotation = So3::exp(&turn) * best.map_from_own.rotation;
    let shift =
        |one: &&Relocalized| one.map_from_own.act(&one.position) - rotation.act(&(scale * one.position));
    let translation = agreeing.iter().map(shift).sum::<Vector3<f64>>() / count;
    let inliers = agreeing.iter().map(|one| one.inliers).sum();
    let map_from_own = Se3::new(rotation, translation);
    Some(Place { segment: best.segment, map_from_own, scale, agreeing: indices, inliers })
}

/// Root mean square angle of unit rays about their mean, rad.
fn spread_rad(rays: impl Iterator<Item = Vector3<f64>> + Clone) -> f64 {
    let count = rays.clone().count().max(1) as f64;
    let mean = rays.clone().sum::<Vector3<f64>>() / count;
    (rays.map(|r| (r - mean).norm_squared()).sum::<f64>() / count).sqrt()
}

#[cfg(test)]
mod tests;
