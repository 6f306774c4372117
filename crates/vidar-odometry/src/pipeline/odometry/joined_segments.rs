//! Segments that were not joined live, joined after the end: every keyframe of the one is looked for among all of the others.

use super::Odometry;
use super::relocalization::MATCH_SIGMA_PX;
use crate::bundle_adjustment::TrackLog;
use crate::relocalization::{MapKeyframe, MapPoint, Query, Relocalized, Sighting, consensus, relocalize};
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
            let look = |keyframe: &&Arc<MapKeyframe>| {
                let (frame, _) = keyframe.own?;
                let pixel = |p: &MapPoint| log.pixel_of(frame, p.key?);
                let found = relocalize(
                    &query(keyframe, segment, ray_sigma_rad, MAX_SCALE_DIFFERENCE, pixel),
                    earlier,
                )?;
                Some((frame, found))
            };
            let (frames, found): (Vec<FrameId>, Vec<Relocalized>) =
                own.iter().step_by(stride).filter_map(look).unzip();
            let Some(place) = consensus(&found, true) else { continue };
            map.join(segment, place.segment, &place.map_from_own, place.scale);
            let log = log.to_mut();
            log.join(segment, place.segment, &place.map_from_own, place.scale);
            for i in place.agreeing {
                found[i].matches.iter().for_each(|m| log.tie(frames[i], m.key, &m.pixel, &m.covariance));
            }
        }
        log
    }
}

/// A keyframe of `segment` as something to look for; `pixel` says where it shows a point.
pub(super) fn query(
    keyframe: &MapKeyframe,
    segment: u32,
    ray_sigma_rad: f64,
    max_scale_difference: f64,
    pixel: impl Fn(&MapPoint) -> Option<Pixel>,
) -> Query {
    let world_from_camera = &keyframe.world_from_camera;
    let sighting = |point: &MapPoint| {
        Some(Sighting {
            ray: world_from_camera.rotation.act(&point.in_camera.normalize()),
            distance: Some(point.in_camera.norm()),
            descriptors: point.at_octaves.clone(),
            pixel: pixel(point)?,
            covariance: Matrix2::identity() * MATCH_SIGMA_PX.powi(2),
        })
    };
    Query {
        segment,
        position: world_from_camera.translation,
        sightings: keyframe.points.iter().filter_map(sighting).collect(),
        ray_sigma_rad,
        max_scale_difference,
    }
}
