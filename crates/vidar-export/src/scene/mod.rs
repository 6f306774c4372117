//! A run as robotics viewers show it: Foxglove's messages in an MCAP file, which Foxglove and Rerun open as it is.
//!
//! | Topic | Schema | Content |
//! |---|---|---|
//! | `/camera/image`, `/camera/calibration` | `CompressedImage`, `CameraCalibration` | keyframes as they were taken |
//! | `/view/image`, `/view/depth`, `/view/calibration` | `CompressedImage`, `RawImage` (16UC1, mm), `CameraCalibration` | keyframes without distortion, with their depth |
//! | `/tf` | `FrameTransform` | `world` from `camera` at every image, `world` from `view` at every keyframe |
//! | `/odometry/live` | `PoseInFrame` | each image's pose as the odometry said it at once |
//! | `/odometry/status` | JSON | health, segment and standard deviation of ln(scale) with it |
//! | `/trajectory` | `PosesInFrame` | all camera poses |
//! | `/keyframes` | `SceneUpdate` | a frustum for each keyframe, again whenever it moves |
//! | `/landmarks` | `PointCloud` | landmarks of the odometry, per keyframe |
//! | `/map/mesh`, `/map/points` | `SceneUpdate` (triangles), `PointCloud` | of a surface that grows the patches (1 m) that changed, all of them at every tenth time and at the end; its points |
//! | `/log`, `/stages` | `Log`, JSON | warnings; seconds of each stage |
//!
//! Frames: `world` (z up where gravity is known), `camera` and `view` (x right, y down, z forward); metres where the run is metric.
//! Times are the recording's. Messages are written as they come; chunks of the file are not compressed, since every codec that the format
//! knows is a native library or slower than the run.

mod convert;
mod playback;
mod server;

use crate::error::ExportError;
use crate::patches::SurfacePatches;
use convert::{calibration, clock, cloud, frustum, jpeg, pose, stamp};
use foxglove::messages::{
    CameraCalibration, CompressedImage, FrameTransform, Log, PointCloud, PoseInFrame, PosesInFrame, RawImage,
    SceneEntity, SceneUpdate,
};
use foxglove::{Channel, Context, FoxgloveError, McapWriterHandle, RawChannel, Schema};
use serde::Serialize;
pub use server::{SceneServer, ServerError};
use std::fs::File;
use std::io::{self, BufWriter};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use vidar_core::{AlignedView, CameraModel, Image, Pinhole, Se3, Timestamp, TriangleMesh};

const FORMAT: &str = "MCAP";
/// The frames.
const WORLD: &str = "world";
const CAMERA: &str = "camera";
const VIEW: &str = "view";

/// What the odometry says with a pose.
#[derive(Clone, Debug, Serialize)]
pub struct SceneStatus<'a> {
    /// Of the image, ns.
    pub time_ns: i64,
    /// Poses of different segments have no common world.
    pub segment: u32,
    /// Health of the tracking.
    pub health: &'a str,
    /// Standard deviation of ln(scale); null where nothing is known of it.
    pub scale_std: Option<f64>,
}

/// The schema of [`SceneStatus`].
const STATUS_SCHEMA: &str = r#"{"type":"object","properties":{"time_ns":{"type":"integer"},"segment":{"type":"integer"},"health":{"type":"string"},"scale_std":{"type":["number","null"]}}}"#;
/// The schema of `/stages`.
const STAGE_SCHEMA: &str =
    r#"{"type":"object","properties":{"stage":{"type":"string"},"seconds":{"type":"number"}}}"#;

/// How bad a warning is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum LogLevel {
    /// The result is not affected.
    Info,
    /// It is worse than it could be.
    Warning,
}

/// A run that is being written for viewers.
pub struct Scene {
    path: PathBuf,
    /// Channels are closed when it goes.
    _context: Arc<Context>,
    file: McapWriterHandle<BufWriter<File>>,
    /// Time of the newest message, ns: what has no time of its own comes then.
    newest: u64,
    patches: SurfacePatches,
    camera_image: Channel<CompressedImage>,
    camera_calibration: Channel<CameraCalibration>,
    view_image: Channel<CompressedImage>,
    view_depth: Channel<RawImage>,
    view_calibration: Channel<CameraCalibration>,
    transforms: Channel<FrameTransform>,
    live: Channel<PoseInFrame>,
    status: Arc<RawChannel>,
    trajectory: Channel<PosesInFrame>,
    keyframes: Channel<SceneUpdate>,
    landmarks: Channel<PointCloud>,
    mesh: Channel<SceneUpdate>,
    points: Channel<PointCloud>,
    log: Channel<Log>,
    stages: Arc<RawChannel>,
}

