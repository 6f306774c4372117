//! The keyframes of this recording so far, and finding the place again after a loss.

use super::{Odometry, Phase, Status};
use crate::backend::LandmarkEstimate;
use crate::bundle_adjustment::TrackKey;
use crate::deferred::Deferred;
use crate::pipeline::output::{Joined, LossReason};
use crate::relocalization::{
    Descriptor, KeyframeMap, MapKeyframe, MapPoint, QUERY_LEVELS, Query, QueryFeature, Relocalized, downward,
    relocalize,
};
use nalgebra::{Matrix2, Vector3};
use vidar_core::{Duration, FrameId, LieGroup, Se3, Timestamp};

/// Least time between searches, s, and time of the recording until the result of one is taken over: comparing with 400 keyframes takes some
/// 50 ms.
const PAUSE_SECS: f64 = 0.5;
const SEARCH_SECS: f64 = 0.3;

/// Standard deviation of ln(scale) from which on a world may join another one.
const MAX_SCALE_STD: f64 = 0.1;

/// Landmarks are kept whose distance is known this well, relatively.
const MAX_DISTANCE_STD: f64 = 0.15;

/// Largest difference of ln(distance) between own landmarks and the map: both are metric.
pub(super) const MAX_SCALE_DIFFERENCE: f64 = 0.2;

/// Standard deviation of a corner that is found again by its descriptor, px.
pub(super) const MATCH_SIGMA_PX: f64 = 2.0;

/// What was estimated so long before a divergence is right, s.
const DIVERGING_SECS: f64 = 5.0;

/// Keyframes, and the search among them.
#[derive(Debug, Default)]
pub(super) struct Relocalizer {
    pub map: KeyframeMap,
    /// The image that is looked for.
    search: Option<(FrameId, Deferred<Option<Relocalized>>)>,
    /// A result that waits for a second one.
    candidate: Option<(FrameId, Relocalized)>,
    last_search: Option<Timestamp>,
}

impl Relocalizer {
    /// A later estimate of a keyframe's pose.
    pub fn revise(&mut self, frame: FrameId, world_from_camera: Se3) {
        self.map.revise(frame, world_from_camera);
    }

    /// The state is given up at an instant.
    pub fn lose(&mut self, reason: &LossReason, time: Timestamp) {
        self.search = None;
        self.candidate = None;
        match reason {
            // All that was estimated with the wrong clock or rotation is wrong.
            LossReason::Recalibrated { .. } => self.map.forget_own(),
            LossReason::Diverged { .. } => {
                self.map.forget_after(time - Duration::from_secs_f64(DIVERGING_SECS))
            }
            _ => {}
        }
    }
}

impl Odometry {
    /// Keeps image `id` where it is a keyframe, looks for it among the keyframes of other segments, and joins their worlds where it was
    /// found twice.
    pub(super) fn relocalize(
        &mut self,
        status: &mut Status,
        id: FrameId,
        caller_id: FrameId,
        time: Timestamp,
    ) {
        let Status::Tracking(tracking) = status else { return };
        if let Some(joined) = self.joined(time) {
            tracking.join(&joined);
        }
        if tracking.keyframe.is_none() || !tracking.scale_std.is_finite() {
            return;
        }
        self.keep_keyframe(id, caller_id, time);
        let is_early = |last: Timestamp| (time - last).as_secs_f64() < PAUSE_SECS;
        let is_due = self.relocalizer.search.is_none()
            && !self.relocalizer.last_search.is_some_and(is_early)
            && tracking.scale_std <= MAX_SCALE_STD
            && self.relocalizer.map.has_other_than(self.segment);
        if let Some(query) = is_due.then(|| self.query(id)).flatten() {
            let map = self.relocalizer.map.clone();
            let due = time + Duration::from_secs_f64(SEARCH_SECS);
            let search = Deferred::begin(due, move || relocalize(&query, map.keyframes()));
            self.relocalizer.search = Some((id, search));
            self.relocalizer.last_search = Some(time);
        }
    }

