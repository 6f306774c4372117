//! The command line, as plain values. Validation and building happen in the commands.

pub use crate::bench_args::{BenchArgs, BenchDataset};
pub use crate::synth_args::{SynthArgs, WorldArgs};

use crate::batch_args::{PlanArgs, WorkArgs};
use crate::compare_args::CompareArgs;
use crate::link_args::{ReceiveArgs, WorkerArgs};
use crate::live_args::LiveArgs;
use crate::model_args::{DepthArgs, ModelCommand};
use crate::run_args::WholeRunArgs;
use crate::shared_args::{ConfigArgs, InputArgs, OutputArgs};
use clap::{Args, Parser, Subcommand, ValueEnum, ValueHint};
use std::path::PathBuf;

/// Metric dense 3-D maps from one camera and an IMU, or from one camera and metric poses.
#[derive(Debug, Parser)]
#[command(name = "vidar", version = version(), max_term_width = 110, propagate_version = true)]
#[command(
    after_help = "Examples:\n  vidar demo\n  vidar inspect my_recording/\n  vidar run my_recording/ --trajectory vio.tum -o result"
)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
    /// Options of every command.
    #[command(flatten)]
    pub common: CommonArgs,
}

fn version() -> &'static str {
    concat!(env!("CARGO_PKG_VERSION"), " (stereo, cpu)")
}

/// Options of every command.
#[derive(Args, Clone, Debug)]
pub struct CommonArgs {
    /// How progress is shown, on the error stream.
    #[arg(long, value_enum, default_value_t = ProgressMode::Auto, global = true, help_heading = "Output")]
    pub progress: ProgressMode,
    /// Print the result as one JSON object on the standard output.
    #[arg(long, global = true, help_heading = "Output")]
    pub json: bool,
    /// Print only errors and the result.
    #[arg(short, long, global = true, help_heading = "Output")]
    pub quiet: bool,
    /// Never use the network.
    #[arg(long, global = true, help_heading = "Output")]
    pub offline: bool,
    /// Number of threads; 0 means all. The result does not depend on it.
    #[arg(long, default_value_t = 0, global = true, help_heading = "Output")]
    pub threads: usize,
}

/// How progress is shown.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum ProgressMode {
    /// A bar on a terminal, plain lines otherwise.
    Auto,
    /// A bar.
    Bar,
    /// One line per stage, and one every few seconds.
    Plain,
    /// One JSON object per event.
    Json,
    /// Nothing.
    Off,
}

