//! What is known of a chunk's frames from elsewhere, in the aligner's terms: pose priors with covariance, gravity, landmarks
//! of the odometry and of stereo, and place descriptors.

use super::events::MapKeyframe;
use super::stereo_landmarks;
use crate::config::{CouplingConfig, LandmarkSources};
use std::collections::BTreeMap;
use vidar_align::aligner::DepthPoint;
use vidar_align::chunking::ChunkSpan;
use vidar_align::covariance::{chained_covariance, covariance_in_camera};
use vidar_align::landmark_transfer::{LandmarkSource, LandmarkTransfer};
use vidar_align::{ChunkObservation, FrameObservation, PosePrior};
use vidar_core::{
    CameraModel, FrameId, GeometryPrediction, KeyframeId, OdometryKeyframe, Pinhole, RevisedPose, RigCamera,
    Se3, SparseLandmark,
};

/// Landmarks are transferred from keyframes at most this many frames away.
pub const MAX_STEPS: usize = 10;

/// What becomes of the odometry's landmarks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LandmarkUse {
    /// They are not used.
    None,
    /// Keyframes of the odometry have them.
    AtKeyframes,
    /// Frames between two of the odometry's keyframes get those that both observe, too. A network's depth is corrected in
    /// every view; stereo is better than landmarks transferred between keyframes.
    Transferred,
}

impl LandmarkUse {
    /// As configured; `overlaps` tells whether chunks have a scale of their own.
    pub fn new(config: &CouplingConfig, overlaps: bool) -> Self {
        match (config.uses_landmarks(LandmarkSources::Odometry), overlaps) {
            (false, _) => Self::None,
            (true, false) => Self::AtKeyframes,
            (true, true) => Self::Transferred,
        }
    }
}

/// Observes the frames of chunks.
pub struct Observer {
    camera: CameraModel,
    view: Pinhole,
    body_from_camera: Se3,
    landmarks: LandmarkUse,
    /// The odometry's keyframes: the chain of covariances runs through those that were not selected, too. Without their landmarks, which
    /// would be held a second time for as long as the recording lasts.
    odometry: BTreeMap<KeyframeId, OdometryKeyframe>,
}

impl Observer {
    /// Landmarks are projected from the camera to the undistorted `view`.
    pub fn new(camera: &RigCamera, view: Pinhole, landmarks: LandmarkUse) -> Self {
        Self {
            camera: camera.model.clone(),
            view,
            body_from_camera: camera.body_from_camera,
            landmarks,
            odometry: BTreeMap::new(),
        }
    }

    /// Forgets the odometry's keyframes.
    pub fn reset(&mut self) {
        self.odometry.clear();
    }

    /// A keyframe of the odometry.
    pub fn add(&mut self, keyframe: &OdometryKeyframe) {
        self.odometry.insert(keyframe.id, OdometryKeyframe { landmarks: Vec::new(), ..keyframe.clone() });
    }

    /// A keyframe's pose was estimated again: chunks that are aligned from now on use it.
    pub fn revise(&mut self, revised: &RevisedPose) {
        if let Some(keyframe) = self.odometry.get_mut(&revised.id) {
            keyframe.world_from_camera = revised.world_from_camera;
        }
    }

    /// Whether the landmarks of the frames before `end` no longer depend on keyframes that are still to come.
    pub fn is_decided(&self, keyframes: &[MapKeyframe], end: usize) -> bool {
        let mut later = keyframes[end.min(keyframes.len())..].iter().take(MAX_STEPS);
        self.landmarks != LandmarkUse::Transferred
            || self.odometry.is_empty()
            || keyframes.len() >= end + MAX_STEPS
            || later.any(|k| k.odometry.is_some())
    }

    /// A chunk's prediction with all that is known of its frames besides.
    pub fn observe(
        &self,
        keyframes: &[MapKeyframe],
        chunk: &ChunkSpan,
        prediction: GeometryPrediction,
        descriptors: &[Vec<f32>],
        by_stereo: &BTreeMap<FrameId, Vec<DepthPoint>>,
    ) -> ChunkObservation {
        let observe = |k: usize| {
            let view = prediction.views.iter().position(|v| v.frame_id == keyframes[k].stamp.frame_id);
            let mut frame = self.frame(keyframes, k, view.map(|v| prediction.views[v].intrinsics));
            frame.points = by_stereo.get(&frame.frame_id).cloned().unwrap_or_default();
            frame.shared_point_std = stereo_landmarks::SHARED_STD;
            frame.descriptor = view.and_then(|v| descriptors.get(v)).filter(|d| !d.is_empty()).cloned();
            frame
        };
        let frames = chunk.seen.clone().map(observe).collect();
        ChunkObservation { prediction, frames }
    }

    fn transfer<'t>(&'t self, depth: &'t Pinhole) -> LandmarkTransfer<'t> {
        LandmarkTransfer { camera: &self.camera, view: &self.view, depth }
    }

    fn frame(&self, keyframes: &[MapKeyframe], k: usize, depth: Option<Pinhole>) -> FrameObservation {
        let keyframe = &keyframes[k];
        let mut frame = FrameObservation::new(keyframe.stamp.frame_id, keyframe.stamp.time);
        let Some(pose) = keyframe.world_from_camera else { return frame };
        let Some(own) = &keyframe.odometry else {
            if let (LandmarkUse::Transferred, Some(depth)) = (self.landmarks, depth) {
                frame.landmarks = self.transferred(keyframes, k, &pose, &self.transfer(&depth));
            }
            return frame.with_pose_prior(PosePrior::new(pose));
        };
        let odometry = self.odometry.get(&own.id).unwrap_or(own);
        let mut prior = PosePrior::from_odometry(odometry, &self.body_from_camera);
        prior.world_from_camera = pose;
        let before = k.checked_sub(1).and_then(|k| keyframes[k].odometry.as_ref());
        prior.relative_covariance = before
            .and_then(|before| chained_covariance(odometry, before.id, |id| self.odometry.get(&id)))
            .map(|covariance| covariance_in_camera(&covariance, &self.body_from_camera));
        if let Some(depth) = depth.filter(|_| self.landmarks != LandmarkUse::None) {
            frame.landmarks = self.transfer(&depth).undistorted(&own.landmarks);
        }
        frame.with_pose_prior(prior)
    }

    /// Landmarks of a frame between two of the odometry's keyframes.
    fn transferred(
        &self,
        keyframes: &[MapKeyframe],
        k: usize,
        pose: &Se3,
        transfer: &LandmarkTransfer<'_>,
    ) -> Vec<SparseLandmark> {
        let source = |k: usize| {
            let keyframe = &keyframes[k];
            Some(LandmarkSource {
                keyframe: keyframe.odometry.as_ref()?,
                world_from_camera: keyframe.world_from_camera?,
                time: keyframe.stamp.time,
            })
        };
        let before = (0..k).rev().take(MAX_STEPS).find_map(source);
        let after = (k + 1..keyframes.len()).take(MAX_STEPS).find_map(source);
        match (before, after) {
            (Some(before), Some(after)) => transfer.between(keyframes[k].stamp.time, pose, &before, &after),
            _ => Vec::new(),
        }
    }
}
