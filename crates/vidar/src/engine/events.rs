//! What the engine reports: progress and results in one typed stream.

use super::track::Segment;
use crate::input::trajectory::TrajectorySource;
use crate::quality::TrackQuality;
use std::sync::Arc;
use vidar_align::Placement;
use vidar_align::aligner::{ChunkReport, FrameObservation, LoopReport};
use vidar_core::remap::ImageWarp;
use vidar_core::{
    AlignedView, CameraId, CameraModel, ChunkId, Duration, FrameId, OdometryKeyframe, PointCloud,
    RevisedPose, Se3, Timestamp, TriangleMesh, Warning,
};
use vidar_fusion::{CoverageReport, DoubleWallReport};
use vidar_stereo::PoseStd;

/// An image without its pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FrameStamp {
    /// Its number in the sequence.
    pub frame_id: FrameId,
    /// When it was taken, in the cameras' clock.
    pub time: Timestamp,
    /// Which camera took it.
    pub camera: CameraId,
}

/// Pose of the camera at one image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrameState {
    /// Which image.
    pub frame_id: FrameId,
    /// When it was taken.
    pub time: Timestamp,
    /// Segment of the track: poses of different segments have no common world frame.
    pub segment: u32,
    /// Pose of the camera, m.
    pub world_from_camera: Se3,
}

/// A keyframe that the growing surface shows: depth of at least a twentieth of its pixels is in it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ShownKeyframe {
    /// Which image.
    pub frame_id: FrameId,
    /// Median z-depth of what it sees, m.
    pub median_depth_m: f64,
}

/// A frame that carries geometry.
#[derive(Clone, Debug)]
pub struct MapKeyframe {
    /// The image.
    pub stamp: FrameStamp,
    /// Pose of its camera as tracked, m; none where poses are found by the geometry model alone.
    pub world_from_camera: Option<Se3>,
    /// How its image differs from what the calibrated camera would show at one instant; none where it does not, and until the images around
    /// it have poses.
    pub warp: Option<ImageWarp>,
    /// The odometry's keyframe of the same image, with its landmarks and covariance.
    pub odometry: Option<Arc<OdometryKeyframe>>,
}

impl MapKeyframe {
    /// Finds out how its image differs from the calibrated camera's, once the images around it have poses, and puts the odometry's landmarks
    /// where that would have seen them at one instant, as its pixels will be.
    pub(super) fn as_calibrated(&mut self, track: &Segment, readout: Duration, camera: &CameraModel) {
        if self.warp.is_some() {
            return;
        }
        self.warp = track.image_warp(self.stamp.frame_id, readout);
        if let (Some(warp), Some(odometry)) = (&self.warp, &mut self.odometry) {
            for landmark in &mut Arc::make_mut(odometry).landmarks {
                landmark.pixel = warp.as_calibrated(camera, &landmark.pixel).unwrap_or(landmark.pixel);
            }
        }
    }
}

/// The step of the method that the engine works on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Step {
    /// Metric poses of images.
    Track,
    /// Depth of a chunk's keyframes.
    Predict,
    /// Placement of chunks in the world.
    Align,
    /// Placed depth into one surface.
    Fuse,
    /// Depth for the pixels that stereo left empty.
    Complete,
}

impl Step {
    /// The step as it is named in manifests.
    pub fn name(self) -> &'static str {
        match self {
            Self::Track => "track",
            Self::Predict => "predict",
            Self::Align => "align",
            Self::Fuse => "fuse",
            Self::Complete => "complete",
        }
    }
}

/// The fused surface.
#[derive(Clone, Debug, Default)]
pub struct Surface {
    /// Surface with triangles.
    pub mesh: TriangleMesh,
    /// Surface as points.
    pub cloud: PointCloud,
    /// Area, volume and number of observations.
    pub coverage: CoverageReport,
    /// Share of the surface that exists twice.
    pub double_walls: Option<DoubleWallReport>,
    /// Largest memory of the volume, bytes.
    pub volume_bytes: u64,
}

/// One event of the engine's stream. Frames, units: `world_from_camera` in metres (in units of the first chunk in couplings
/// without metric poses).
#[derive(Clone, Debug)]
pub enum MapEvent {
    /// The engine turned to this step.
    Step(Step),
    /// A new world: keyframes, chunks, placements and surface reported before are void. Raised when mapping begins, and when a
    /// later segment of the track has become longer than the one that was mapped.
    World {
        /// Where the metric poses come from; none without metric poses.
        source: Option<TrajectorySource>,
        /// The segment that is mapped.
        segment: u32,
    },
    /// The pose of an image.
    State(FrameState),
    /// Poses of odometry keyframes, estimated again.
    RevisedStates(Vec<RevisedPose>),
    /// A frame was selected as a keyframe.
    Keyframe(MapKeyframe),
    /// Depth of a chunk's keyframes was predicted.
    ChunkPredicted {
        /// Which chunk.
        chunk: ChunkId,
        /// Keyframes whose depth was wanted.
        keyframes: usize,
        /// Keyframes that got depth.
        with_depth: usize,
        /// Whether an earlier run had predicted it.
        is_reused: bool,
        /// What the pose of each of these is known to, where the images corrected it; else empty.
        pose_std: Vec<PoseStd>,
    },
    /// What is known of a chunk's frames besides its prediction: the aligner's input.
    ChunkObserved {
        /// Which chunk.
        chunk: ChunkId,
        /// Pose priors, landmarks and descriptors.
        frames: Vec<FrameObservation>,
    },
    /// A chunk was aligned.
    ChunkPlaced(ChunkReport),
    /// A revisit was measured.
    LoopMeasured(LoopReport),
    /// All chunks and keyframes, estimated again.
    PlacementsRevised {
        /// Where they are now.
        placement: Arc<Placement>,
        /// Whether nothing will move any more.
        is_final: bool,
    },
    /// Keyframes at their final poses, in metres, as they are fused.
    ViewsFused(Vec<AlignedView>),
    /// The surface at the present placements.
    SurfaceChanged {
        /// The surface. Only the final one has points and coverage.
        surface: Arc<Surface>,
        /// Keyframes whose depth is in it for the first time; of the map none are named.
        shown: Vec<ShownKeyframe>,
        /// Whether it is the map.
        is_final: bool,
    },
    /// What the odometry says of the whole recording, once it has seen all of it.
    Tracked(Box<TrackQuality>),
    /// Something the user should know.
    Warning(Warning),
}
