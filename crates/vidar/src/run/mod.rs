//! One run: real frames in, a metric dense map out, judged.

mod dense;
mod judge;
mod outputs;
mod pictures;
mod plan;
mod reference;
mod views;

pub use judge::{DepthScore, Judgement};
pub use outputs::pose_of;
pub use plan::{Plan, bytes};

use crate::config::Layered;
use crate::error::{Error, ExitStatus};
use crate::events::{CancelToken, Event, Events};
use crate::input::{self, AnchorSource};
use crate::run_folder::{Manifest, Place, RunFolder, StoredView};
use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use vidar_core::{PointCloud, Trajectory, TriangleMesh, Warning};
use vidar_dataset::OpenOptions;
use vidar_fusion::CoverageReport;

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
    /// Keyframes that got depth.
    pub views: Vec<StoredView>,
    /// Largest memory of the volume, bytes.
    pub volume_bytes: u64,
    /// Depth against the depth sensor, where there is one.
    pub depth_scores: judge::DepthScorer,
    /// What the volume had to say.
    pub warnings: Vec<Warning>,
}

/// Looks at the input and says what a run would do, without doing it.
pub fn plan(request: &RunRequest) -> Result<Plan, Error> {
    let config = request.layered.build()?;
    let dataset = input::open_dataset(&request.path, &request.open, &config)?;
    Plan::make(&dataset, &config, request.reference.as_deref())
}

/// Runs all of it. On Ctrl-C what is finished is fused, written and judged, and the status says so.
pub fn run(request: &RunRequest, events: &Events, cancel: &CancelToken) -> Result<RunOutcome, Error> {
    let clock = std::time::Instant::now();
    let config = request.layered.build()?;
    let dataset = events.stage("read", 0, || input::open_dataset(&request.path, &request.open, &config))?;
    let plan = Plan::make(&dataset, &config, request.reference.as_deref())?;
    let folder = Arc::new(RunFolder::create(&request.place)?);
    let recorder = Recorder::default();
    let events = recorder.attach(events.clone(), folder.clone());
    dataset.warnings.iter().chain(&plan.warnings).for_each(|w| events.warn(w));
    folder.write("config.resolved.toml", request.layered.to_toml(true).as_bytes())?;

    let map = dense::build(&dataset, &plan, &config, &folder, &events, cancel)?;
    let judgement = events.stage("judge", 0, || judge::judge(&dataset, &plan, &map, &config, &events))?;
    let status = match (cancel.is_cancelled(), recorder.is_degraded() || map.mesh.triangles.is_empty()) {
        (true, _) => ExitStatus::Interrupted,
        (false, true) => ExitStatus::Degraded,
        (false, false) => ExitStatus::Done,
    };
    let mut outcome = RunOutcome {
        folder: folder.path().to_owned(),
        status,
        plan,
        map,
        judgement,
        warnings: recorder.warnings(),
        seconds: 0.0,
    };
    events.stage("write", 0, || outputs::write(&outcome, &config, request, &folder, &events))?;
    if config.output.report {
        events.stage("report", 0, || pictures::draw(&outcome, &dataset, request, &folder, &events))?;
    }
    outcome.seconds = clock.elapsed().as_secs_f64();
    outcome.warnings = recorder.warnings();
    let manifest = manifest(&outcome, &dataset, request, &recorder)?;
    folder.write_manifest(&manifest)?;
    events.emit(&Event::Finished { exit: status as i32, seconds: outcome.seconds });
    Ok(outcome)
}

/// Remembers what the events said, for the manifest.
#[derive(Clone, Default)]
struct Recorder(Arc<Mutex<Recorded>>);

#[derive(Default)]
struct Recorded {
    warnings: Vec<Warning>,
    seconds: Vec<(&'static str, f64)>,
    artifacts: Vec<String>,
}

/// Kinds of warnings that mean that part of the result is missing.
const DEGRADING: &[&str] = &[
    "image-unreadable",
    "image-empty",
    "image-missing",
    "chunk-failed",
    "chunk-not-placed",
    "memory-budget",
    "no-parallax",
    "depth-unreadable",
    "not-judged",
];

impl Recorder {
    fn attach(&self, events: Events, folder: Arc<RunFolder>) -> Events {
        let recorded = self.0.clone();
        events.with(move |event| {
            folder.log(event);
            let Ok(mut recorded) = recorded.lock() else { return };
            match event {
                Event::Warning { warning } => recorded.warnings.push(warning.clone()),
                Event::StageFinished { stage, seconds } => recorded.seconds.push((stage, *seconds)),
                Event::ArtifactWritten { path, .. } => recorded.artifacts.push(path.clone()),
                _ => {}
            }
        })
    }

    fn read<T>(&self, f: impl FnOnce(&Recorded) -> T) -> T {
        match self.0.lock() {
            Ok(recorded) => f(&recorded),
            Err(poisoned) => f(&poisoned.into_inner()),
        }
    }

    fn warnings(&self) -> Vec<Warning> {
        self.read(|r| r.warnings.clone())
    }

    fn is_degraded(&self) -> bool {
        self.read(|r| r.warnings.iter().any(|w| DEGRADING.contains(&w.kind.as_str())))
    }
}

fn manifest(
    outcome: &RunOutcome,
    dataset: &vidar_dataset::Dataset,
    request: &RunRequest,
    recorder: &Recorder,
) -> Result<Manifest, Error> {
    let mut counts = std::collections::BTreeMap::<&str, u64>::new();
    outcome.warnings.iter().for_each(|w| *counts.entry(&w.kind).or_default() += 1);
    Ok(Manifest {
        schema: crate::run_folder::MANIFEST_SCHEMA.into(),
        version: crate::VERSION.into(),
        command: request.command.clone(),
        started: outcome.plan.started.clone(),
        dataset: serde_json::json!({
            "name": dataset.name, "kind": dataset.kind.to_string(), "path": request.path.display().to_string(),
            "images": dataset.images.len(), "imu_samples": dataset.imu.len(), "depth_images": dataset.depths.len(),
        }),
        dataset_sha256: sha256_hex(&dataset.fingerprint()?),
        config_sha256: sha256_hex(request.layered.to_toml(false).as_bytes()),
        model: serde_json::json!(outcome.plan.model),
        poses: serde_json::json!(outcome.plan.anchor.source),
        hardware: serde_json::json!(crate::system::hardware()),
        seconds: recorder.read(|r| r.seconds.iter().map(|(k, s)| ((*k).to_owned(), (*s).into())).collect()),
        peak_memory_bytes: crate::system::peak_memory_bytes(),
        result: outputs::result_json(outcome),
        warnings: serde_json::json!(counts),
        artifacts: recorder.read(|r| r.artifacts.clone()),
        exit: outcome.status as i32,
    })
}

fn sha256_hex(bytes: &[u8]) -> String {
    use sha2::{Digest, Sha256};
    Sha256::digest(bytes).iter().map(|b| format!("{b:02x}")).collect()
}

/// The trajectory that anchored the run and where it came from.
pub(crate) fn anchored_by_truth(plan: &Plan) -> bool {
    plan.anchor.source == AnchorSource::GroundTruth
}

/// The keyframes' poses as a trajectory of the camera.
pub(crate) fn keyframe_trajectory(plan: &Plan) -> Option<Trajectory> {
    let poses = plan
        .keyframes
        .iter()
        .map(|k| vidar_core::StampedPose { time: k.image.time, world_from_body: k.world_from_camera })
        .collect();
    Trajectory::new(plan.anchor.camera_trajectory.body(), poses).ok()
}
