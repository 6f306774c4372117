//! Options for reading datasets and trajectories.

use crate::error::DatasetError;
use std::fmt;
use std::path::PathBuf;
use std::str::FromStr;
use vidar_core::{BodyFrame, CameraId, CameraModel, Duration, Se3, Timestamp};
use vidar_video::VideoDecoder;

/// Layouts of datasets.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum RecordingKind {
    /// EuRoC's ASL folders (`mav0/cam0/data.csv`, …).
    EurocAsl,
    /// TUM RGB-D (`rgb.txt`, `depth.txt`, `groundtruth.txt`, `accelerometer.txt`).
    TumRgbd,
    /// 7-Scenes (`frame-000000.color.png`, `.depth.png`, `.pose.txt`).
    SevenScenes,
    /// `images/`, `poses.txt`, `K.txt`, and perhaps `depth/`.
    PosedFolder,
    /// A ROS 1 bag, a ROS 2 bag or an MCAP file.
    Bag,
    /// An mp4 or mov, with the telemetry of an action camera where there is any.
    Video,
    /// Stray Scanner on iOS (`rgb.mp4`, `odometry.csv`, `camera_matrix.csv`, …).
    StrayScanner,
    /// Spectacular AI (`data.jsonl`, `data.mp4`, `calibration.json`).
    SpectacularAi,
    /// A table of gyroscope and accelerometer beside a video or a folder of frames, as loggers of phones write it.
    ImuLog,
    /// KITTI raw (`image_00/data`, `oxts/`, `calib_cam_to_cam.txt`).
    KittiRaw,
    /// KITTI odometry (`image_0`, `times.txt`, `calib.txt`).
    KittiOdometry,
    /// Replica as NICE-SLAM renders it (`results/frame000000.jpg`, `traj.txt`, `cam_params.json`).
    Replica,
    /// ICL-NUIM (`rgb/`, `depth/`, `associations.txt`, `*.gt.freiburg`).
    IclNuim,
    /// Images in one folder, with or without a file of times.
    ImageFolder,
}

impl RecordingKind {
    /// Every kind, in the order in which a path is tried.
    pub const ALL: [Self; 14] = [
        Self::EurocAsl,
        Self::TumRgbd,
        Self::SevenScenes,
        Self::KittiRaw,
        Self::KittiOdometry,
        Self::Replica,
        Self::IclNuim,
        Self::PosedFolder,
        Self::Bag,
        Self::StrayScanner,
        Self::SpectacularAi,
        Self::ImuLog,
        Self::Video,
        Self::ImageFolder,
    ];

    /// The name used on the command line and in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::EurocAsl => "euroc",
            Self::TumRgbd => "tum-rgbd",
            Self::SevenScenes => "7scenes",
            Self::PosedFolder => "posed-folder",
            Self::Bag => "bag",
            Self::Video => "video",
            Self::StrayScanner => "stray-scanner",
            Self::SpectacularAi => "spectacular-ai",
            Self::ImuLog => "imu-log",
            Self::KittiRaw => "kitti-raw",
            Self::KittiOdometry => "kitti",
            Self::Replica => "replica",
            Self::IclNuim => "icl-nuim",
            Self::ImageFolder => "images",
        }
    }
}

impl fmt::Display for RecordingKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for RecordingKind {
    type Err = DatasetError;
    fn from_str(text: &str) -> Result<Self, DatasetError> {
        by_name("format", text, &Self::ALL, |k| k.name())
    }
}

/// Formats of trajectory files.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum TrajectoryFormat {
    /// `seconds tx ty tz qx qy qz qw`.
    Tum,
    /// `nanoseconds, px, py, pz, qw, qx, qy, qz, …`.
    EurocCsv,
    /// Twelve numbers of a row-major 3×4 matrix, without time.
    Kitti,
}

impl TrajectoryFormat {
    /// Every format.
    pub const ALL: [Self; 3] = [Self::Tum, Self::EurocCsv, Self::Kitti];

    /// The name used on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Tum => "tum",
            Self::EurocCsv => "euroc",
            Self::Kitti => "kitti",
        }
    }
}

impl fmt::Display for TrajectoryFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for TrajectoryFormat {
    type Err = DatasetError;
    fn from_str(text: &str) -> Result<Self, DatasetError> {
        by_name("trajectory format", text, &Self::ALL, |k| k.name())
    }
}