impl Scene {
    /// Begins an MCAP file. What has no time of its own, such as a warning, has that of the newest image, or of `begin`: the recording's.
    ///
    /// # Errors
    /// The file exists or cannot be written.
    pub fn create(path: &Path, begin: Timestamp) -> Result<Self, ExportError> {
        let failed =
            |source: io::Error| ExportError::File { action: "create", path: path.to_owned(), source };
        let context = Context::new();
        let json = |topic: &str, name: &str, schema: &'static str| {
            let schema = Schema::new(name, "jsonschema", schema.as_bytes());
            context.channel_builder(topic).message_encoding("json").schema(schema).build_raw()
        };
        let writer = BufWriter::new(File::create_new(path).map_err(failed)?);
        let options = foxglove::McapWriteOptions::new().compression(None);
        let file = context.mcap_writer_with_options(options).create(writer);
        let other = |error: FoxgloveError| failed(io::Error::other(error));
        Ok(Self {
            path: path.to_owned(),
            _context: context.clone(),
            file: file.map_err(other)?,
            newest: clock(begin),
            patches: SurfacePatches::default(),
            camera_image: context.channel_builder("/camera/image").build(),
            camera_calibration: context.channel_builder("/camera/calibration").build(),
            view_image: context.channel_builder("/view/image").build(),
            view_depth: context.channel_builder("/view/depth").build(),
            view_calibration: context.channel_builder("/view/calibration").build(),
            transforms: context.channel_builder("/tf").build(),
            live: context.channel_builder("/odometry/live").build(),
            status: json("/odometry/status", "vidar.Status", STATUS_SCHEMA).map_err(other)?,
            trajectory: context.channel_builder("/trajectory").build(),
            keyframes: context.channel_builder("/keyframes").build(),
            landmarks: context.channel_builder("/landmarks").build(),
            mesh: context.channel_builder("/map/mesh").build(),
            points: context.channel_builder("/map/points").build(),
            log: context.channel_builder("/log").build(),
            stages: json("/stages", "vidar.Stage", STAGE_SCHEMA).map_err(other)?,
        })
    }

    /// Time of a message, which becomes the newest.
    fn at(&mut self, time: Timestamp) -> u64 {
        let nanos = clock(time);
        self.newest = self.newest.max(nanos);
        nanos
    }

    /// The pose of an image as the odometry said it at once, and what it said with it.
    pub fn live(&mut self, time: Timestamp, world_from_body: &Se3, status: &SceneStatus<'_>) {
        let at = self.at(time);
        let message = PoseInFrame {
            timestamp: Some(stamp(at)),
            frame_id: WORLD.into(),
            pose: Some(pose(world_from_body)),
        };
        self.live.log_with_time(&message, at);
        if let Ok(json) = serde_json::to_vec(status) {
            self.status.log_with_meta(&json, foxglove::PartialMetadata::with_log_time(at));
        }
    }

    /// The pose of the camera at an image.
    pub fn camera_pose(&mut self, time: Timestamp, world_from_camera: &Se3) {
        let at = self.at(time);
        self.transforms.log_with_time(&convert::transform(at, CAMERA, world_from_camera), at);
    }

    /// An image as it was taken: its file's bytes, or pixels, which are compressed.
    ///
    /// # Errors
    /// Pixels that cannot be compressed.
    pub fn image(
        &mut self,
        time: Timestamp,
        camera: &CameraModel,
        image: &SceneImage<'_>,
    ) -> Result<(), ExportError> {
        let at = self.at(time);
        let message = image.message(at, CAMERA)?;
        self.camera_image.log_with_time(&message, at);
        self.camera_calibration.log_with_time(&calibration(at, CAMERA, camera), at);
        Ok(())
    }

    /// A keyframe at its final pose, with colours and depth.
    ///
    /// # Errors
    /// Pixels that cannot be compressed.
    pub fn view(&mut self, view: &AlignedView) -> Result<(), ExportError> {
        let image = view.color().map(SceneImage::Pixels);
        let depth = Some(view.depth().image());
        self.posed_view(view.time(), view.world_from_camera(), view.intrinsics(), image, depth)
    }

    /// The same of its parts.
    ///
    /// # Errors
    /// As [`Scene::view`].
    pub fn posed_view(
        &mut self,
        time: Timestamp,
        world_from_camera: &Se3,
        intrinsics: &Pinhole,
        image: Option<SceneImage<'_>>,
        depth: Option<&Image<f32>>,
    ) -> Result<(), ExportError> {
        let at = self.at(time);
        self.transforms.log_with_time(&convert::transform(at, VIEW, world_from_camera), at);
        if let Some(image) = image {
            let message = image.message(at, VIEW)?;
            self.view_image.log_with_time(&message, at);
        }
        let model = CameraModel::Pinhole(*intrinsics);
        self.view_calibration.log_with_time(&calibration(at, VIEW, &model), at);
        if let Some(depth) = depth {
            self.view_depth.log_with_time(&convert::depth(at, VIEW, depth), at);
        }
        Ok(())
    }

    /// Frusta of keyframes, each by its number; one that was there before moves.
    pub fn keyframes<'a>(&mut self, camera: &Pinhole, poses: impl Iterator<Item = (u32, &'a Se3)>) {
        let at = self.newest;
        let entity = |(number, world_from_camera): (u32, &Se3)| SceneEntity {
            timestamp: Some(stamp(at)),
            frame_id: WORLD.into(),
            id: format!("keyframe {number}"),
            lines: vec![frustum(camera, world_from_camera)],
            ..SceneEntity::default()
        };
        let update = SceneUpdate { entities: poses.map(entity).collect(), deletions: vec![convert::all(at)] };
        self.keyframes.log_with_time(&update, at);
    }

    /// All camera poses.
    pub fn trajectory<'a>(&mut self, world_from_camera: impl Iterator<Item = &'a Se3>) {
        let at = self.newest;
        let poses = world_from_camera.map(pose).collect();
        let message = PosesInFrame { timestamp: Some(stamp(at)), frame_id: WORLD.into(), poses };
        self.trajectory.log_with_time(&message, at);
    }

    /// Landmarks of a keyframe: position in the world, m, and relative standard deviation of the distance.
    pub fn landmarks(&mut self, time: Timestamp, landmarks: impl Iterator<Item = ([f32; 3], f32)>) {
        let at = self.at(time);
        let rows = landmarks.map(|([x, y, z], std)| [x, y, z, std]);
        self.landmarks.log_with_time(&cloud(at, WORLD, ["x", "y", "z", "relative_std"], rows), at);
    }

    /// The surface, as triangles: every viewer draws them where they are, while models of glTF are turned by some. Of one that
    /// grows, what changed.
    pub fn mesh(&mut self, mesh: &TriangleMesh, is_final: bool) {
        let at = self.newest;
        let change = self.patches.change(mesh, is_final);
        if !change.patches.is_empty() {
            self.mesh.log_with_time(&convert::surface(at, WORLD, &change), at);
        }
    }

    /// The surface's points.
    pub fn points(&mut self, points: &vidar_core::PointCloud) {
        let at = self.newest;
        self.points.log_with_time(&convert::colored(at, WORLD, points), at);
    }

    /// Something that the user should know.
    pub fn log(&mut self, level: LogLevel, name: &str, message: &str) {
        let at = self.newest;
        self.log.log_with_time(&convert::log(at, level, name, message), at);
    }

    /// How long a stage took.
    pub fn stage(&mut self, stage: &str, seconds: f64) {
        if let Ok(json) = serde_json::to_vec(&serde_json::json!({ "stage": stage, "seconds": seconds })) {
            self.stages.log_with_meta(&json, foxglove::PartialMetadata::with_log_time(self.newest));
        }
    }

    /// Ends the file; its size, bytes.
    ///
    /// # Errors
    /// It could not be written to its end.
    pub fn finish(self) -> Result<u64, ExportError> {
        let failed =
            |source: io::Error| ExportError::File { action: "write", path: self.path.clone(), source };
        let writer = self.file.close().map_err(|e| failed(io::Error::other(e)))?;
        let file = writer.into_inner().map_err(|e| failed(e.into_error()))?;
        file.metadata().map(|m| m.len()).map_err(failed)
    }
}

/// An image to be shown.
#[derive(Clone, Copy, Debug)]
pub enum SceneImage<'a> {
    /// The bytes of a file, and its format: `jpeg`, `png` or `webp`.
    Encoded(&'a [u8], &'static str),
    /// Pixels, which become a JPEG.
    Pixels(&'a Image<[u8; 3]>),
}

impl SceneImage<'_> {
    fn message(&self, at: u64, frame: &str) -> Result<CompressedImage, ExportError> {
        let (data, format) = match self {
            Self::Encoded(bytes, format) => (bytes.to_vec(), *format),
            Self::Pixels(image) => (jpeg(image)?, "jpeg"),
        };
        Ok(CompressedImage {
            timestamp: Some(stamp(at)),
            frame_id: frame.into(),
            data: data.into(),
            format: format.into(),
        })
    }
}
