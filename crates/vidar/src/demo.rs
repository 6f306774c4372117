//! `vidar demo`: a synthetic room, flown, mapped and evaluated; nothing is downloaded.

use crate::config::Layered;
use crate::error::Error;
use crate::events::{CancelToken, Event, Events};
use crate::models::{self, geometry};
use crate::run::{RunOutcome, RunRequest, run};
use crate::run_folder::OutputLocation;
use std::path::{Path, PathBuf};
use vidar_core::Trajectory;
use vidar_dataset::OpenOptions;
use vidar_synth::{SynthConfig, SynthSummary};

/// What the demo shall do.
#[derive(Clone, Debug)]
pub struct DemoRequest {
    /// The world.
    pub world: SynthConfig,
    /// The configuration of the run.
    pub layered: Layered,
    /// Where sequence and run go.
    pub place: OutputLocation,
    /// An MCAP file that shows the run in robotics viewers.
    pub mcap: Option<PathBuf>,
    /// The command as typed.
    pub command: Vec<String>,
}

/// Renders the sequence into `sequence/` and runs on it into `run/`.
pub fn demo(request: &DemoRequest, events: &Events, cancel: &CancelToken) -> Result<RunOutcome, Error> {
    // Better a missing checkpoint now than after rendering.
    if let Some(network) = geometry::chosen(&request.layered.build()?)? {
        models::locate(&network, None, &models::store(true)?)?;
    }
    let root = request.place.reserve()?;
    let sequence = root.join("sequence");
    synthesise(&sequence, &request.world, None, events, cancel)?;
    let run_request = RunRequest {
        path: sequence,
        open: OpenOptions::default(),
        layered: request.layered.clone(),
        reference: None,
        place: OutputLocation::Exact { path: root.join("run"), force: false },
        mcap: request.mcap.clone(),
        command: request.command.clone(),
    };
    run(&run_request, events, cancel)
}

/// Renders a sequence in EuRoC layout, telling of its progress.
pub fn synthesise(
    out: &Path,
    world: &SynthConfig,
    flight: Option<&Trajectory>,
    events: &Events,
    cancel: &CancelToken,
) -> Result<SynthSummary, Error> {
    events.stage("render", 0, || {
        let progress = |done: usize, total: usize| {
            events.emit(&Event::Progress { stage: "render", done, total });
            !cancel.is_cancelled()
        };
        let result = vidar_synth::write_sequence(out, world, flight, &progress);
        match result {
            Err(_) if cancel.is_cancelled() => Err(Error::Interrupted { path: PathBuf::from(out) }),
            other => Ok(other?),
        }
    })
}
