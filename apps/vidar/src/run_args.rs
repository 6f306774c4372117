//! The command line of `vidar run`, which `vidar live` takes, too.

use crate::link_args::LinkArgs;
use crate::model_args::LicenceArgs;
use crate::shared_args::{BudgetArgs, ConfigArgs, InputArgs, OutputArgs};
use clap::{Args, ValueHint};
use std::path::PathBuf;
use vidar::da3::Device;

/// `vidar run`.
#[derive(Args, Clone, Debug)]
pub struct WholeRunArgs {
    /// What `vidar live` has, too.
    #[command(flatten)]
    pub run: RunArgs,
    /// How long it may take.
    #[command(flatten)]
    pub budget: BudgetArgs,
}

/// What `vidar run` and `vidar live` have in common.
#[derive(Args, Clone, Debug)]
pub struct RunArgs {
    /// The recording: a bag, a video, or a folder (EuRoC, TUM RGB-D, 7-Scenes, KITTI, a phone's, posed folder, images, …).
    #[arg(value_hint = ValueHint::AnyPath)]
    pub path: PathBuf,
    /// How the input is read.
    #[command(flatten)]
    pub input: InputArgs,
    /// How settings are given.
    #[command(flatten)]
    pub config: ConfigArgs,
    /// Where results go.
    #[command(flatten)]
    pub output: OutputArgs,
    /// Source of depth: auto (stereo, completed), stereo, a network of `vidar model list` such as da3-small, recorded:DIR, or remote:KEY,
    /// the network of the `vidar worker`s under that key.
    #[arg(long, visible_alias = "model", value_name = "NAME", help_heading = "Model")]
    pub geometry: Option<String>,
    /// How other machines are reached.
    #[command(flatten)]
    pub link: LinkArgs,
    /// Coupling of depth and metric poses: coupled, hybrid, pose-conditioned, ground-truth, pose-free, da3-streaming.
    #[arg(long, value_name = "MODE", help_heading = "Model")]
    pub mode: Option<String>,
    /// Folder with model.safetensors and config.json, for custom weights.
    #[arg(long, value_hint = ValueHint::AnyPath, help_heading = "Model")]
    pub model_dir: Option<PathBuf>,
    /// Device that runs the network: cpu, gpu, gpu:N or auto; `vidar doctor` lists graphics processors.
    #[arg(long, value_name = "DEVICE", help_heading = "Model")]
    pub device: Option<Device>,
    /// Acceptance of a licence.
    #[command(flatten)]
    pub licence: LicenceArgs,
    /// Folder of an earlier `vidar odometry` or `vidar run` of the same place: the map is in the world of that recording.
    #[arg(long, value_name = "FOLDER", value_hint = ValueHint::AnyPath, help_heading = "Input")]
    pub map: Option<String>,
    /// Folder of masks, black where an image is not to be used, as COLMAP and nerfstudio have them: people who move, the camera's
    /// carrier. A mask is called as its image is: NAME.EXT.png or NAME.png.
    #[arg(long, value_name = "FOLDER", value_hint = ValueHint::DirPath, help_heading = "Input")]
    pub masks: Option<String>,
    /// Reference cloud (PLY, metres, world frame of the ground truth) for the evaluation of the map.
    #[arg(long, value_hint = ValueHint::FilePath, help_heading = "Input")]
    pub reference: Option<PathBuf>,
    /// MCAP file that shows the run in Foxglove or Rerun, written while it runs; it must not exist.
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath, help_heading = "Output")]
    pub mcap: Option<PathBuf>,
    /// Print the plan and stop.
    #[arg(long)]
    pub dry_run: bool,
    /// Memory limit for planning, such as 4GiB or 800MB; default: the sum of the parts.
    #[arg(long, value_name = "SIZE", help_heading = "Model")]
    pub memory_budget: Option<String>,
    /// Continue an interrupted run in the folder of -o; valid results in it are not computed again.
    #[arg(long, requires = "output", conflicts_with = "force", help_heading = "Output")]
    pub resume: bool,
    /// End with status 5 when a score is above its bound: ate, scale, chamfer (e.g. ate=0.1). Repeatable.
    #[arg(long, value_name = "NAME=VALUE")]
    pub fail_above: Vec<String>,
    /// End with status 5 when a score is below its bound: f@0.05, f@0.10, … of the rigid fit (e.g. f@0.05=0.5). Repeatable.
    #[arg(long, value_name = "NAME=VALUE")]
    pub fail_below: Vec<String>,
}
