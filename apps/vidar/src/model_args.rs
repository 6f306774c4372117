//! Flags of `vidar model` and `vidar depth`.

use crate::shared_args::OutputArgs;
use clap::{Args, Subcommand, ValueEnum, ValueHint};
use std::path::PathBuf;
use vidar::da3::Device;

/// `vidar model`.
#[derive(Debug, Subcommand)]
pub enum ModelCommand {
    /// List the official checkpoints: licence, size, abilities, and whether they are installed.
    #[command(after_help = "Examples:\n  vidar model list\n  vidar model list --json")]
    List,
    /// Fetch a checkpoint from the hub; an interrupted transfer is continued.
    #[command(
        after_help = "Examples:\n  vidar model pull da3-small\n  vidar model pull da3-large-1.1 --accept-licence CC-BY-NC-4.0\n  HF_ENDPOINT=https://mirror.example vidar model pull da3-base"
    )]
    Pull(PullArgs),
    /// Copy a checkpoint that is on this machine already.
    #[command(
        after_help = "Examples:\n  vidar model import model.safetensors\n  vidar model import DA3-SMALL/\n  vidar model import giant.safetensors --model da3-giant-1.1 --accept-licence CC-BY-NC-4.0"
    )]
    Import(ImportArgs),
    /// Read every byte of a checkpoint and compare lengths and SHA-256.
    #[command(after_help = "Examples:\n  vidar model verify\n  vidar model verify da3-small")]
    Verify {
        /// Name of the checkpoint; default: all installed ones.
        name: Option<String>,
    },
    /// Compare the network, layer by layer, with reference files.
    #[command(
        after_help = "Examples:\n  vidar model check goldens/\n  vidar model check small.safetensors --precision bf16\n  vidar model check small.safetensors --model-dir DA3-SMALL/"
    )]
    Check(CheckArgs),
    /// Print the folder of a checkpoint, or of all.
    #[command(after_help = "Examples:\n  vidar model where\n  vidar model where da3-small")]
    Where {
        /// Name of the checkpoint; default: the folder of all.
        name: Option<String>,
    },
}

/// Acceptance of a licence.
#[derive(Args, Clone, Debug, Default)]
pub struct LicenceArgs {
    /// Accept the licence of the weights, named in full (CC-BY-NC-4.0); the acceptance is recorded next to them.
    #[arg(long, value_name = "LICENCE", help_heading = "Model")]
    pub accept_licence: Option<String>,
    /// Name of the person who accepts; default: the user of this system.
    #[arg(long, value_name = "NAME", help_heading = "Model")]
    pub accepted_by: Option<String>,
}

/// `vidar model pull`.
#[derive(Args, Clone, Debug)]
pub struct PullArgs {
    /// Name of the checkpoint.
    pub name: String,
    /// Acceptance of a licence.
    #[command(flatten)]
    pub licence: LicenceArgs,
    /// Another commit or branch of its repository; hashes are then those of the hub.
    #[arg(long)]
    pub revision: Option<String>,
    /// Fetch again, even if it is installed.
    #[arg(long)]
    pub again: bool,
}

/// `vidar model import`.
#[derive(Args, Clone, Debug)]
pub struct ImportArgs {
    /// `model.safetensors`, or a folder with it and `config.json`.
    #[arg(value_hint = ValueHint::AnyPath)]
    pub path: PathBuf,
    /// Name of the checkpoint, if its SHA-256 does not identify it.
    #[arg(long)]
    pub model: Option<String>,
    /// Acceptance of a licence.
    #[command(flatten)]
    pub licence: LicenceArgs,
}

/// `vidar model check`.
#[derive(Args, Clone, Debug)]
pub struct CheckArgs {
    /// A reference file (.safetensors with a manifest.json next to it), or a folder of them.
    #[arg(value_hint = ValueHint::AnyPath)]
    pub path: PathBuf,
    /// Check this model instead of synthetic weights.
    #[arg(long, value_hint = ValueHint::AnyPath)]
    pub model_dir: Option<PathBuf>,
    /// Precision of the backbone.
    #[arg(long, value_enum, default_value_t = PrecisionArg::F32)]
    pub precision: PrecisionArg,
    /// Device that runs the network: cpu, gpu, gpu:N or auto; `vidar doctor` lists graphics processors.
    #[arg(long, default_value_t, value_name = "DEVICE")]
    pub device: Device,
    /// Print every tensor, not only the worst one and those that differ.
    #[arg(long)]
    pub all: bool,
}

