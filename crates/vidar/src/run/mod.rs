//! One run: recording → engine → evaluate → export.

mod ahead;
mod auto;
mod budget;
mod build_map;
mod by_source;
mod evaluate;
mod live;
mod map;
mod outputs;
pub(crate) mod parts;
mod pictures;
mod place_recognition;
mod plan;
mod readers;
mod record;
pub(crate) mod reference;
mod remote;
mod scene;
mod source;
mod start;
mod store;
mod summary;
mod tracking;
mod trust;
mod view;
mod views;

pub use budget::{Budget, BudgetChoice};
pub use by_source::SourceScore;
pub(crate) use evaluate::sampled;
pub use evaluate::{DepthScore, Evaluation};
pub use live::{Latency, LiveInput, LiveOptions, LiveReport, RECORDING};
pub use map::MetricMap;
pub use outputs::pose_of;
pub use plan::{ExpectedWork, Plan, bytes};
pub(crate) use scene::encoded_image;

use crate::calibrate;
use crate::config::{Config, Layered};
use crate::error::{Error, ExitStatus};
use crate::events::{CancelToken, Event, Events};
use crate::input::{self, UnseenScale};
use crate::odometry::TrackedPoses;
use crate::run_folder::{OutputLocation, RunFolder};
use crate::verdict::{StatedScale, Verdict};
use build_map::{EngineParts, unreadable};
use live::{Incoming, LiveStream};
use place_recognition::PlaceRecognition;
use record::Recorder;
use remote::RemoteSource;
use scene::SceneWriter;
use source::Source;
use start::Started;
use std::path::PathBuf;
use vidar_core::{Duration, RigCamera, Se3, Warning};
use vidar_dataset::{OpenOptions, Recording};

/// What to run on, how, and where to.
#[derive(Clone, Debug)]
pub struct RunRequest {
    /// The recording.
    pub path: PathBuf,
    /// How to read it.
    pub open: OpenOptions,
    /// The configuration with its origins.
    pub layered: Layered,
    /// A reference cloud (PLY, metres, in the world of ground truth) to compare the map with.
    pub reference: Option<PathBuf>,
    /// Where results go.
    pub place: OutputLocation,
    /// An MCAP file that shows the run in robotics viewers.
    pub mcap: Option<PathBuf>,
    /// The command as typed, for the manifest.
    pub command: Vec<String>,
}

/// Result of a run.
#[derive(Debug)]
pub struct RunOutcome {
    /// The run folder.
    pub folder: PathBuf,
    /// Done, degraded or interrupted.
    pub status: ExitStatus,
    /// The plan that was carried out.
    pub plan: Plan,
    /// The map.
    pub map: MetricMap,
    /// Scores of the map, where there is something to compare it with.
    pub evaluation: Evaluation,
    /// What is said of the scale.
    pub scale: StatedScale,
    /// How far the map may be trusted.
    pub verdict: Verdict,
    /// Every warning, in order.
    pub warnings: Vec<Warning>,
    /// The most memory of a graphics processor held at a time, bytes; `None` where none was used.
    pub device_peak_bytes: Option<u64>,
    /// What a live run measured; none of others.
    pub live: Option<LiveReport>,
    /// What went to workers elsewhere and back; none where none were asked.
    pub remote: Option<vidar_link::geometry::RemoteReport>,
    /// Wall time, s.
    pub seconds: f64,
}

impl RunOutcome {
    /// Counts and scores as JSON.
    pub fn result_json(&self) -> serde_json::Value {
        outputs::result_json(self)
    }

    /// What was made, its scores and time, and the report: at most twelve lines.
    pub fn summary_lines(&self) -> Vec<(&'static str, String)> {
        summary::lines(self)
    }

    /// Whether the map is in metres.
    pub fn is_metric(&self) -> bool {
        self.scale.is_metric
    }
}

