//! The keyframes that a camera can be found in again.

use super::Descriptor;
use crate::bundle_adjustment::TrackKey;
use nalgebra::Vector3;
use std::sync::Arc;
use vidar_core::{FrameId, Se3, Timestamp};

/// Keyframes that are kept: 2000 with a hundred points each take 40 MB (measured, 20 KB each). When they are more, every second one goes.
const MAX_KEYFRAMES: usize = 2000;

/// Fewest points of a keyframe that is kept.
const MIN_POINTS: usize = 20;

/// A landmark as a keyframe shows it.
#[derive(Clone, Debug)]
pub(crate) struct MapPoint {
    /// Its track; `None` where it is of another recording.
    pub key: Option<TrackKey>,
    /// Its place in the frame of the camera, m.
    pub in_camera: Vector3<f64>,
    pub descriptor: Descriptor,
    /// At several octaves, to be looked for; none where it is of another recording.
    pub at_octaves: Vec<Descriptor>,
}

/// A keyframe with the landmarks that it shows.
#[derive(Clone, Debug)]
pub(crate) struct MapKeyframe {
    /// The smoother's and the caller's number of its image; `None` where it is of another recording.
    pub own: Option<(FrameId, FrameId)>,
    pub time: Timestamp,
    /// Its world: poses of different segments cannot be compared.
    pub segment: u32,
    pub world_from_camera: Se3,
    pub points: Vec<MapPoint>,
}

/// All keyframes so far, oldest first. Clones share them.
#[derive(Clone, Debug, Default)]
pub(crate) struct KeyframeMap {
    keyframes: Vec<Arc<MapKeyframe>>,
}

impl KeyframeMap {
    /// Adds a keyframe that shows enough.
    pub fn add(&mut self, keyframe: MapKeyframe) {
        if keyframe.points.len() < MIN_POINTS {
            return;
        }
        self.keyframes.push(Arc::new(keyframe));
        if self.keyframes.len() > MAX_KEYFRAMES {
            let mut keeps = false;
            self.keyframes.retain(|_| {
                keeps = !keeps;
                keeps
            });
        }
    }

    /// All of them.
    pub fn keyframes(&self) -> &[Arc<MapKeyframe>] {
        &self.keyframes
    }

    /// Those of this recording, without those of another one.
    pub fn own(&self) -> Self {
        Self { keyframes: self.keyframes.iter().filter(|k| k.own.is_some()).cloned().collect() }
    }

    /// The segments, in the order of their first keyframes.
    pub fn segments(&self) -> Vec<u32> {
        let mut all: Vec<u32> = Vec::new();
        for keyframe in &self.keyframes {
            if !all.contains(&keyframe.segment) {
                all.push(keyframe.segment);
            }
        }
        all
    }

    /// Whether there are keyframes of other segments.
    pub fn has_other_than(&self, segment: u32) -> bool {
        self.keyframes.iter().any(|k| k.segment != segment)
    }

    /// A later estimate of a keyframe's pose.
    pub fn revise(&mut self, frame: FrameId, world_from_camera: Se3) {
        if let Some(keyframe) =
            self.keyframes.iter_mut().rev().find(|k| k.own.is_some_and(|(own, _)| own == frame))
        {
            Arc::make_mut(keyframe).world_from_camera = world_from_camera;
        }
    }

    /// Moves the keyframes of a segment, whose world is `scale` times too small, into that of another one.
    pub fn join(&mut self, segment: u32, into: u32, into_from_segment: &Se3, scale: f64) {
        for keyframe in self.keyframes.iter_mut().filter(|k| k.segment == segment) {
            let keyframe = Arc::make_mut(keyframe);
            keyframe.segment = into;
            keyframe.world_from_camera.translation *= scale;
            keyframe.world_from_camera = *into_from_segment * keyframe.world_from_camera;
            keyframe.points.iter_mut().for_each(|p| p.in_camera *= scale);
        }
    }

    /// Forgets the keyframes of this recording that were taken after an instant.
    pub fn forget_after(&mut self, time: Timestamp) {
        self.keyframes.retain(|k| k.own.is_none() || k.time <= time);
    }

    /// Forgets those of this recording.
    pub fn forget_own(&mut self) {
        self.keyframes.retain(|k| k.own.is_none());
    }
}
