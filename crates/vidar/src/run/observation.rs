//! What the odometry knows of a chunk's frames and how they look, in the aligner's terms.

use super::looks::Looks;
use super::plan::{ChunkPlan, Plan};
use super::sparse;
use crate::chunks::StoredChunk;
use crate::keyframes::Keyframe;
use std::collections::{BTreeMap, BTreeSet};
use vidar_align::covariance::covariance_in_camera;
use vidar_align::{ChunkObservation, FrameObservation, PosePrior};
use vidar_core::camera::Pixel;
use vidar_core::{
    FrameId, KeyframeId, LandmarkId, LieGroup, OdometryKeyframe, Pinhole, PoseCovariance, Se3, SparseLandmark,
};

/// Landmarks are carried from keyframes at most so many frames away.
const MAX_STEPS: usize = 10;

/// A chunk's prediction with poses, covariances, gravity and landmarks of its frames: the odometry's and those of `by_stereo`.
pub fn of(
    plan: &Plan,
    (known, looks): (&Known<'_>, &Looks),
    chunk: &ChunkPlan,
    stored: StoredChunk,
    by_stereo: &BTreeMap<FrameId, Vec<SparseLandmark>>,
) -> ChunkObservation {
    let looks = looks.of(&stored);
    let prediction = stored.prediction;
    let frames = chunk
        .seen
        .clone()
        .map(|k| {
            let keyframe = &plan.keyframes[k];
            let size =
                prediction.views.iter().find(|v| v.frame_id == keyframe.image.frame_id).map(|v| v.intrinsics);
            let mut frame = known.frame(plan, k, keyframe, size);
            if let Some(by_stereo) = by_stereo.get(&frame.frame_id).filter(|l| !l.is_empty()) {
                frame.landmarks.extend(by_stereo);
                let share = by_stereo.len() as f64 / frame.landmarks.len() as f64;
                frame.shared_landmark_std = share * sparse::SHARED_STD;
            }
            let view = prediction.views.iter().position(|v| v.frame_id == frame.frame_id);
            frame.descriptor = view.and_then(|v| looks.get(v)).filter(|d| !d.is_empty()).cloned();
            frame
        })
        .collect();
    ChunkObservation { prediction, frames }
}

/// The odometry's keyframes by frame, where poses are its.
pub struct Known<'a> {
    by_frame: BTreeMap<FrameId, &'a OdometryKeyframe>,
    by_id: BTreeMap<KeyframeId, &'a OdometryKeyframe>,
    body_from_camera: Se3,
    /// Whether frames between two of the odometry's keyframes get the landmarks that both see.
    carries_landmarks: bool,
}

impl<'a> Known<'a> {
    /// What the plan's anchor knows; `body_from_camera` is the camera's place on the rig. A network's depth is corrected in
    /// every view (`carries_landmarks`); stereo is better than what landmarks between keyframes say.
    pub fn new(plan: &'a Plan, body_from_camera: Se3, carries_landmarks: bool) -> Self {
        let tracked = plan.anchor.as_ref().and_then(|a| a.tracked.as_ref());
        let keyframes = || tracked.iter().flat_map(|t| &t.keyframes);
        Self {
            by_frame: keyframes().map(|k| (k.frame_id, k)).collect(),
            by_id: keyframes().map(|k| (k.id, k)).collect(),
            body_from_camera,
            carries_landmarks,
        }
    }

    fn frame(&self, plan: &Plan, k: usize, keyframe: &Keyframe, depth: Option<Pinhole>) -> FrameObservation {
        let mut frame = FrameObservation::new(keyframe.image.frame_id, keyframe.image.time);
        let Some(pose) = keyframe.world_from_camera else { return frame };
        let Some(odometry) = self.by_frame.get(&keyframe.image.frame_id) else {
            if let (true, Some(depth)) = (self.carries_landmarks, depth) {
                frame.landmarks = self.carried(plan, k, &pose, &depth);
            }
            return frame.with_pose_prior(PosePrior::new(pose));
        };
        let before = k.checked_sub(1).and_then(|k| self.by_frame.get(&plan.keyframes[k].image.frame_id));
        let mut prior = PosePrior::from_odometry(odometry, &self.body_from_camera);
        // The trajectory in use may be smoother than what the keyframe was first given.
        prior.world_from_camera = pose;
        prior.relative_covariance = before
            .and_then(|before| self.since(odometry, before))
            .map(|covariance| covariance_in_camera(&covariance, &self.body_from_camera));
        if let Some(depth) = depth {
            let to_depth = |l: &SparseLandmark| {
                let seen = plan.view.project(&plan.camera.unproject(&l.pixel)?)?;
                Some(SparseLandmark { pixel: in_depth_image(&seen, &plan.view, &depth)?, ..*l })
            };
            frame.landmarks = odometry.landmarks.iter().filter_map(to_depth).collect();
        }
        frame.with_pose_prior(prior)
    }