/// What a run would do, without doing it: nothing is tracked, not even to find a calibration that the recording does not state.
///
/// # Errors
/// The input, the configuration or the model cannot be used.
pub fn plan(request: &RunRequest) -> Result<Plan, Error> {
    let mut config = request.layered.build()?;
    let mut dataset = input::open_every_image(&request.path, &request.open, &config)?;
    let untimed = input::use_every_untimed_image(&dataset, &mut config);
    let missing_calibration = match input::needs_calibration(&config) {
        true => calibrate::assume_complete(&mut dataset),
        false => None,
    };
    let (mut plan, ..) = Plan::make(&dataset, &config, request.reference.as_deref())?;
    if !plan.poses.is_odometry()
        && let Some(found) = budget::settle(&dataset, &mut config, &plan, None)?
    {
        (plan, ..) = Plan::make(&dataset, &config, request.reference.as_deref())?;
        plan.warnings.extend(found.warning());
        plan.budget = Some(found);
    }
    plan.missing_calibration = missing_calibration;
    plan.warnings.splice(0..0, dataset.warnings.iter().cloned().chain(untimed));
    Ok(plan)
}

/// Runs all of it. On Ctrl-C what is predicted is fused, written and evaluated, and the status is `Interrupted`. A run that
/// fails after its folder was made leaves a manifest there with the reason.
///
/// # Errors
/// The input cannot be used, nothing could be mapped, or a result could not be written.
pub fn run(request: &RunRequest, events: &Events, cancel: &CancelToken) -> Result<RunOutcome, Error> {
    carry(request, None, None, events, cancel)
}

/// Runs all of it as on a robot: poses while images come, by an odometry on a thread of its own; the map behind it. A camera without
/// a calibration is refused, and `odometry.adjust` has no effect, because it needs the end of the recording.
///
/// # Errors
/// As [`run`]; and a thread that the system does not give.
pub fn live(
    request: &RunRequest,
    options: &LiveOptions,
    events: &Events,
    cancel: &CancelToken,
) -> Result<RunOutcome, Error> {
    carry(request, Some(options), None, events, cancel)
}

/// The same of MCAP that comes, such as on standard input; the request's path is not used. What came is kept in the run folder as
/// [`RECORDING`] while it comes, so that the request with this path goes on after a kill.
///
/// # Errors
/// As [`live`]; and a stream that is no MCAP, or has no images.
pub fn live_stream(
    request: &RunRequest,
    options: &LiveOptions,
    input: LiveInput,
    events: &Events,
    cancel: &CancelToken,
) -> Result<RunOutcome, Error> {
    let folder = std::sync::Arc::new(RunFolder::create(&request.place)?);
    let request = RunRequest { path: folder.path().join(RECORDING), ..request.clone() };
    carry(&request, Some(options), Some(Incoming { folder, input }), events, cancel)
}

fn carry(
    request: &RunRequest,
    live: Option<&LiveOptions>,
    incoming: Option<Incoming>,
    events: &Events,
    cancel: &CancelToken,
) -> Result<RunOutcome, Error> {
    let clock = std::time::Instant::now();
    let Started {
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
    } = start::start(request, live.is_some(), incoming, events, cancel)?;
    let context = Context {
        request,
        live,
        config: &config,
        dataset: &dataset,
        fingerprint: &fingerprint,
        folder: &folder,
        scene: scene.as_ref(),
        stream: stream.as_ref(),
        events: &events,
        cancel,
    };
    let made = context.carry_out(plan, source, poses, &places, &recorder).map(|outcome| RunOutcome {
        seconds: clock.elapsed().as_secs_f64(),
        warnings: recorder.warnings(),
        ..outcome
    });
    if let Some(scene) = &scene {
        scene.finish(&events);
    }
    let (exit, result) = match &made {
        Ok(outcome) => (outcome.status, outputs::result_json(outcome)),
        Err(error) => (error.exit_status(), record::failure_json(error)),
    };
    if stream.is_some() || live::kept(request).is_some() {
        live::list(&folder, &events);
    }
    if let (Some(earlier), Ok(_)) = (&earlier, &made) {
        earlier.remove_all_but(folder.path(), &recorder.files());
    }
    let written = folder.write_manifest(&recorder.manifest(description, result, exit));
    let outcome = made?;
    written?;
    events.emit(&Event::Finished { exit: exit as i32, seconds: outcome.seconds });
    Ok(outcome)
}

