//! Keyframes and landmarks as the rest of a map wants them.

use crate::backend::Smoother;
use crate::imu::NavState;
use crate::tracking::Track;
use nalgebra::Vector3;
use vidar_core::{
    FrameId, GRAVITY_MPS2, Health, KeyframeId, LieGroup, NavCovariance, OdometryKeyframe, PoseCovariance,
    RevisedPose, Se3, SparseLandmark, Timestamp,
};

/// Names of the keyframes that the smoother holds.
#[derive(Debug, Default)]
pub(crate) struct KeyframeRegistry {
    next: u32,
    /// Frame of the smoother and name, oldest first.
    held: Vec<(FrameId, KeyframeId)>,
    /// The caller's number of the image and name, of all keyframes of the segment while a scale that is settled later may revise them.
    provisional: Vec<(FrameId, KeyframeId)>,
}

/// What a keyframe is made from, besides the smoother.
pub(crate) struct KeyframeInput<'a> {
    /// The frame as the smoother and as the caller know it.
    pub frame: FrameId,
    pub caller_frame: FrameId,
    pub time: Timestamp,
    pub segment: u32,
    pub state: &'a NavState,
    pub covariance: &'a NavCovariance,
    pub scale_std: f64,
    pub health: Health,
    pub landmarks: &'a [SparseLandmark],
}

impl KeyframeRegistry {
    /// Forgets what the smoother held; names go on.
    pub fn forget_held(&mut self) {
        self.held.clear();
    }

    /// Whether a keyframe of the caller's image may still be revised by a settled scale.
    pub fn is_provisional(&self, image: FrameId) -> bool {
        self.provisional.iter().any(|(frame, _)| *frame == image)
    }

    /// Poses that were told so far are not revised by a settled scale any more.
    pub fn forget_provisional(&mut self) {
        self.provisional.clear();
    }

    /// The provisional keyframes that the smoother does not hold at other poses world_from_camera of their images, where there are any.
    pub fn moved(&self, pose: impl Fn(FrameId) -> Option<Se3>) -> Vec<RevisedPose> {
        let left = self.provisional.iter().filter(|(_, id)| self.held.iter().all(|(_, held)| held != id));
        let moved = left.filter_map(|(frame, id)| {
            Some(RevisedPose { id: *id, world_from_camera: pose(*frame)?, is_final: true })
        });
        moved.collect()
    }

    pub fn make(&mut self, smoother: &mut Smoother, input: &KeyframeInput<'_>) -> OdometryKeyframe {
        let id = KeyframeId(self.next);
        self.next = self.next.wrapping_add(1);
        let previous = self.held.last().and_then(|(frame, id)| {
            smoother.relative_covariance(*frame, input.frame).map(|covariance| (*id, covariance))
        });
        self.held.push((input.frame, id));
        self.provisional.push((input.caller_frame, id));
        let pose_covariance: PoseCovariance = input.covariance.fixed_view::<6, 6>(0, 0).into_owned();
        OdometryKeyframe {
            id,
            frame_id: input.caller_frame,
            segment: input.segment,
            state: public_state(input.state, input.time),
            world_from_camera: input.state.world_from_body * *smoother.body_from_camera(),
            pose_covariance,
            previous,
            gravity_in_world: smoother
                .imu_model()
                .map_or(Vector3::new(0.0, 0.0, -GRAVITY_MPS2), |imu| imu.gravity()),
            scale_std: input.scale_std,
            health: input.health,
            lens: vidar_core::LensMotion::NONE,
            landmarks: input.landmarks.to_vec(),
        }
    }

    /// Poses of keyframes that left, then of those held.
    pub fn revise(&mut self, smoother: &Smoother, left: &[(FrameId, NavState)], out: &mut Vec<RevisedPose>) {
        for (frame, state) in left {
            if let Some(at) = self.held.iter().position(|(f, _)| f == frame) {
                let (_, id) = self.held.remove(at);
                out.push(RevisedPose { id, world_from_camera: camera_of(smoother, state), is_final: true });
            }
        }
        out.extend(self.held.iter().filter_map(|(frame, id)| {
            let state = smoother.state(*frame)?;
            Some(RevisedPose { id: *id, world_from_camera: camera_of(smoother, state), is_final: false })
        }));
    }
}

fn camera_of(smoother: &Smoother, state: &NavState) -> Se3 {
    state.world_from_body * *smoother.body_from_camera()
}

/// The smoother's state in shared words.
pub(crate) fn public_state(state: &NavState, time: Timestamp) -> vidar_core::NavState {
    vidar_core::NavState {
        time,
        world_from_body: state.world_from_body,
        velocity_in_world: state.velocity,
        gyro_bias: state.bias.gyro,
        accel_bias: state.bias.accel,
    }
}

/// The landmarks that the newest image shows, with their depth from its camera.
pub(crate) fn seen_landmarks(
    smoother: &Smoother,
    tracks: &[Track],
    world_from_camera: &Se3,
) -> Vec<SparseLandmark> {
    let camera_from_world = world_from_camera.inverse();
    let seen = tracks.iter().filter(|t| t.is_landmark).filter_map(|t| Some((t.id, t.measured?.pixel)));
    let mut landmarks = Vec::with_capacity(tracks.len());
    landmarks.extend(seen.filter_map(|(id, pixel)| {
        let landmark = smoother.landmark(id)?;
        let z = camera_from_world.act(&landmark.in_world).z;
        // The relative deviation is that of the host's ray: the poses' share is in their covariance.
        let relative = landmark.inverse_distance_sigma / landmark.inverse_distance;
        (z > 1e-3 && relative.is_finite()).then(|| SparseLandmark {
            id,
            pixel,
            inverse_depth: 1.0 / z,
            inverse_depth_std: relative / z,
        })
    }));
    landmarks
}
