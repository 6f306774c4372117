//! One run: real frames in, a metric dense map out, judged.

mod dense;
mod judge;
mod live;
mod looks;
mod observation;
mod outputs;
mod pictures;
mod placed;
mod plan;
mod record;
mod reference;
mod source;
mod sparse;
mod surface;
mod views;

pub use judge::{DepthScore, Judgement};
pub use outputs::pose_of;
pub use plan::{Plan, bytes};

use crate::config::{Config, Layered};
use crate::error::{Error, ExitStatus};
use crate::events::{CancelToken, Event, Events};
use crate::input::{self, AnchorSource};
use crate::run_folder::{Place, RunFolder, StoredView};
use looks::Looks;
use record::Recorder;
pub(crate) use record::sha256_hex;
use source::Source;
use std::path::PathBuf;
use std::sync::Arc;
use vidar_align::Placement;
use vidar_core::{BodyFrame, PointCloud, StampedPose, Trajectory, TriangleMesh, Warning};
use vidar_dataset::{Dataset, OpenOptions};
use vidar_fusion::{CoverageReport, DoubleWallReport};

/// What to run on, how, and where to.
#[derive(Clone, Debug)]
pub struct RunRequest {
    /// The recording.
    pub path: PathBuf,
    /// How to read it.
    pub open: OpenOptions,
    /// The configuration with its origins.
    pub layered: Layered,
    /// A reference cloud (PLY, metres, in the world of ground truth) to judge against.
    pub reference: Option<PathBuf>,
    /// Where results go.
    pub place: Place,
    /// The command as typed, for the manifest.
    pub command: Vec<String>,
}

/// What a run made.
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
    /// How good it is, where that can be known.
    pub judgement: Judgement,
    /// Every warning, in order.
    pub warnings: Vec<Warning>,
    /// Wall time, s.
    pub seconds: f64,
}

impl RunOutcome {
    /// Counts and scores as JSON.
    pub fn result_json(&self) -> serde_json::Value {
        outputs::result_json(self)
    }

    /// What was made, how far to trust it, how long it took, what next: at most twelve lines.
    pub fn summary_lines(&self) -> Vec<(&'static str, String)> {
        pictures::summary_lines(self)
    }
}

/// The fused world.
#[derive(Debug, Default)]
pub struct MetricMap {
    /// Surface with triangles.
    pub mesh: TriangleMesh,
    /// Surface as points.
    pub cloud: PointCloud,
    /// Area, volume and how often it was seen.
    pub coverage: CoverageReport,
    /// Where chunks and keyframes stand, and how far to trust it.
    pub placement: Option<Placement>,
    /// Keyframes that got depth.
    pub views: Vec<StoredView>,
    /// Largest memory of the volume, bytes.
    pub volume_bytes: u64,
    /// How much of the surface is there twice.
    pub double_walls: Option<DoubleWallReport>,
    /// Depth against the depth sensor, where there is one.
    pub depth_scores: judge::DepthScorer,
    /// What the volume had to say.
    pub warnings: Vec<Warning>,
}

/// Looks at the input and says what a run would do, without doing it.
pub fn plan(request: &RunRequest) -> Result<Plan, Error> {
    let config = request.layered.build()?;
    let dataset = input::open_every_image(&request.path, &request.open, &config)?;
    let (events, cancel) = (Events::none(), CancelToken::new());
    Ok(Plan::make(&dataset, &config, request.reference.as_deref(), &events, &cancel)?.0)
}

/// Runs all of it. On Ctrl-C what is finished is fused, written and judged, and the status says so. A run that fails
/// after its folder was made leaves a manifest there that says why.
pub fn run(request: &RunRequest, events: &Events, cancel: &CancelToken) -> Result<RunOutcome, Error> {
    let clock = std::time::Instant::now();
    let recorder = Recorder::default();
    let events = recorder.listen(events.clone());
    let config = request.layered.build()?;
    let dataset =
        events.stage("read", 0, || input::open_every_image(&request.path, &request.open, &config))?;
    let (plan, sight) = Plan::make(&dataset, &config, request.reference.as_deref(), &events, cancel)?;
    let folder = Arc::new(RunFolder::create(&request.place)?);
    recorder.keep_log_in(folder.clone());
    dataset.warnings.iter().chain(&plan.warnings).for_each(|w| events.warn(w));
    let about = record::About::new(request, &dataset, &plan)?;

    let made = carry_out(request, &config, &dataset, (plan, sight), &folder, &events, cancel, &recorder);
    let made = made.map(|outcome| RunOutcome {
        seconds: clock.elapsed().as_secs_f64(),
        warnings: recorder.warnings(),
        ..outcome
    });
    let (exit, result) = match &made {
        Ok(outcome) => (outcome.status, outputs::result_json(outcome)),
        Err(error) => (error.exit_status(), record::failure_json(error)),
    };
    let noted = folder.write_manifest(&recorder.manifest(about, result, exit));
    let outcome = made?;
    noted?;
    events.emit(&Event::Finished { exit: exit as i32, seconds: outcome.seconds });
    Ok(outcome)
}

/// Dense map, judgement, files, report.
#[allow(clippy::too_many_arguments)] // one call, in the order in which `run` made them
fn carry_out(
    request: &RunRequest,
    config: &Config,
    dataset: &Dataset,
    (plan, sight): (Plan, (Source, Looks)),
    folder: &RunFolder,
    events: &Events,
    cancel: &CancelToken,
    recorder: &Recorder,
) -> Result<RunOutcome, Error> {
    folder.write("config.resolved.toml", request.layered.to_toml(true).as_bytes())?;
    let map = dense::build(dataset, &plan, sight, config, folder, events, cancel)?;
    let judgement = events.stage("judge", 0, || judge::judge(dataset, &plan, &map, config, events))?;
    let status = match (cancel.is_cancelled(), recorder.is_degraded() || map.mesh.triangles.is_empty()) {
        (true, _) => ExitStatus::Interrupted,
        (false, true) => ExitStatus::Degraded,
        (false, false) => ExitStatus::Done,
    };
    let outcome = RunOutcome {
        folder: folder.path().to_owned(),
        status,
        plan,
        map,
        judgement,
        warnings: recorder.warnings(),
        seconds: 0.0,
    };
    events.stage("write", 0, || outputs::write(&outcome, config, request, folder, events))?;
    if config.output.report {
        events.stage("report", 0, || pictures::draw(&outcome, dataset, request, folder, events))?;
    }
    Ok(outcome)
}

/// Whether the metric poses are ground truth.
pub(crate) fn anchored_by_truth(plan: &Plan) -> bool {
    plan.anchor.as_ref().is_some_and(|a| a.source == AnchorSource::GroundTruth)
}

/// The keyframes' poses in the map as a trajectory of the camera.
pub(crate) fn keyframe_trajectory(plan: &Plan, map: &MetricMap) -> Option<Trajectory> {
    let placement = map.placement.as_ref()?;
    let time = |frame| plan.keyframes.iter().find(|k| k.image.frame_id == frame).map(|k| k.image.time);
    let poses = placement
        .keyframes
        .iter()
        .filter_map(|k| Some(StampedPose { time: time(k.frame_id)?, world_from_body: k.world_from_camera }))
        .collect();
    let camera = plan.keyframes.first()?.image.camera;
    Trajectory::new(BodyFrame::Camera(camera), poses).ok()
}