/// What the stages of a run share.
struct Context<'a> {
    request: &'a RunRequest,
    /// None where the map may look ahead.
    live: Option<&'a LiveOptions>,
    config: &'a Config,
    dataset: &'a Recording,
    /// SHA-256 of what the recording consists of.
    fingerprint: &'a str,
    folder: &'a RunFolder,
    scene: Option<&'a SceneWriter>,
    /// Where the recording is still made: `dataset` has the facts of its beginning.
    stream: Option<&'a LiveStream>,
    events: &'a Events,
    cancel: &'a CancelToken,
}

impl Context<'_> {
    /// Recording → engine → evaluate → export.
    fn carry_out(
        &self,
        plan: Plan,
        mut source: Source,
        tracked: Option<TrackedPoses>,
        places: &PlaceRecognition,
        recorder: &Recorder,
    ) -> Result<RunOutcome, Error> {
        let Self { request, config, dataset, folder, events, cancel, .. } = *self;
        let group = source.remote().map(RemoteSource::group);
        let known = group.as_ref().and_then(|_| tracked.clone());
        let ((map, live), said) =
            ahead::beside(self, (&plan, places), group.as_ref(), known.as_ref(), |ahead| {
                self.build_map(&plan, &mut source, tracked, places, ahead)
            })?;
        crate::system::release_freed_memory();
        let known = recorder.warnings();
        said.warnings.iter().filter(|w| !known.contains(w)).for_each(|w| events.warn(w));
        live.as_ref().and_then(live::warning).iter().for_each(|w| events.warn(w));
        let whole = self.stream.map(|stream| stream.whole(dataset)).transpose()?;
        let dataset = whole.as_ref().unwrap_or(dataset);
        let evaluation =
            events.stage("evaluate", 0, || evaluate::evaluate(dataset, &plan, &map, config, events))?;
        let scale = trust::stated_scale(&map, plan.mode, UnseenScale::of(dataset, config));
        trust::warnings(&map, &evaluation, &scale).iter().for_each(|w| events.warn(w));
        let is_degraded = recorder.is_degraded() || map.surface.mesh.triangles.is_empty();
        let status = ExitStatus::of_run(cancel.is_cancelled(), is_degraded);
        let (root, warnings) = (folder.path().to_owned(), recorder.warnings());
        let verdict = trust::verdict(&map, &evaluation, &scale, &warnings, status);
        let outcome = RunOutcome {
            folder: root,
            status,
            plan,
            map,
            evaluation,
            scale,
            verdict,
            warnings,
            device_peak_bytes: source.device_peak_bytes(),
            live,
            remote: source.remote().map(|r| said.reports.iter().fold(r.report(), |all, more| all.and(more))),
            seconds: 0.0,
        };
        events.stage("write", 0, || outputs::write(&outcome, dataset, config, request, folder, events))?;
        if config.output.report {
            events.stage("report", 0, || pictures::draw(&outcome, dataset, request, folder, events))?;
        }
        Ok(outcome)
    }
}

/// Time from the first to the last row of an image: as found or set, else as the calibration states.
pub(crate) fn readout(dataset: &Recording, config: &Config) -> Duration {
    let known = config.odometry.readout_ms.map(|ms| Duration::from_secs_f64(1e-3 * ms));
    known.or(dataset.readout).unwrap_or(Duration::ZERO)
}

pub(crate) fn camera_on_rig(dataset: &Recording, plan: &Plan) -> RigCamera {
    dataset.rig.camera(plan.camera_id).cloned().unwrap_or_else(|| RigCamera {
        model: plan.camera.clone(),
        body_from_camera: Se3::IDENTITY,
        time_offset: Duration::ZERO,
        rate_hz: None,
    })
}
