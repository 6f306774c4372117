//! One run: recording → engine → evaluate → export.

mod ahead;
mod auto;
mod budget;
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
use crate::engine::{Engine, EngineSetup, FrameStamp, ImageSource, MapEvent, PoseSource, PredictionStore};
use crate::error::{Error, ExitStatus};
use crate::events::{CancelToken, Event, Events};
use crate::input::{self, ImageFiles, Measurement, UnseenScale};
use crate::odometry::TrackedPoses;
use crate::run_folder::{OutputLocation, RunFolder};
use crate::verdict::{StatedScale, Verdict};
use ahead::Ahead;
use live::{EndingCell, Incoming, LivePublisher, LiveStream, SurfaceLatency, TrackedElsewhere};
use place_recognition::PlaceRecognition;
use readers::{FINISH, MAP, Readers};
use record::Recorder;
use remote::RemoteSource;
use scene::SceneWriter;
use source::Source;
use start::Started;
use std::path::PathBuf;
use store::RunStore;
use vidar_core::{ChunkId, Duration, RigCamera, Se3, Warning};
use vidar_dataset::{DatasetError, OpenOptions, Recording};

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

/// What the engine of a run is given besides configuration and poses.
struct EngineParts<'e> {
    geometry: &'e mut Source,
    places: &'e PlaceRecognition,
    images: &'e dyn ImageSource,
    store: &'e dyn PredictionStore,
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
        let status = match (cancel.is_cancelled(), is_degraded) {
            (true, _) => ExitStatus::Interrupted,
            (false, true) => ExitStatus::Degraded,
            (false, false) => ExitStatus::Done,
        };
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

    /// The recording through the engine; its events become log, progress, files and map.
    fn build_map(
        &self,
        plan: &Plan,
        source: &mut Source,
        tracked: Option<TrackedPoses>,
        places: &PlaceRecognition,
        ahead: Option<&Ahead>,
    ) -> Result<(MetricMap, Option<LiveReport>), Error> {
        let Self { config, dataset, folder, scene, events, cancel, .. } = *self;
        let images = ImageFiles(dataset, plan.masks.as_deref());
        let cancelled = || cancel.is_cancelled();
        let waiting = ahead.map(|ahead| |chunk| ahead.wait_for(chunk, &cancelled));
        let wait_for = waiting.as_ref().map(|wait| wait as &dyn Fn(ChunkId));
        let store = RunStore::new(folder.path(), self.fingerprint, plan, config).waiting(wait_for);
        let predicting = readers::chunk_progress(events);
        let images: &dyn ImageSource = self.stream.map_or(&images, |stream| stream);
        let parts = EngineParts { geometry: source, places, images, store: &store };
        let ending = EndingCell::default();
        let elsewhere = plan.poses.source().filter(|_| self.live.is_some());
        let elsewhere = elsewhere.map(|s| Box::new(TrackedElsewhere::new(s, ending.clone())) as _);
        let poses = tracked.map(|p| Box::new(p) as Box<dyn PoseSource>).or(elsewhere);
        let mut engine = self.engine(plan, poses, parts, &cancelled, &predicting)?;
        let publisher = match self.live {
            Some(_) => LivePublisher::open(config, &camera_on_rig(dataset, plan))?,
            None => None,
        };
        let mut readers = Readers::new(dataset, plan, config, folder, scene, events);
        readers.publisher = publisher.as_ref();
        readers.surfaces = self.live.map(|_| SurfaceLatency::default());
        let pushed = events.stage(MAP, dataset.images.len(), || match self.live {
            Some(options) => live::push(self, (plan, options), &ending, &mut engine, &mut readers).map(Some),
            None => self.push_recording(&mut engine, &mut |event| readers.read(event)).map(|()| None),
        })?;
        if let Some(stream) = self.stream {
            stream.tell(events);
        }
        readers.finishing();
        events
            .stage(FINISH, 0, || engine.finish(&mut |event| readers.read(event)))
            .map_err(|error| of_synthetic_weights(error, plan))?;
        let report = pushed.zip(readers.surfaces.take()).map(|(pushed, surfaces)| pushed.report(surfaces));
        let map = readers.finish(plan);
        if !cancel.is_cancelled() {
            tracking::forget(folder);
        }
        store.clean(config.output.keep_chunks || cancel.is_cancelled());
        Ok((map, report))
    }

    /// An engine that has seen nothing of the recording.
    fn engine<'e>(
        &'e self,
        plan: &Plan,
        poses: Option<Box<dyn PoseSource + 'e>>,
        parts: EngineParts<'e>,
        cancelled: &'e (dyn Fn() -> bool + Sync),
        predicting: &'e (dyn Fn(f64) + Sync),
    ) -> Result<Engine<'e>, Error> {
        let Self { config, dataset, .. } = *self;
        let (live, fallback) = plan.poses.open(dataset, config)?;
        let poses = poses.or(live.map(|p| p as _));
        Engine::new(EngineSetup {
            name: dataset.name.clone(),
            config,
            camera_id: plan.camera_id,
            camera: camera_on_rig(dataset, plan),
            readout: readout(dataset, config),
            view: plan.view,
            poses,
            fallback,
            prescribed: plan.prescribed.clone(),
            geometry: parts.geometry,
            places: parts.places,
            images: parts.images,
            store: parts.store,
            volume_budget_bytes: plan.volume_budget_bytes,
            cancelled,
            predicting,
        })
    }

    /// Every measurement of the recording, until Ctrl-C.
    fn push_recording(
        &self,
        engine: &mut Engine<'_>,
        sink: &mut dyn FnMut(MapEvent) -> Result<(), Error>,
    ) -> Result<(), Error> {
        let (total, mut done) = (self.dataset.images.len(), 0);
        for measurement in input::measurements(self.dataset, engine.needs_sensors()) {
            if self.cancel.is_cancelled() {
                break;
            }
            let is_image = !matches!(&measurement, Measurement::Event(vidar_core::SensorEvent::Imu(_)));
            match measurement {
                Measurement::Event(event) => engine.push(event, sink)?,
                Measurement::Stamp(stamp) => engine.push_stamp(stamp, sink)?,
                Measurement::Unreadable(stamp, error) => {
                    sink(MapEvent::Warning(unreadable(self.dataset, stamp, &error)))?;
                    engine.push_stamp(stamp, sink)?;
                }
            }
            if is_image {
                done += 1;
                self.events.emit(&Event::Progress { stage: MAP, done, total });
            }
        }
        Ok(())
    }
}

/// An image that the odometry has to do without. It is tracked across; if it becomes a keyframe, that is a degradation.
fn unreadable(dataset: &Recording, stamp: FrameStamp, error: &DatasetError) -> Warning {
    let entry = dataset.images.iter().find(|i| i.frame_id == stamp.frame_id);
    let warning = Warning::new("odometry-image-unreadable", error.to_string());
    entry.map_or(warning.clone(), |entry| warning.at(&entry.location))
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

/// Nothing was placed because the network's weights are synthetic: the error names them.
fn of_synthetic_weights(error: Error, plan: &Plan) -> Error {
    let identity = plan.network.as_ref().map(|n| &n.identity).filter(|i| !i.is_trained);
    match (error, identity) {
        (Error::Empty { keyframes, .. }, Some(i)) => Error::Untrained { keyframes, model: i.name.clone() },
        (error, _) => error,
    }
}
