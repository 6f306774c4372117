//! The command line of `vidar synth`, and the synthetic world of `vidar demo`.

use clap::{Args, ValueHint};
use std::path::PathBuf;

/// The synthetic world.
#[derive(Args, Clone, Debug, Default)]
pub struct WorldArgs {
    /// Seed of all random numbers.
    #[arg(long, help_heading = "World")]
    pub seed: Option<u64>,
    /// room, hall or corridor.
    #[arg(long, help_heading = "World")]
    pub scene: Option<String>,
    /// sweep, orbit, aggressive, handheld or handheld-lively.
    #[arg(long, help_heading = "World")]
    pub flight: Option<String>,
    /// Length, seconds.
    #[arg(long, help_heading = "World")]
    pub duration: Option<f64>,
    /// Stand still for this many seconds first; default: moving from the first frame.
    #[arg(long, help_heading = "World")]
    pub static_start: Option<f64>,
}

/// `vidar synth`.
#[derive(Args, Clone, Debug)]
pub struct SynthArgs {
    /// Folder of the sequence; must not exist.
    #[arg(value_hint = ValueHint::DirPath)]
    pub out: PathBuf,
    /// The synthetic world.
    #[command(flatten)]
    pub world: WorldArgs,
    /// Fly along this trajectory (TUM or EuRoC csv) instead of a built-in flight.
    #[arg(long, value_hint = ValueHint::FilePath)]
    pub trajectory: Option<PathBuf>,
    /// Image size and rates of EuRoC: 752x480 at 20 Hz, static start, 60 s.
    #[arg(long, conflicts_with_all = ["preset", "world_config"])]
    pub euroc: bool,
    /// Settings to start from: demo, euroc, phone-slow, phone-fast, realsense, or tumvi (with --trajectory).
    #[arg(long, value_name = "NAME", conflicts_with = "world_config")]
    pub preset: Option<String>,
    /// TOML file with every setting of the world.
    #[arg(long, value_hint = ValueHint::FilePath)]
    pub world_config: Option<PathBuf>,
    /// Image size, such as 1280x720; a lens given in pixels is scaled with the width.
    #[arg(long, value_name = "WxH", help_heading = "Recording")]
    pub size: Option<String>,
    /// Frames per second.
    #[arg(long, value_name = "HZ", help_heading = "Recording")]
    pub frame_rate: Option<f64>,
    /// IMU samples per second.
    #[arg(long, value_name = "HZ", help_heading = "Recording")]
    pub imu_rate: Option<f64>,
    /// Rolling shutter: milliseconds from the first row to the last.
    #[arg(long, value_name = "MS", help_heading = "Recording")]
    pub readout_ms: Option<f64>,
    /// Milliseconds by which image stamps are late (negative: early).
    #[arg(long, value_name = "MS", allow_negative_numbers = true, help_heading = "Recording")]
    pub stamp_delay_ms: Option<f64>,
    /// Calibration files that are written: given, partial (focal length only) or absent.
    #[arg(long, value_name = "WHICH", help_heading = "Recording")]
    pub calibration: Option<String>,
    /// Share of the surface without texture, 0 to 1.
    #[arg(long, value_name = "SHARE", help_heading = "Recording")]
    pub bare_share: Option<f64>,
}
