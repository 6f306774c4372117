//! The command lines of `vidar plan` and `vidar work`.

use crate::shared_args::{ConfigArgs, InputArgs};
use clap::{Args, ValueEnum, ValueHint};
use std::path::PathBuf;
use vidar::batch::Stage;
use vidar::da3::Device;

/// `vidar plan`.
#[derive(Args, Clone, Debug)]
pub struct PlanArgs {
    /// The recordings; workers must find them at the same absolute paths.
    #[arg(value_name = "RECORDING", required = true, value_hint = ValueHint::AnyPath)]
    pub recordings: Vec<PathBuf>,
    /// Where plan and results go: a folder that all workers share, or s3://bucket/prefix (built with --features s3).
    #[arg(long, value_name = "ADDRESS", help_heading = "Output")]
    pub store: String,
    /// Into how many tasks the chunks of each recording are divided.
    #[arg(long, value_name = "N", default_value_t = 4)]
    pub parts: usize,
    /// How every recording is read.
    #[command(flatten)]
    pub input: InputArgs,
    /// How settings are given.
    #[command(flatten)]
    pub config: ConfigArgs,
    /// Source of depth, as of `vidar run`.
    #[arg(long, visible_alias = "model", value_name = "NAME", help_heading = "Model")]
    pub geometry: Option<String>,
    /// Coupling of depth and metric poses, as of `vidar run`.
    #[arg(long, value_name = "MODE", help_heading = "Model")]
    pub mode: Option<String>,
    /// Folder with model.safetensors and config.json, for custom weights; every worker must find it there.
    #[arg(long, value_hint = ValueHint::AnyPath, help_heading = "Model")]
    pub model_dir: Option<PathBuf>,
    /// Device that runs the network on every worker: cpu, gpu, gpu:N or auto.
    #[arg(long, value_name = "DEVICE", help_heading = "Model")]
    pub device: Option<Device>,
}

/// A stage of a plan.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum StageArg {
    /// Calibration and odometry; one task for each recording.
    Track,
    /// Depth; as many tasks for each recording as --parts of the plan.
    Predict,
    /// Alignment, fusion, evaluation and files; one task for each recording.
    Map,
    /// One table over all recordings; one task.
    Report,
}

impl From<StageArg> for Stage {
    fn from(stage: StageArg) -> Self {
        match stage {
            StageArg::Track => Self::Track,
            StageArg::Predict => Self::Predict,
            StageArg::Map => Self::Map,
            StageArg::Report => Self::Report,
        }
    }
}

/// `vidar work`.
#[derive(Args, Clone, Debug)]
pub struct WorkArgs {
    /// The address that `vidar plan` printed.
    #[arg(long, value_name = "ADDRESS")]
    pub plan: String,
    /// The stage.
    #[arg(long, value_enum)]
    pub stage: StageArg,
    /// The task of that stage, from 0: SLURM_ARRAY_TASK_ID, JOB_COMPLETION_INDEX, ….
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub index: usize,
    /// Folder for what is on its way; default: the system's folder for temporary files. It is left empty.
    #[arg(long, value_hint = ValueHint::DirPath, help_heading = "Output")]
    pub scratch: Option<PathBuf>,
}
