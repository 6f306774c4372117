//! One file per verb.

pub mod batch;
pub mod bench;
pub mod calibrate;
pub mod compare;
pub mod config;
pub mod convert;
pub mod depth;
pub mod doctor;
pub mod eval;
pub mod explain;
pub mod export;
pub mod inspect;
pub mod live;
pub mod model;
pub mod odometry;
pub mod receive;
pub mod run;
pub mod synth;
pub mod view;
pub mod worker;

use crate::Outcome;
use crate::args::Cli;
use clap::CommandFactory;
use vidar::ExitStatus;

/// `vidar completions SHELL`.
pub fn completions(shell: clap_complete::Shell) -> Outcome {
    let mut script = Vec::new();
    clap_complete::generate(shell, &mut Cli::command(), "vidar", &mut script);
    crate::print::data(String::from_utf8_lossy(&script).trim_end());
    Ok(ExitStatus::Done)
}
