//! Segments that were not joined live, joined after the end: every keyframe of the one is looked for among all of the others.

use super::Odometry;
use super::relocalization::MATCH_SIGMA_PX;
use crate::bundle_adjustment::TrackLog;
use crate::relocalization::{
    Descriptor, MapKeyframe, MapPoint, Query, QueryFeature, Relocalized, consensus, relocalize,
};
use nalgebra::Matrix2;
use std::borrow::Cow;
use std::sync::Arc;
use vidar_core::camera::Pixel;
use vidar_core::{FrameId, LieGroup};

/// Keyframes of a segment that are looked for: each takes up to 50 ms.
const MAX_QUERIES: usize = 40;

/// Largest difference of ln(scale) between two segments: a start of a few seconds may be wrong by half.
const MAX_SCALE_DIFFERENCE: f64 = 0.7;

impl Odometry {
    /// The log with the segments in one world whose keyframes show the same place, and with what shows it as observations.
    pub(super) fn joined_log<'a>(&self, log: &'a TrackLog) -> Cow<'a, TrackLog> {
        let mut log = Cow::Borrowed(log);
        let mut map = self.relocalizer.map.own();
        let ray_sigma_rad = MATCH_SIGMA_PX / self.camera.model.intrinsics().fx;
        for segment in map.segments().into_iter().skip(1) {
            let keyframes = map.keyframes();
            let Some(begin) = keyframes.iter().position(|k| k.segment == segment) else { continue };
            let (earlier, later) = keyframes.split_at(begin);
            let own: Vec<&Arc<MapKeyframe>> = later.iter().filter(|k| k.segment == segment).collect();
            let stride = own.len().div_ceil(MAX_QUERIES).max(1);
            let search =
                KeyframeSearch { segment, ray_sigma_rad, max_scale_difference: MAX_SCALE_DIFFERENCE };
            let look = |keyframe: &&Arc<MapKeyframe>| {
                let (frame, _) = keyframe.own?;
                let pixel = |p: &MapPoint| log.pixel_of(frame, p.key?);
                Some((frame, search.find(keyframe, pixel, earlier)?))
            };
            let (frames, found): (Vec<FrameId>, Vec<Relocalized>) =
                own.iter().step_by(stride).filter_map(look).unzip();
            let Some(place) = consensus(&found, true) else { continue };
            map.join(segment, place.segment, &place.map_from_own, place.scale);
            let log = log.to_mut();
            log.join(segment, place.segment, &place.map_from_own, place.scale);
            for i in place.agreeing {
                for m in &found[i].matches {
                    log.add_loop_constraint(frames[i], m.key, &m.pixel, &m.covariance);
                }
            }
        }
        log
    }
}

/// How the keyframes of a segment are looked for.
pub(super) struct KeyframeSearch {
    pub segment: u32,
    /// Standard deviation of a ray, rad.
    pub ray_sigma_rad: f64,
    /// Largest difference of ln(scale) to the map.
    pub max_scale_difference: f64,
}

impl KeyframeSearch {
    /// Where a map shows a keyframe; `pixel` says where the keyframe shows a point. Points are described at the octave of their features first, since
    /// fewer descriptors are mistaken less often, and then at several: the place may be seen from half or twice the distance.
    pub fn find(
        &self,
        keyframe: &MapKeyframe,
        pixel: impl Fn(&MapPoint) -> Option<Pixel>,
        map: &[Arc<MapKeyframe>],
    ) -> Option<Relocalized> {
        let as_found = |p: &MapPoint| vec![p.descriptor];
        relocalize(&self.query(keyframe, as_found, &pixel), map)
            .or_else(|| relocalize(&self.query(keyframe, |p| p.at_octaves.clone(), &pixel), map))
    }

    fn query(
        &self,
        keyframe: &MapKeyframe,
        descriptors: impl Fn(&MapPoint) -> Vec<Descriptor>,
        pixel: &impl Fn(&MapPoint) -> Option<Pixel>,
    ) -> Query {
        let world_from_camera = &keyframe.world_from_camera;
        let feature = |point: &MapPoint| {
            Some(QueryFeature {
                ray: world_from_camera.rotation.act(&point.in_camera.normalize()),
                distance: Some(point.in_camera.norm()),
                descriptors: descriptors(point),
                pixel: pixel(point)?,
                covariance: Matrix2::identity() * MATCH_SIGMA_PX.powi(2),
            })
        };
        Query {
            segment: self.segment,
            position: world_from_camera.translation,
            features: keyframe.points.iter().filter_map(feature).collect(),
            ray_sigma_rad: self.ray_sigma_rad,
            max_scale_difference: self.max_scale_difference,
        }
    }
}
