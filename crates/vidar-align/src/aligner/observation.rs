//! Input of the aligner: chunks with what is known of their frames.

use crate::covariance::covariance_in_camera;
pub use crate::landmark_scale::DepthPoint;
use nalgebra::UnitVector3;
use vidar_core::{
    FrameId, GeometryPrediction, LieGroup, OdometryKeyframe, PoseCovariance, Se3, SparseLandmark, Timestamp,
};

/// A chunk's prediction with pose priors, landmarks and descriptors of its frames.
#[derive(Clone, Debug)]
pub struct ChunkObservation {
    /// The model's prediction. Frames that an earlier chunk holds, too, constrain the two chunks to each other.
    pub prediction: GeometryPrediction,
    /// One entry per frame. Frames without geometry may have one (odometry continues); frames without an entry are placed
    /// through their chunk.
    pub frames: Vec<FrameObservation>,
}

/// What is known of a frame apart from its predicted geometry.
#[derive(Clone, Debug)]
pub struct FrameObservation {
    /// Which frame.
    pub frame_id: FrameId,
    /// When it was taken.
    pub time: Timestamp,
    /// Its metric pose, if any.
    pub pose_prior: Option<PosePrior>,
    /// Points of known metric depth. `pixel` is at the depth image's size, distortion removed.
    pub landmarks: Vec<SparseLandmark>,
    /// Points of known metric depth that no track connects to other frames.
    pub points: Vec<DepthPoint>,
    /// σ of an error of ln(depth) that the points of all frames share; 0 where their errors are independent.
    pub shared_point_std: f64,
    /// Unit-length place recognition descriptor, if loops are to be found. The same length for all frames of a run.
    pub descriptor: Option<Vec<f32>>,
}

impl FrameObservation {
    /// A frame of which only the time is known.
    pub fn new(frame_id: FrameId, time: Timestamp) -> Self {
        Self {
            frame_id,
            time,
            pose_prior: None,
            landmarks: Vec::new(),
            points: Vec::new(),
            shared_point_std: 0.0,
            descriptor: None,
        }
    }

    /// The same with a pose prior.
    pub fn with_pose_prior(mut self, pose_prior: PosePrior) -> Self {
        self.pose_prior = Some(pose_prior);
        self
    }
}

/// A metric pose from odometry, a given trajectory or ground truth.
#[derive(Clone, Debug, PartialEq)]
pub struct PosePrior {
    /// The camera's pose, m. All pose priors of a run share one world, z up, unless `segment` differs.
    pub world_from_camera: Se3,
    /// Covariance of δ in `previous_from_this · exp(δ)`, rotation then translation in this camera's axes, where the previous
    /// frame is the one before with a pose prior; none: typical odometry.
    pub relative_covariance: Option<PoseCovariance>,
    /// The world's up in the camera, from an inertial sensor.
    pub up_in_camera: Option<UnitVector3<f64>>,
    /// Pose priors of different segments share no world.
    pub segment: u32,
    /// Whether the source reports the pose as metric and supported by images. Others are not used.
    pub is_trusted: bool,
}

impl PosePrior {
    /// A trusted pose without covariance or gravity (a trajectory file, ground truth).
    pub fn new(world_from_camera: Se3) -> Self {
        Self {
            world_from_camera,
            relative_covariance: None,
            up_in_camera: None,
            segment: 0,
            is_trusted: true,
        }
    }

    /// The pose, relative covariance and gravity of an odometry keyframe. `body_from_camera` carries covariances, which are in
    /// the body's axes, to the camera.
    pub fn from_odometry(keyframe: &OdometryKeyframe, body_from_camera: &Se3) -> Self {
        let world_from_camera = keyframe.world_from_camera;
        let up_in_world = UnitVector3::try_new(-keyframe.gravity_in_world, 1e-9);
        let camera_from_world = world_from_camera.rotation.inverse();
        Self {
            relative_covariance: keyframe
                .previous
                .map(|(_, covariance)| covariance_in_camera(&covariance, body_from_camera)),
            up_in_camera: up_in_world
                .map(|up| UnitVector3::new_normalize(camera_from_world.act(&up.into_inner()))),
            segment: keyframe.segment,
            is_trusted: keyframe.health.is_metric(),
            world_from_camera,
        }
    }
}
