//! What several verbs are told: the recording, settings, where results go.

use clap::{ArgAction, Args, ValueHint};
use std::path::PathBuf;

/// How the input is read.
// The plan of a batch keeps it as it was typed.
#[derive(Args, Clone, Debug, Default, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InputArgs {
    /// Layout of the recording, instead of detecting it: euroc, tum-rgbd, 7scenes, kitti-raw, kitti, replica, icl-nuim,
    /// posed-folder, bag, stray-scanner, spectacular-ai, imu-log, video, images.
    #[arg(long, help_heading = "Input")]
    pub format: Option<String>,
    /// Number of the camera (`cam0` is 0).
    #[arg(long, help_heading = "Input")]
    pub camera: Option<u32>,
    /// Calibration: EuRoC sensor.yaml, Kalibr camchain or imu yaml. Repeatable.
    #[arg(long, value_hint = ValueHint::FilePath, help_heading = "Input")]
    pub calibration: Vec<PathBuf>,
    /// Topic of a bag to use: NAME for images, depth or IMU; truth=NAME or trajectory=NAME for poses. Repeatable.
    #[arg(long = "topic", value_name = "NAME", action = ArgAction::Append, help_heading = "Input")]
    pub topics: Vec<String>,
    /// Who decodes videos: built-in, or ffmpeg, the program of that name on this machine (5.1 or newer), for codecs and containers that
    /// the built-in decoders refuse.
    #[arg(long, help_heading = "Input")]
    pub decoder: Option<String>,
    /// Camera model of the images: pinhole:fx,fy,cx,cy  radtan:…,k1,k2,p1,p2(,k3)  kb4:…,k1,k2,k3,k4  ds:…,xi,alpha  fov:…,w.
    #[arg(long, allow_hyphen_values = true, help_heading = "Input")]
    pub camera_model: Option<String>,
    /// Metric trajectory of the same recording, used instead of VIDAR's own odometry.
    #[arg(long, value_hint = ValueHint::FilePath, help_heading = "Input")]
    pub trajectory: Option<PathBuf>,
    /// Format of --trajectory, instead of detecting it: tum, euroc, kitti.
    #[arg(long, help_heading = "Input")]
    pub trajectory_format: Option<String>,
    /// Body whose poses --trajectory holds: imu, or camera0, camera1, ….
    #[arg(long, help_heading = "Input")]
    pub trajectory_body: Option<String>,
    /// Table of gyroscope and accelerometer (csv), for a video or a folder of images; twice for one of each.
    #[arg(long, value_hint = ValueHint::FilePath, action = ArgAction::Append, help_heading = "Input")]
    pub imu: Vec<PathBuf>,
    /// File of image times, for image folders.
    #[arg(long, value_hint = ValueHint::FilePath, help_heading = "Input")]
    pub timestamps: Option<PathBuf>,
    /// Unit of image times, instead of detecting it: s, ms, us, ns.
    #[arg(long, help_heading = "Input")]
    pub time_unit: Option<String>,
    /// Intrinsics of the depth camera, pixels: fx,fy,cx,cy.
    #[arg(long, allow_hyphen_values = true, help_heading = "Input")]
    pub depth_intrinsics: Option<String>,
    /// Raw depth units per metre (1000: millimetres, 5000: TUM).
    #[arg(long, help_heading = "Input")]
    pub depth_scale: Option<f64>,
    /// Pose of the depth camera in the colour camera: tx,ty,tz in metres, optionally ,qx,qy,qz,qw.
    #[arg(long, allow_hyphen_values = true, help_heading = "Input")]
    pub color_from_depth: Option<String>,
    /// Start, seconds after the first image.
    #[arg(long, help_heading = "Input")]
    pub start: Option<f64>,
    /// End, seconds after the first image.
    #[arg(long, help_heading = "Input")]
    pub end: Option<f64>,
    /// Use every n-th image only.
    #[arg(long, help_heading = "Input")]
    pub stride: Option<usize>,
}

/// How settings are given.
#[derive(Args, Clone, Debug, Default)]
pub struct ConfigArgs {
    /// Preset; `vidar config presets` lists them.
    #[arg(long, help_heading = "Settings")]
    pub preset: Option<String>,
    /// TOML file of settings; overrides the preset.
    #[arg(long, value_hint = ValueHint::FilePath, help_heading = "Settings")]
    pub config: Option<PathBuf>,
    /// One setting: section.key=value. Repeatable; overrides files.
    #[arg(long = "set", value_name = "KEY=VALUE", action = ArgAction::Append, help_heading = "Settings")]
    pub set: Vec<String>,
}

/// Where results go.
#[derive(Args, Clone, Debug, Default)]
pub struct OutputArgs {
    /// Output folder; default `runs/<name>/<time>/` with a `latest` link.
    #[arg(short, long, value_hint = ValueHint::DirPath, help_heading = "Output")]
    pub output: Option<PathBuf>,
    /// Rename an existing output folder instead of failing.
    #[arg(long, help_heading = "Output")]
    pub force: bool,
}

/// How long a run may take.
#[derive(Args, Clone, Debug)]
pub struct BudgetArgs {
    /// Cut down stereo so that the run takes no longer than the recording, on two quiet cores of the machine of BENCHMARK.md
    /// (`budget.speed` tells of others). The same command makes the same map on every machine.
    #[arg(long, conflicts_with = "time_budget", help_heading = "Model")]
    pub realtime: bool,
    /// The same with a limit in seconds.
    #[arg(long, value_name = "SECONDS", help_heading = "Model")]
    pub time_budget: Option<f64>,
}
