//! The command line of `vidar bench`.

use crate::shared_args::ConfigArgs;
use clap::{Args, ValueEnum, ValueHint};
use std::path::PathBuf;

/// `vidar bench`.
#[derive(Args, Clone, Debug)]
pub struct BenchArgs {
    /// Which dataset.
    #[arg(value_enum)]
    pub dataset: BenchDataset,
    /// Folder of the unpacked dataset. With --synthetic only its ground truth is used, as flight path.
    #[arg(value_hint = ValueHint::DirPath)]
    pub root: Option<PathBuf>,
    /// Render the sequences (EuRoC's camera and IMU) instead of reading images.
    #[arg(long, help_heading = "World")]
    pub synthetic: bool,
    /// TOML file with every setting of the rendered worlds.
    #[arg(long, value_hint = ValueHint::FilePath, requires = "synthetic", help_heading = "World")]
    pub world_config: Option<PathBuf>,
    /// Sequences to run, as prefixes of their names separated by commas; default: all.
    #[arg(long, value_delimiter = ',', help_heading = "Input")]
    pub sequences: Vec<String>,
    /// Couplings to compare, separated by commas; default: those of the paper's tables that the geometry source supports, and coupled.
    #[arg(long, value_delimiter = ',', help_heading = "Model")]
    pub modes: Vec<String>,
    /// Source of depth: as for `vidar run`, or simulated (with --synthetic: a network's errors on true depth).
    #[arg(long, visible_alias = "model", value_name = "NAME", help_heading = "Model")]
    pub geometry: Option<String>,
    /// Folder with model.safetensors and config.json, for custom weights.
    #[arg(long, value_hint = ValueHint::AnyPath, help_heading = "Model")]
    pub model_dir: Option<PathBuf>,
    /// Omit the rows of the odometry in Table I.
    #[arg(long, help_heading = "Output")]
    pub no_trajectories: bool,
    /// Instead of the paper's tables, each coupling with and without landmarks, stereo points and loops on the same
    /// keyframes and predictions; takes no --modes.
    #[arg(long, requires = "synthetic", conflicts_with = "modes", help_heading = "Model")]
    pub ablation: bool,
    /// Seeds of rooms, noise and simulated networks over which --ablation takes median and spread.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=100), help_heading = "World")]
    pub seeds: u64,
    /// How settings are given.
    #[command(flatten)]
    pub config: ConfigArgs,
    /// Folder of runs and tables; an existing one is continued.
    #[arg(short, long, value_hint = ValueHint::DirPath, default_value = "bench", help_heading = "Output")]
    pub output: PathBuf,
}

/// A dataset that `vidar bench` supports.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum BenchDataset {
    /// EuRoC MAV: a folder with mav0/ per sequence.
    Euroc,
    /// TUM RGB-D: rgbd_dataset_*/.
    Tum,
    /// TUM-VI: dataset-*_512_16/ with mav0/.
    TumVi,
    /// 7-Scenes: a folder per scene with seq-01/ ….
    #[value(name = "7scenes")]
    SevenScenes,
}
