//! The command line of what reaches other machines, and of `vidar worker`.

use crate::model_args::LicenceArgs;
use crate::shared_args::ConfigArgs;
use clap::{ArgAction, Args, ValueHint};
use std::path::PathBuf;
use vidar::da3::Device;

/// How other machines are reached.
#[derive(Args, Clone, Debug, Default)]
pub struct LinkArgs {
    /// Endpoint to connect to, such as tcp/192.168.1.5:7447 or tls/server:7447; default: tcp/127.0.0.1:7447, this computer. Repeatable.
    #[arg(long, value_name = "ENDPOINT", action = ArgAction::Append, help_heading = "Link")]
    pub connect: Vec<String>,
    /// Endpoint to listen at, such as tcp/0.0.0.0:7447; a worker's default is tcp/127.0.0.1:7447, this computer alone. Repeatable.
    #[arg(long, value_name = "ENDPOINT", action = ArgAction::Append, help_heading = "Link")]
    pub listen: Vec<String>,
    /// File of Zenoh's settings (JSON5): TLS, certificates, access control.
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath, help_heading = "Link")]
    pub link_config: Option<PathBuf>,
}

/// `vidar worker`.
#[derive(Args, Clone, Debug)]
pub struct WorkerArgs {
    /// Network that it serves: one of `vidar model list`.
    #[arg(
        long,
        visible_alias = "geometry",
        value_name = "NAME",
        default_value = "da3-small",
        help_heading = "Model"
    )]
    pub model: String,
    /// Folder with model.safetensors and config.json, for custom weights; instead of --model.
    #[arg(long, value_hint = ValueHint::AnyPath, help_heading = "Model")]
    pub model_dir: Option<PathBuf>,
    /// Device that runs the network: cpu, gpu, gpu:N or auto; `vidar doctor` lists graphics processors.
    #[arg(long, value_name = "DEVICE", help_heading = "Model")]
    pub device: Option<Device>,
    /// Acceptance of a licence.
    #[command(flatten)]
    pub licence: LicenceArgs,
    /// Key under which it answers; a run asks for it with --geometry remote:KEY.
    #[arg(long, default_value = "vidar/geometry", help_heading = "Link")]
    pub key: String,
    /// How other machines are reached.
    #[command(flatten)]
    pub link: LinkArgs,
    /// How settings are given.
    #[command(flatten)]
    pub config: ConfigArgs,
}

/// `vidar receive`.
#[derive(Args, Clone, Debug)]
pub struct ReceiveArgs {
    /// Key expressions of topics as rmw_zenoh has them: DOMAIN/TOPIC/**; several may be given.
    #[arg(value_name = "KEYEXPR", required = true)]
    pub expressions: Vec<String>,
    /// MCAP file; it must not exist. Default: the standard output.
    #[arg(short, long, value_name = "FILE", value_hint = ValueHint::FilePath, help_heading = "Output")]
    pub output: Option<PathBuf>,
    /// End after this time, seconds.
    #[arg(long, value_name = "SECONDS")]
    pub duration: Option<f64>,
    /// End when nothing has come for this time, seconds, once something has.
    #[arg(long, value_name = "SECONDS")]
    pub idle: Option<f64>,
    /// How other machines are reached.
    #[command(flatten)]
    pub link: LinkArgs,
    /// How settings are given.
    #[command(flatten)]
    pub config: ConfigArgs,
}