    /// Takes a due result over; the worlds that it joins with an earlier one.
    fn joined(&mut self, time: Timestamp) -> Option<Joined> {
        let (id, search) = self.relocalizer.search.take_if(|(_, search)| search.is_due(time))?;
        let found = search.result().flatten()?;
        let earlier = self.relocalizer.candidate.replace((id, found.clone()));
        let (first_id, first) = earlier.filter(|(_, earlier)| earlier.agrees_with(&found, 1.0))?;
        self.relocalizer.candidate = None;
        let own = self.segment;
        let into_own = self.world_from_smoother();
        let (segment, into, into_from_segment) = match found.segment < own {
            true => (own, found.segment, found.map_from_own * into_own.inverse()),
            false => (found.segment, own, into_own * found.map_from_own.inverse()),
        };
        self.relocalizer.map.join(segment, into, &into_from_segment, 1.0);
        if segment == own {
            self.segment = into;
            self.placed = Some(found.map_from_own);
        }
        let matches = first.inliers + found.inliers;
        if let Some(log) = &mut self.log {
            log.join(segment, into, &into_from_segment, 1.0);
            for (id, result) in [(first_id, first), (id, found)] {
                for m in &result.matches {
                    log.add_loop_constraint(id, m.key, &m.pixel, &m.covariance);
                }
            }
        }
        Some(Joined { segment, into, into_from_segment, matches })
    }

    /// From the smoother's world to that of the segment.
    pub(super) fn world_from_smoother(&self) -> Se3 {
        self.placed.unwrap_or(Se3::IDENTITY)
    }

    /// Adds the newest image to the map.
    fn keep_keyframe(&mut self, id: FrameId, caller_id: FrameId, time: Timestamp) {
        let (Phase::Tracking(window), Some(host)) = (&self.phase, &self.last_host) else { return };
        let (smoother, camera) = (&window.smoother, &self.camera.model);
        let Some(state) = smoother.state(id).filter(|_| host.frame == id) else { return };
        let own_from_camera = state.world_from_body * *smoother.body_from_camera();
        let camera_from_own = own_from_camera.inverse();
        let gravity = camera_from_own.rotation.act(&-Vector3::z());
        let generation = self.log.as_ref().map_or(0, |log| log.generation());
        let seen = window.tracker.tracks.iter().filter(|t| t.is_landmark && t.measured.is_some());
        let points = seen.filter_map(|t| {
            let landmark = smoother.landmark(t.id)?;
            if landmark.inverse_distance_sigma > MAX_DISTANCE_STD * landmark.inverse_distance {
                return None;
            }
            let down = downward(camera, &camera.unproject(&t.last_global_pixel)?, &gravity);
            let at = |level| Descriptor::at(&host.pyramid, &t.last_pixel, level, &down);
            let descriptor = at(t.feature.level.into())?;
            let key = Some(TrackKey { generation, track: t.id });
            let at_octaves = (0..QUERY_LEVELS).filter_map(at).collect();
            Some(MapPoint { key, in_camera: camera_from_own.act(&landmark.in_world), descriptor, at_octaves })
        });
        let points = points.collect();
        let world_from_camera = self.world_from_smoother() * own_from_camera;
        let segment = self.segment;
        let own = Some((id, caller_id));
        self.relocalizer.map.add(MapKeyframe { own, time, segment, world_from_camera, points });
    }

    /// The newest image, to be looked for.
    fn query(&self, id: FrameId) -> Option<Query> {
        let (Phase::Tracking(window), Some(host)) = (&self.phase, &self.last_host) else { return None };
        let (smoother, camera) = (&window.smoother, &self.camera.model);
        let state = smoother.state(id).filter(|_| host.frame == id)?;
        let own_from_camera = state.world_from_body * *smoother.body_from_camera();
        let gravity = own_from_camera.rotation.inverse().act(&-Vector3::z());
        let shown = window.tracker.tracks.iter().filter_map(|t| match t.measured {
            _ if t.host.frame == id => Some((t, t.feature.pixel, t.feature.global_pixel)),
            Some(_) => Some((t, t.last_pixel, t.last_global_pixel)),
            None => None,
        });
        let covariance = Matrix2::identity() * MATCH_SIGMA_PX.powi(2);
        let features = shown.filter_map(|(track, pixel, global_pixel)| {
            let ray = camera.unproject(&global_pixel)?;
            let down = downward(camera, &ray, &gravity);
            let at = |level| Descriptor::at(&host.pyramid, &pixel, level, &down);
            let distance = |l: LandmarkEstimate| (l.in_world - own_from_camera.translation).norm();
            Some(QueryFeature {
                ray: own_from_camera.rotation.act(&ray),
                distance: smoother.landmark(track.id).map(distance),
                descriptors: (0..QUERY_LEVELS).filter_map(at).collect(),
                pixel,
                covariance,
            })
        });
        Some(Query {
            segment: self.segment,
            position: own_from_camera.translation,
            features: features.filter(|s| !s.descriptors.is_empty()).collect(),
            ray_sigma_rad: MATCH_SIGMA_PX / camera.intrinsics().fx,
            max_scale_difference: MAX_SCALE_DIFFERENCE,
        })
    }
}
