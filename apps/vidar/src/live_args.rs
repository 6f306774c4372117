//! The command line of `vidar live`.

use crate::run_args::RunArgs;
use clap::Args;

/// `vidar live`.
#[derive(Args, Clone, Debug)]
pub struct LiveArgs {
    /// As `vidar run` has them.
    #[command(flatten)]
    pub run: RunArgs,
    /// Replay the recording at its own rate; what does not keep up is left out, and counted. Otherwise it goes as fast as it can, and
    /// nothing is left out.
    #[arg(long, help_heading = "Input")]
    pub realtime: bool,
    /// Publish poses, odometry, tf, keyframes, cloud, mesh and health as ROS 2 messages (rmw_zenoh): domain and namespace, such as 0/vidar.
    #[arg(long, value_name = "DOMAIN/NAMESPACE", help_heading = "Link")]
    pub publish: Option<String>,
    /// End a robot's recording (zenoh:KEYEXPR) after this time, seconds.
    #[arg(long, value_name = "SECONDS", help_heading = "Link")]
    pub duration: Option<f64>,
    /// End a robot's recording when nothing has come for this time, seconds, once something has.
    #[arg(long, value_name = "SECONDS", help_heading = "Link")]
    pub idle: Option<f64>,
}