    /// Landmarks of a frame that lies between two of the odometry's keyframes: those that both see, from where the nearer one
    /// sees them.
    fn carried(&self, plan: &Plan, k: usize, pose: &Se3, depth: &Pinhole) -> Vec<SparseLandmark> {
        let known = |k: &usize| {
            let keyframe = &plan.keyframes[*k];
            Some((
                *self.by_frame.get(&keyframe.image.frame_id)?,
                keyframe.world_from_camera?,
                keyframe.image.time,
            ))
        };
        let before = (0..k).rev().take(MAX_STEPS).find_map(|k| known(&k));
        let after = (k + 1..plan.keyframes.len()).take(MAX_STEPS).find_map(|k| known(&k));
        let (Some(before), Some(after)) = (before, after) else { return Vec::new() };
        if before.0.segment != after.0.segment {
            return Vec::new();
        }
        let time = plan.keyframes[k].image.time;
        let is_before_nearer = time.since(before.2) <= after.2.since(time);
        let (near, far) = if is_before_nearer { (before, after) } else { (after, before) };
        let seen: BTreeSet<LandmarkId> = far.0.landmarks.iter().map(|l| l.id).collect();
        let camera_from_near = pose.inverse() * near.1;
        let carry = |l: &SparseLandmark| {
            let ray = plan.camera.unproject(&l.pixel).filter(|ray| ray.z > 0.0)?;
            let here = camera_from_near.act(&(ray / (ray.z * l.inverse_depth)));
            let pixel = in_depth_image(&plan.view.project(&here)?, &plan.view, depth)?;
            let inverse_depth = 1.0 / here.z;
            let inverse_depth_std = l.inverse_depth_std / l.inverse_depth * inverse_depth;
            Some(SparseLandmark { pixel, inverse_depth, inverse_depth_std, ..*l })
        };
        near.0.landmarks.iter().filter(|l| seen.contains(&l.id)).filter_map(carry).collect()
    }

    /// Covariance of the motion between two keyframes that need not be neighbours, in the later body's axes:
    /// `X₁ exp(δ₁) X₂ exp(δ₂) = X₁ X₂ exp(Ad(X₂⁻¹) δ₁) exp(δ₂)`.
    fn since(&self, later: &OdometryKeyframe, earlier: &OdometryKeyframe) -> Option<PoseCovariance> {
        let mut total = PoseCovariance::zeros();
        let mut at = later;
        while at.id != earlier.id {
            let (previous, covariance) = at.previous?;
            let at_from_later = at.state.world_from_body.inverse() * later.state.world_from_body;
            let turn = at_from_later.inverse().adjoint();
            total += turn * covariance * turn.transpose();
            at = self.by_id.get(&previous)?;
        }
        Some(total)
    }
}

/// A pixel of an undistorted view where a depth image of another size shows it; `None` outside.
pub(super) fn in_depth_image(seen: &Pixel, view: &Pinhole, depth: &Pinhole) -> Option<Pixel> {
    let scaled = |c: f64, from: usize, to: usize| (c + 0.5) * to as f64 / from as f64 - 0.5;
    let pixel =
        Pixel::new(scaled(seen.x, view.width, depth.width), scaled(seen.y, view.height, depth.height));
    let inside = pixel.x >= 0.0
        && pixel.y >= 0.0
        && pixel.x <= (depth.width - 1) as f64
        && pixel.y <= (depth.height - 1) as f64;
    inside.then_some(pixel)
}