/// Units in which a file writes its times.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum TimeUnit {
    /// s
    Seconds,
    /// ms
    Milliseconds,
    /// µs
    Microseconds,
    /// ns
    Nanoseconds,
}

impl TimeUnit {
    /// Every unit, largest first.
    pub const ALL: [Self; 4] = [Self::Seconds, Self::Milliseconds, Self::Microseconds, Self::Nanoseconds];

    /// The name used on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Seconds => "s",
            Self::Milliseconds => "ms",
            Self::Microseconds => "us",
            Self::Nanoseconds => "ns",
        }
    }

    /// One second is 10 to this many units.
    pub fn digits(self) -> u32 {
        match self {
            Self::Seconds => 0,
            Self::Milliseconds => 3,
            Self::Microseconds => 6,
            Self::Nanoseconds => 9,
        }
    }
}

impl fmt::Display for TimeUnit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for TimeUnit {
    type Err = DatasetError;
    fn from_str(text: &str) -> Result<Self, DatasetError> {
        by_name("time unit", text, &Self::ALL, |k| k.name())
    }
}

/// The body of a trajectory by its name: `imu` (or `body`), `camera0` (or `cam0`), `camera1`, ….
///
/// # Errors
/// [`DatasetError::BadOption`].
pub fn body_named(text: &str) -> Result<BodyFrame, DatasetError> {
    if matches!(text, "imu" | "body") {
        return Ok(BodyFrame::Imu);
    }
    let number = text.strip_prefix("camera").or_else(|| text.strip_prefix("cam"));
    number.and_then(|n| n.parse().ok()).map(|n| BodyFrame::Camera(CameraId(n))).ok_or_else(|| {
        let expected = "imu, camera0, camera1, …".to_string();
        DatasetError::BadOption { option: "trajectory body", found: format!("{text:?}"), expected }
    })
}

/// The decoder of videos by its name.
///
/// # Errors
/// [`DatasetError::BadOption`].
pub fn decoder_named(text: &str) -> Result<VideoDecoder, DatasetError> {
    match text {
        "built-in" => Ok(VideoDecoder::BuiltIn),
        "ffmpeg" => Ok(VideoDecoder::Ffmpeg),
        _ => Err(DatasetError::BadOption {
            option: "decoder",
            found: format!("{text:?}"),
            expected: "built-in or ffmpeg".to_string(),
        }),
    }
}

fn by_name<T: Copy>(
    option: &'static str,
    text: &str,
    all: &[T],
    name: impl Fn(T) -> &'static str,
) -> Result<T, DatasetError> {
    all.iter().copied().find(|&k| name(k).eq_ignore_ascii_case(text.trim())).ok_or_else(|| {
        let names: Vec<_> = all.iter().map(|&k| name(k)).collect();
        DatasetError::BadOption {
            option,
            found: format!("{text:?}"),
            expected: format!("one of {}", names.join(", ")),
        }
    })
}

/// Options for opening a dataset. By default everything is taken from the dataset itself.
#[derive(Clone, Debug, PartialEq)]
pub struct OpenOptions {
    /// The layout; `None` detects it.
    pub format: Option<RecordingKind>,
    /// The camera whose images are read, as the dataset numbers it (`cam0`, `cam1`, …).
    pub camera: CameraId,
    /// Calibration files: EuRoC `sensor.yaml`, Kalibr camchain, Kalibr imu yaml. They override the dataset's own.
    pub calibration: Vec<PathBuf>,
    /// Model of the chosen (grey or colour) camera; overrides every file. Size 0×0 means "the size of its images".
    /// Text such as `pinhole:525,525,319.5,239.5` becomes one through [`crate::CameraFlag`].
    pub camera_model: Option<CameraModel>,
    /// `[fx, fy, cx, cy]` of the depth camera, pixels of its own images.
    pub depth_intrinsics: Option<[f64; 4]>,
    /// Raw units of the depth images per metre (1000: millimetres, 5000: TUM).
    pub depth_scale: Option<f64>,
    /// Maps points in the depth camera to the chosen colour camera.
    pub color_from_depth: Option<Se3>,
    /// A metric trajectory of the same recording, used as poses of the map.
    pub trajectory: Option<PathBuf>,
    /// Its format; `None` detects it.
    pub trajectory_format: Option<TrajectoryFormat>,
    /// The body whose poses it holds.
    pub trajectory_body: Option<BodyFrame>,
    /// Topics of a bag to use, where they are not clear by themselves.
    pub topics: Vec<TopicFlag>,
    /// Who decodes videos.
    pub decoder: VideoDecoder,
    /// Tables of gyroscope and accelerometer, in one file or in two, for a video or a folder of images.
    pub imu: Vec<PathBuf>,
    /// A file of image times (image folders).
    pub timestamps: Option<PathBuf>,
    /// Unit of the times in image lists and file names; `None` detects it.
    pub time_unit: Option<TimeUnit>,
    /// Leaves out what is earlier than this after the first image.
    pub start: Option<Duration>,
    /// Leaves out what is later than this after the first image.
    pub end: Option<Duration>,
    /// Takes every n-th image, from 1.
    pub stride: usize,
}