/// What to do.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Run the whole pipeline on a recording: poses, depth, fusion into one surface, evaluation, files.
    #[command(after_help = RUN_EXAMPLES)]
    Run(Box<WholeRunArgs>),
    /// Map while images come: poses from a thread of its own, a growing surface, latencies measured.
    #[command(
        after_help = "Examples:\n  vidar live drive.mcap --realtime -o result\n  vidar live mav0/ --preset euroc --realtime\n  vidar live mav0/ -o result --resume\n  vidar live 'zenoh:0/cam0/**,0/imu/**' --connect tcp/robot:7447 -o result"
    )]
    Live(Box<LiveArgs>),
    /// Render a flight through a synthetic room, map it and evaluate the map; nothing is downloaded.
    #[command(
        after_help = "Examples:\n  vidar demo\n  vidar demo -o my_demo --seed 7\n  vidar demo --scene corridor --set fusion.voxel_size_m=0.03"
    )]
    Demo(DemoArgs),
    /// Show the contents of a recording and check its data and calibration.
    #[command(
        after_help = "Examples:\n  vidar inspect my_recording/\n  vidar inspect my_recording/ --trajectory vio.tum\n  vidar inspect my_recording/ --json"
    )]
    Inspect(InspectArgs),
    /// Write any recording as MCAP (ROS 2) or as a folder in EuRoC's layout; times, pixels and numbers stay as they are.
    #[command(
        after_help = "Examples:\n  vidar convert my_recording/ out.mcap\n  vidar convert drive.bag mav0_folder/\n  vidar convert scan/ out.mcap --start 10 --end 40 --json"
    )]
    Convert(ConvertArgs),
    /// Calibrate camera, clock and mount from an ordinary recording with a gyroscope, or check a given calibration.
    #[command(
        after_help = "Examples:\n  vidar calibrate my_recording/\n  vidar calibrate my_recording/ -o calibration.yaml\n  vidar run my_recording/ --calibration calibration.yaml"
    )]
    Calibrate(CalibrateArgs),
    /// Evaluate a trajectory or a cloud against a reference, or show the scores of a run.
    #[command(
        after_help = "Examples:\n  vidar eval estimate.tum truth.tum\n  vidar eval map.ply scan.ply\n  vidar eval runs/demo/latest/run --fail-below f@0.05=0.5"
    )]
    Eval(EvalArgs),
    /// Export a finished run to formats of other programs.
    #[command(
        after_help = "Examples:\n  vidar export runs/demo/latest/run --to colmap -o colmap\n  vidar export runs/demo/latest/run --to nerfstudio -o ns\n  vidar export runs/demo/latest/run --to tum"
    )]
    Export(ExportArgs),
    /// Compare finished runs on one page: numbers side by side, linked cameras, distances of their surfaces in colour.
    #[command(
        after_help = "Examples:\n  vidar compare runs/a/latest runs/b/latest\n  vidar compare stereo/ nano/ small/ -o models.html\n  vidar compare before/ after/ --force --json"
    )]
    Compare(CompareArgs),
    /// Serve a finished run to Foxglove on this computer, until Ctrl-C.
    #[command(
        after_help = "Examples:\n  vidar view runs/demo/latest/run\n  vidar view run.mcap --port 9000\n\nIn Foxglove: Open connection, Foxglove WebSocket, the address that is printed."
    )]
    View(ViewArgs),
    /// Predict depth, confidence, cameras and a cloud from images, with Depth Anything 3.
    #[command(
        after_help = "Examples:\n  vidar depth photos/\n  vidar depth a.jpg b.jpg --model da3-base --format ply,glb -o out\n  vidar depth frames/ --poses colmap/ --resolution input\n  vidar depth photos/ --dry-run"
    )]
    Depth(Box<DepthArgs>),
    /// Manage checkpoints: list, pull, import, verify, check, where.
    #[command(subcommand)]
    Model(ModelCommand),
    /// Estimate the metric trajectory of a recording from its camera and IMU.
    #[command(
        after_help = "Examples:\n  vidar odometry mav0/ -o result\n  vidar odometry my_recording/ --mono\n  vidar odometry my_recording/ --set odometry.max_landmarks=200 --json"
    )]
    Odometry(OdometryArgs),
    /// Render a synthetic sequence in EuRoC layout with exact ground truth.
    #[command(
        after_help = "Examples:\n  vidar synth room1\n  vidar synth hall1 --scene hall --seed 3 --duration 20\n  vidar synth flight1 --trajectory flight.tum --euroc"
    )]
    Synth(SynthArgs),
    /// Reproduce the paper's tables: run and evaluate every sequence of a dataset with every coupling.
    #[command(
        after_help = "Examples:\n  vidar bench euroc EuRoC/ --sequences V1,V2 --geometry da3-small -o tables\n  vidar bench euroc --synthetic --geometry simulated -o tables\n  vidar bench tum TUM/ --modes pose-free,pose-conditioned"
    )]
    Bench(Box<BenchArgs>),
    /// Plan a batch: many recordings into maps and one table, by as many workers as there are.
    #[command(
        after_help = "Examples:\n  vidar plan bags/monday.bag bags/tuesday.bag --store results\n  vidar plan bags/one.mcap bags/two.mcap --store s3://maps/june --geometry da3-small --parts 8"
    )]
    Plan(Box<PlanArgs>),
    /// Do one task of a plan; a task whose result is in the store is not done again.
    #[command(
        after_help = "Examples:\n  vidar work --plan results/plans/HASH.json --stage track --index 0\n  vidar work --plan results/plans/HASH.json --stage report"
    )]
    Work(WorkArgs),
    /// Serve a network to runs on other machines (`--geometry remote:KEY`), until Ctrl-C.
    #[command(
        after_help = "Examples:\n  vidar worker --model da3-nano\n  vidar worker --model da3-small --device gpu --listen tcp/0.0.0.0:7447\n  vidar worker --key lab/depth --link-config tls.json5"
    )]
    Worker(Box<WorkerArgs>),
    /// Take a robot's messages (ROS 2 over Zenoh) as they come, as an MCAP stream or file.
    #[command(
        after_help = "Examples:\n  vidar receive '0/cam0/**' '0/imu/**' -o drive.mcap\n  vidar receive '0/**' --connect tcp/robot:7447 --duration 60 -o drive.mcap"
    )]
    Receive(Box<ReceiveArgs>),
    /// Check this machine: processor, memory, disk, networks, graphics processors.
    Doctor,
    /// Show and explain settings: show, explain, presets, schema.
    #[command(subcommand)]
    Config(ConfigCommand),
    /// Explain an error code.
    #[command(after_help = "Examples:\n  vidar explain E0202\n  vidar explain all")]
    Explain {
        /// The code, such as E0202, or `all`.
        code: String,
    },
    /// Print a completion script for a shell.
    Completions {
        /// Which shell.
        shell: clap_complete::Shell,
    },
}

