//! The start of a run: its recording opened, planned and tracked, its folder made.

use super::budget;
use super::live::{self, Incoming, LiveStream};
use super::place_recognition::PlaceRecognition;
use super::record::{Recorder, RunDescription};
use super::scene::SceneWriter;
use super::source::Source;
use super::tracking::Tracking;
use super::{Plan, RunRequest};
use crate::config::Config;
use crate::error::Error;
use crate::events::{CancelToken, Event, Events};
use crate::input;
use crate::odometry::TrackedPoses;
use crate::run_folder::{Earlier, RunFolder, pretty};
use std::sync::Arc;
use vidar_dataset::Recording;

/// A run that has poses, or is to track while it maps.
pub(super) struct Started {
    pub recorder: Recorder,
    /// The events of the caller, recorded.
    pub events: Events,
    /// As found by calibration and tracking.
    pub config: Config,
    /// As found by calibration and tracking.
    pub dataset: Recording,
    /// SHA-256 of what the recording consists of.
    pub fingerprint: String,
    pub plan: Plan,
    pub source: Source,
    pub places: PlaceRecognition,
    pub description: RunDescription,
    /// What an earlier attempt left in the folder.
    pub earlier: Option<Earlier>,
    pub scene: Option<SceneWriter>,
    pub folder: Arc<RunFolder>,
    /// None where poses are given, and where the engine is to track while it maps.
    pub poses: Option<TrackedPoses>,
    /// Where the recording is still made.
    pub stream: Option<LiveStream>,
}

/// Starts a run.
///
/// # Errors
/// The input cannot be used, or the folder cannot be written.
pub(super) fn start(
    request: &RunRequest,
    is_live: bool,
    incoming: Option<Incoming>,
    events: &Events,
    cancel: &CancelToken,
) -> Result<Started, Error> {
    let recorder = Recorder::default();
    let events = recorder.listen(events.clone());
    let mut config = request.layered.build()?;
    let early = incoming.as_ref().map(|i| i.folder.clone());
    let (stream, mut dataset) = events.stage("read", 0, || match incoming {
        Some(incoming) => {
            incoming.open(request, &config, cancel).map(|(stream, facts)| (Some(stream), facts))
        }
        None => {
            let open = if is_live { input::open_for_live } else { input::open_every_image };
            open(&request.path, &request.open, &config).map(|dataset| (None, dataset))
        }
    })?;
    dataset.warnings.extend(input::use_every_untimed_image(&dataset, &mut config));
    let fingerprint = match (&stream, live::kept(request)) {
        (Some(_), _) | (None, Some(_)) => live::fingerprint(&request.path)?,
        (None, None) => input::fingerprint(&dataset)?,
    };
    let mut tracking = Tracking::new(&dataset, &fingerprint, &config, &request.place)?;
    // What is live looks at nothing before it comes: neither to calibrate, nor for the camera's timing, nor to track.
    if is_live {
        config.odometry.adjust = false;
        let stated = dataset.readout.map(|r| 1e3 * r.as_secs_f64());
        config.odometry.readout_ms = config.odometry.readout_ms.or(stated);
    } else {
        tracking.calibrate(&mut dataset, &mut config, &events, cancel)?;
    }
    let (plan, source, places) =
        events.stage("plan", 0, || Plan::make(&dataset, &config, request.reference.as_deref()))?;
    let description = RunDescription::new(request, &dataset, fingerprint.clone(), &plan);
    let earlier = request.place.earlier(&description.0, &request.layered.to_toml(false))?;
    let scene = request.mcap.as_deref().map(|path| SceneWriter::create(path, &dataset)).transpose()?;
    let events = scene.iter().fold(events, |events, scene| scene.listen(events));
    let folder = early.map_or_else(|| RunFolder::create(&request.place).map(Arc::new), Ok)?;
    folder.write_manifest(&description.0)?;
    folder.write("config.resolved.toml", request.layered.to_toml(true).as_bytes())?;
    recorder.keep_log_in(folder.clone());
    dataset.warnings.iter().chain(&plan.warnings).for_each(|w| events.warn(w));
    let poses = match plan.poses.is_odometry() && !is_live {
        true => tracking.track(&mut dataset, &mut config, &folder, scene.as_ref(), &events, cancel)?,
        false => None,
    };
    let (plan, source, places) = within_budget(
        (plan, source, places),
        (&dataset, &mut config, poses.as_ref()),
        request,
        (&folder, &events),
    )?;
    Ok(Started {
        recorder,
        events,
        config,
        dataset,
        fingerprint,
        plan,
        source,
        places,
        description,
        earlier,
        scene,
        folder,
        poses,
        stream,
    })
}

/// The plan with what a time budget leaves of it; its settings are those of `config` from then on.
fn within_budget(
    made: (Plan, Source, PlaceRecognition),
    (dataset, config, poses): (&Recording, &mut Config, Option<&TrackedPoses>),
    request: &RunRequest,
    (folder, events): (&RunFolder, &Events),
) -> Result<(Plan, Source, PlaceRecognition), Error> {
    let Some(found) = budget::settle(dataset, config, &made.0, poses)? else { return Ok(made) };
    let bytes = folder.write(budget::FILE, &pretty(&found)?)?;
    events.emit(&Event::ArtifactWritten { path: budget::FILE.into(), bytes });
    found.warning().iter().for_each(|w| events.warn(w));
    let (plan, source, places) = match found.chosen == found.unlimited {
        true => made,
        false => Plan::make(dataset, config, request.reference.as_deref())?,
    };
    Ok((Plan { budget: Some(found), ..plan }, source, places))
}