impl Default for OpenOptions {
    fn default() -> Self {
        Self {
            format: None,
            camera: CameraId(0),
            calibration: Vec::new(),
            camera_model: None,
            depth_intrinsics: None,
            depth_scale: None,
            color_from_depth: None,
            trajectory: None,
            trajectory_format: None,
            trajectory_body: None,
            topics: Vec::new(),
            decoder: VideoDecoder::default(),
            imu: Vec::new(),
            timestamps: None,
            time_unit: None,
            start: None,
            end: None,
            stride: 1,
        }
    }
}

impl OpenOptions {
    /// Checks the values that can be checked without a dataset.
    pub fn validate(&self) -> Result<(), DatasetError> {
        let bad = |option, found: String, expected: &str| {
            Err(DatasetError::BadOption { option, found, expected: expected.into() })
        };
        if self.stride == 0 {
            return bad("stride", "0".into(), "1 or more");
        }
        if let Some(scale) = self.depth_scale
            && !(scale.is_finite() && scale > 0.0)
        {
            return bad("depth scale", scale.to_string(), "finite and positive raw units per metre");
        }
        if let (Some(start), Some(end)) = (self.start, self.end)
            && end <= start
        {
            return bad("end", end.to_string(), &format!("later than start ({start})"));
        }
        if let Some(motion) = &self.color_from_depth
            && !motion.is_finite()
        {
            return bad("color from depth", "a value that is not finite".into(), "finite numbers");
        }
        Ok(())
    }
}

/// A topic that the user names: `/cam0/image_raw`, or `truth=/vicon/pose` where the type does not say what it is for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TopicFlag {
    /// What its poses are used as; `None` for images, depth and IMU, whose use follows from their type.
    pub poses: Option<PoseUse>,
    /// Its name.
    pub name: String,
}

/// What the poses of a topic are used as.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PoseUse {
    /// Reference poses that results are compared with.
    GroundTruth,
    /// The metric trajectory of a map.
    Trajectory,
}

impl FromStr for TopicFlag {
    type Err = DatasetError;
    fn from_str(text: &str) -> Result<Self, DatasetError> {
        let (poses, name) = match text.split_once('=') {
            None => (None, text),
            Some(("truth", name)) => (Some(PoseUse::GroundTruth), name),
            Some(("trajectory", name)) => (Some(PoseUse::Trajectory), name),
            Some(_) => (None, ""),
        };
        if name.trim().is_empty() {
            let expected = "NAME, truth=NAME or trajectory=NAME".to_string();
            return Err(DatasetError::BadOption { option: "topic", found: format!("{text:?}"), expected });
        }
        Ok(Self { poses, name: name.trim().to_string() })
    }
}

/// How to read a trajectory file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TrajectoryReadOptions {
    /// The format; `None` detects it.
    pub format: Option<TrajectoryFormat>,
    /// The body whose poses they are; `None`: that of the file's header, else the IMU for EuRoC csv and TUM, camera 0 for KITTI.
    pub body: Option<BodyFrame>,
    /// Unit of time; `None`: that of the format, unless the numbers are implausible in it.
    pub time_unit: Option<TimeUnit>,
    /// One time per pose, for KITTI files.
    pub times: Option<Vec<Timestamp>>,
}