/// Precision of matrix products.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum PrecisionArg {
    /// bf16 if the processor supports it, else 32 bits.
    Auto,
    /// 32 bits.
    F32,
    /// bf16.
    Bf16,
    /// Weights of 16-bit floats.
    F16,
}

/// Which side of an image is scaled, and how multiples of 14 are reached.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum MethodArg {
    /// The longer side; then stretched.
    UpperBoundResize,
    /// The longer side; then cropped.
    UpperBoundCrop,
    /// The shorter side; then stretched.
    LowerBoundResize,
    /// The shorter side; then cropped.
    LowerBoundCrop,
}

/// How the reference view is chosen.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum RefViewArg {
    /// The view with medium similarity, norm and variance.
    SaddleBalanced,
    /// The view with the widest range of similarities.
    SaddleSimRange,
    /// The first view.
    First,
    /// The middle view.
    Middle,
}

/// Size of clouds and depth images.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum ResolutionArg {
    /// Size of the network's output.
    Processed,
    /// Size of the images.
    Input,
}

/// `vidar depth`.
#[derive(Args, Clone, Debug)]
pub struct DepthArgs {
    /// Images, or folders of images; all are predicted together, in this order.
    #[arg(required = true, value_hint = ValueHint::AnyPath)]
    pub inputs: Vec<PathBuf>,
    /// The network: `vidar model list` names them (da3-nano needs no download); `…-untrained` has synthetic weights.
    #[arg(long, default_value = "da3-small", help_heading = "Model")]
    pub model: String,
    /// Folder with model.safetensors and config.json, for custom weights.
    #[arg(long, conflicts_with = "model", value_hint = ValueHint::AnyPath, help_heading = "Model")]
    pub model_dir: Option<PathBuf>,
    /// Acceptance of a licence.
    #[command(flatten)]
    pub licence: LicenceArgs,
    /// Precision of the backbone.
    #[arg(long, value_enum, default_value_t = PrecisionArg::Auto, help_heading = "Model")]
    pub precision: PrecisionArg,
    /// Device that runs the network: cpu, gpu, gpu:N or auto; `vidar doctor` lists graphics processors.
    #[arg(long, default_value_t, value_name = "DEVICE", help_heading = "Model")]
    pub device: Device,
    /// Length of the bounding side of the network input, pixels; default: 504, or 280 for da3-nano.
    #[arg(long, value_name = "PX", help_heading = "Model")]
    pub process_res: Option<usize>,
    /// Which side is bounded, and how multiples of 14 are reached.
    #[arg(long, value_enum, default_value_t = MethodArg::UpperBoundResize, help_heading = "Model")]
    pub method: MethodArg,
    /// Known cameras of the images: a transforms.json, a folder with a COLMAP model, or a run folder.
    #[arg(long, value_hint = ValueHint::AnyPath, help_heading = "Model")]
    pub poses: Option<PathBuf>,
    /// With --poses: keep the network's scale and move the cameras instead.
    #[arg(long, requires = "poses", help_heading = "Model")]
    pub keep_scale: bool,
    /// Focal length of the images, pixels; gives metres with da3-metric-large.
    #[arg(long, value_name = "PX", help_heading = "Model")]
    pub focal: Option<f64>,
    /// Cameras from rays instead of the camera decoder: slower, with a principal point.
    #[arg(long, help_heading = "Model")]
    pub use_ray_pose: bool,
    /// How the reference view is chosen.
    #[arg(long, value_enum, default_value_t = RefViewArg::SaddleBalanced, help_heading = "Model")]
    pub ref_view: RefViewArg,
    /// Reproduce the official program exactly, including its rounding and its limits.
    #[arg(long, help_heading = "Model")]
    pub compat: bool,
    /// Output formats, separated by commas: depth_png, ply, depth_vis, mini_npz, npz, glb, colmap.
    #[arg(long, default_value = "depth_png,ply,depth_vis", help_heading = "Output")]
    pub format: String,
    /// Size of cloud and depth images.
    #[arg(long, value_enum, default_value_t = ResolutionArg::Processed, help_heading = "Output")]
    pub resolution: ResolutionArg,
    /// Percentile of confidence below which pixels are not used as points.
    #[arg(long, default_value_t = 40.0, help_heading = "Output")]
    pub conf_percentile: f64,
    /// Largest number of points in a cloud.
    #[arg(long, default_value_t = 1_000_000, help_heading = "Output")]
    pub max_points: usize,
    /// Where results go.
    #[command(flatten)]
    pub output: OutputArgs,
    /// Print the plan with its memory, and stop.
    #[arg(long)]
    pub dry_run: bool,
}