const RUN_EXAMPLES: &str = "Examples:
  vidar run mav0/ --preset euroc -o result
  vidar run frames/ --timestamps times.txt --camera-model pinhole:525,525,319.5,239.5 --trajectory vio.tum
  vidar run my_recording/ --dry-run";

/// `vidar demo`.
#[derive(Args, Clone, Debug)]
pub struct DemoArgs {
    /// The synthetic world.
    #[command(flatten)]
    pub world: WorldArgs,
    /// Source of depth: auto (stereo, completed), stereo, da3-nano (built in) or another network of `vidar model list`.
    #[arg(long, visible_alias = "model", value_name = "NAME", help_heading = "Model")]
    pub geometry: Option<String>,
    /// Folder with model.safetensors and config.json, for custom weights.
    #[arg(long, value_hint = ValueHint::AnyPath, help_heading = "Model")]
    pub model_dir: Option<PathBuf>,
    /// How settings are given.
    #[command(flatten)]
    pub config: ConfigArgs,
    /// Where results go.
    #[command(flatten)]
    pub output: OutputArgs,
    /// MCAP file that shows the run in Foxglove or Rerun, written while it runs; it must not exist.
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath, help_heading = "Output")]
    pub mcap: Option<PathBuf>,
}

/// `vidar inspect`.
#[derive(Args, Clone, Debug)]
pub struct InspectArgs {
    /// The recording; `-` is a bag or video on standard input.
    #[arg(value_hint = ValueHint::AnyPath)]
    pub path: PathBuf,
    /// How the input is read.
    #[command(flatten)]
    pub input: InputArgs,
}

/// `vidar convert`.
#[derive(Args, Clone, Debug)]
pub struct ConvertArgs {
    /// The recording: whatever `vidar inspect` opens; `-` is a bag or video on standard input.
    #[arg(value_hint = ValueHint::AnyPath)]
    pub path: PathBuf,
    /// The new file or folder; it must not exist.
    #[arg(value_hint = ValueHint::AnyPath)]
    pub out: PathBuf,
    /// Layout of the output, instead of that of its name's ending (.mcap, else a folder): mcap, euroc.
    #[arg(long, help_heading = "Output")]
    pub to: Option<String>,
    /// How the input is read.
    #[command(flatten)]
    pub input: InputArgs,
}

/// `vidar calibrate`.
#[derive(Args, Clone, Debug)]
pub struct CalibrateArgs {
    /// The recording: images and an IMU; `-` is a bag or video on standard input.
    #[arg(value_hint = ValueHint::AnyPath)]
    pub path: PathBuf,
    /// File for the calibration (Kalibr's YAML, camera and IMU in one), as --calibration takes it.
    #[arg(short, long, value_hint = ValueHint::FilePath, help_heading = "Output")]
    pub output: Option<PathBuf>,
    /// How the input is read.
    #[command(flatten)]
    pub input: InputArgs,
}

/// `vidar odometry`.
#[derive(Args, Clone, Debug)]
pub struct OdometryArgs {
    /// The recording: images and an IMU, as a bag, an action camera's video, or a folder; `-` is a bag or video on standard input.
    #[arg(value_hint = ValueHint::AnyPath)]
    pub path: PathBuf,
    /// Folder of an earlier `vidar odometry` or `vidar run` of the same place: poses are in the world of that recording.
    #[arg(long, value_name = "FOLDER", value_hint = ValueHint::AnyPath, help_heading = "Input")]
    pub map: Option<String>,
    /// Use the camera only, without the IMU: a trajectory up to scale.
    #[arg(long)]
    pub mono: bool,
    /// Write tracks, residuals and states as tables (odometry/debug_tracks.csv, odometry/debug_states.csv).
    #[arg(long)]
    pub debug_dump: bool,
    /// How the input is read.
    #[command(flatten)]
    pub input: InputArgs,
    /// How settings are given.
    #[command(flatten)]
    pub config: ConfigArgs,
    /// Where results go.
    #[command(flatten)]
    pub output: OutputArgs,
}

/// `vidar eval`.
#[derive(Args, Clone, Debug)]
pub struct EvalArgs {
    /// A trajectory, a cloud (.ply), or a run folder.
    #[arg(value_hint = ValueHint::AnyPath)]
    pub estimate: PathBuf,
    /// Reference trajectory or cloud; not for a run folder.
    #[arg(value_hint = ValueHint::AnyPath)]
    pub truth: Option<PathBuf>,
    /// Format of both trajectories, instead of detecting it: tum, euroc, kitti.
    #[arg(long, value_name = "FORMAT", help_heading = "Input")]
    pub trajectory_format: Option<String>,
    /// Body whose poses both trajectories hold: imu, or camera0, camera1, ….
    #[arg(long, value_name = "BODY", help_heading = "Input")]
    pub trajectory_body: Option<String>,
    /// File with one time per pose, for KITTI trajectories.
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath, help_heading = "Input")]
    pub timestamps: Option<PathBuf>,
    /// Unit of times, instead of detecting it: s, ms, us, ns.
    #[arg(long, value_name = "UNIT", help_heading = "Input")]
    pub time_unit: Option<String>,
    /// How settings are given.
    #[command(flatten)]
    pub config: ConfigArgs,
    /// End with status 5 when a score is above its bound: ate, scale, chamfer. Repeatable.
    #[arg(long, value_name = "NAME=VALUE")]
    pub fail_above: Vec<String>,
    /// End with status 5 when a score is below its bound: f@0.05, f@0.10, … of the rigid fit. Repeatable.
    #[arg(long, value_name = "NAME=VALUE")]
    pub fail_below: Vec<String>,
}

/// `vidar export`.
#[derive(Args, Clone, Debug)]
pub struct ExportArgs {
    /// The run folder.
    #[arg(value_hint = ValueHint::DirPath)]
    pub run: PathBuf,
    /// colmap, colmap-text, nerfstudio, tum, kitti, euroc, ply, glb, textured-glb or mcap.
    #[arg(long)]
    pub to: String,
    /// COLMAP: with every point the keyframes that see it (projections, at most 200 000 points).
    #[arg(long)]
    pub tracks: bool,
    /// COLMAP, nerfstudio and textured-glb: images at the recording's size, undistorted again from its files.
    #[arg(long)]
    pub input_size: bool,
    /// textured-glb: most texels along an edge of the texture, 64 to 16384; default 8192.
    #[arg(long, value_name = "PX")]
    pub texture_px: Option<usize>,
    /// Output folder; default `RUN/export/<format>`.
    #[arg(short, long, value_hint = ValueHint::DirPath)]
    pub output: Option<PathBuf>,
}

/// `vidar view`.
#[derive(Args, Clone, Debug)]
pub struct ViewArgs {
    /// The run folder, or the file that --mcap wrote.
    #[arg(value_hint = ValueHint::AnyPath)]
    pub path: PathBuf,
    /// Port on this computer; 0 takes any that is free.
    #[arg(long, default_value_t = 8765)]
    pub port: u16,
}

/// `vidar config`.
#[derive(Debug, Subcommand)]
pub enum ConfigCommand {
    /// Print every setting with its value.
    Show {
        /// How settings are given.
        #[command(flatten)]
        config: ConfigArgs,
        /// Add the origin of each value.
        #[arg(long)]
        origin: bool,
    },
    /// Explain a setting, or all settings of a section.
    #[command(
        after_help = "Examples:\n  vidar config explain fusion.voxel_size_m\n  vidar config explain keyframes"
    )]
    Explain {
        /// A key such as `fusion.voxel_size_m`, or a section such as `fusion`.
        key: String,
    },
    /// List presets and when to use them.
    Presets,
    /// Print the JSON schema of the configuration.
    Schema,
}
