//! The metric trajectory of a recording from its own camera and IMU: `vidar odometry`.

pub(crate) mod adjusted;
mod dump;
mod files;
pub(crate) mod map;
mod passes;
mod poses;
mod report;
mod summary;
mod tracked;

pub(crate) use map::EarlierMap;
pub use map::MapUse;
pub(crate) use passes::{TrackingInput, track};
pub(crate) use poses::TrackedPoses;
pub use tracked::{ApartSpan, LostSpan, Tracked, TrackedFrame};

use crate::calibrate;
use crate::camera_timing;
use crate::config::{Config, Layered};
use crate::error::{Error, ExitStatus};
use crate::events::{CancelToken, Event, Events};
use crate::input::{self, UnseenScale};
use crate::recorder::Recorder;
use crate::run_folder::{MANIFEST_SCHEMA, Manifest, OutputLocation, RunFolder};
use crate::verdict::{Findings, Level, StatedScale, Verdict};
use serde_json::json;
use std::collections::BTreeSet;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;
use vidar_core::{Trajectory, Warning};
use vidar_dataset::{OpenOptions, Recording};
use vidar_eval::TrajectoryReport;

/// Kind of the warning that there is no state at all.
const NEVER_STARTED: &str = "odometry-never-started";

/// What to run the odometry on, how, and where to.
#[derive(Clone, Debug)]
pub struct OdometryRequest {
    /// The recording.
    pub path: PathBuf,
    /// How to read it.
    pub open: OpenOptions,
    /// The configuration with its origins.
    pub layered: Layered,
    /// Where results go.
    pub place: OutputLocation,
    /// The command as typed, for the manifest.
    pub command: Vec<String>,
    /// Whether tracks, residuals and states are written out as tables.
    pub debug_dump: bool,
}

/// What a run of the odometry made.
#[derive(Debug)]
pub struct OdometryOutcome {
    /// The run folder.
    pub folder: PathBuf,
    /// Done, degraded (a lost span, or no trajectory at all) or interrupted.
    pub status: ExitStatus,
    /// What was tracked.
    pub tracked: Tracked,
    /// The longest segment's poses of the body as they were estimated live.
    pub trajectory: Option<Trajectory>,
    /// Poses of the body at every image after the adjustment.
    pub final_trajectory: Option<Trajectory>,
    /// The live trajectory against ground truth, where there is any.
    pub report: Option<TrajectoryReport>,
    /// The final one against it.
    pub final_report: Option<TrajectoryReport>,
    /// Every warning, in order.
    pub warnings: Vec<Warning>,
    /// What is said of the scale.
    pub scale: StatedScale,
    /// How far it may be trusted.
    pub verdict: Verdict,
    /// Wall time, s.
    pub seconds: f64,
}

/// Runs the odometry and writes trajectory, keyframes, landmarks, health per image and figures.
pub fn odometry(
    request: &OdometryRequest,
    events: &Events,
    cancel: &CancelToken,
) -> Result<OdometryOutcome, Error> {
    let clock = Instant::now();
    let started = crate::run_folder::now_rfc3339();
    let recorder = Recorder::default();
    let events = &recorder.listen(events.clone());
    let mut config = request.layered.build()?;
    let earlier_map = EarlierMap::of(&config)?;
    let mut dataset =
        events.stage("read", 0, || input::open_dataset(&request.path, &request.open, &config))?;
    let mut sigmas = adjusted::adjustable(&dataset, &config);
    let images = calibrate::complete(&mut dataset, &mut config.odometry, events, cancel)?;
    input::require_calibration(&dataset)?;
    let started_manifest = start_manifest(request, &dataset, started)?;
    let earlier = request.place.earlier(&started_manifest, &request.layered.to_toml(false))?;
    let folder = Arc::new(RunFolder::create(&request.place)?);
    recorder.keep_log_in(folder.clone());
    folder.write_manifest(&started_manifest)?;
    folder.write("config.resolved.toml", request.layered.to_toml(true).as_bytes())?;
    let mut dump = if request.debug_dump { Some(dump::Dump::create(&folder)?) } else { None };
    let settled = settle_timing(&mut dataset, &mut config, events, cancel)?;
    sigmas.iter_mut().for_each(|sigmas| sigmas.images = images.or(settled.images));
    let recording = TrackingInput { dataset: &dataset, config: &config, map: earlier_map.as_ref() };
    let tracked = track(&recording, sigmas.as_ref(), events, cancel, dump.as_mut())?;
    let dumped = dump.is_some();
    dump.map_or(Ok(()), dump::Dump::finish)?;

    let trajectory = tracked.longest_segment();
    let scale = tracked.stated_scale(UnseenScale::of(&dataset, &config));
    let mut warnings = dataset.warnings.clone();
    warnings.extend(settled.warning);
    warnings.extend(tracked.warnings());
    warnings.extend(trajectory.as_ref().and_then(|_| scale.warning()));
    warnings.extend(input::truth_in_imu(&dataset).err().map(|e| input::not_evaluated("ground truth", &e)));
    warnings.iter().for_each(|w| events.warn(w));
    let final_trajectory = tracked.adjusted.as_ref().and_then(adjusted::trajectory);
    let report = against_truth(trajectory.as_ref(), &dataset, &config)?;
    tracked.adjusted.iter().for_each(|adjusted| adjusted::apply(adjusted, &mut dataset));
    let final_report = against_truth(final_trajectory.as_ref(), &dataset, &config)?;
    let evaluated = final_report.as_ref().or(report.as_ref());
    let verdict = verdict(&tracked, &scale, evaluated, cancel.is_cancelled());
    let mut outcome = OdometryOutcome {
        folder: folder.path().to_owned(),
        status: ExitStatus::Done,
        tracked,
        trajectory,
        final_trajectory,
        report,
        final_report,
        warnings: recorder.warnings(),
        scale,
        verdict,
        seconds: clock.elapsed().as_secs_f64(),
    };
    let mut artifacts = events.stage("write", 0, || files::write(&outcome, &folder, events))?;
    if dumped {
        artifacts.extend([dump::TRACKS, dump::STATES].map(String::from));
    }
    let truth = input::truth_in_imu(&dataset).ok().flatten();
    let made = report::write(&outcome, truth.as_ref(), &dataset.name, &request.command, &folder)?;
    artifacts.extend(made);
    artifacts.extend(["log.jsonl", "manifest.json"].map(String::from));
    let artifacts: BTreeSet<String> = artifacts.into_iter().collect();
    if let Some(earlier) = earlier {
        earlier.remove_all_but(folder.path(), &artifacts);
    }
    // A log that could not be written is told by the recorder alone.
    outcome.warnings = recorder.warnings();
    outcome.status = ExitStatus::of_run(cancel.is_cancelled(), recorder.is_degraded());
    folder.write_manifest(&manifest(started_manifest, &outcome, artifacts))?;
    events.emit(&Event::Finished { exit: outcome.status as i32, seconds: outcome.seconds });
    Ok(outcome)
}

/// What precedes tracking: a calibration found where the recording states none, and the clock offset, readout time and rotation
/// of its camera. `dataset` and `config` are corrected; what was corrected is said.
///
/// # Errors
/// There is no calibration and the recording does not show one; what the odometry refuses.
pub fn prepare(
    dataset: &mut Recording,
    config: &mut Config,
    events: &Events,
    cancel: &CancelToken,
) -> Result<Option<Warning>, Error> {
    calibrate::complete(dataset, &mut config.odometry, events, cancel)?;
    input::require_calibration(dataset)?;
    Ok(settle_timing(dataset, config, events, cancel)?.warning)
}

fn settle_timing(
    dataset: &mut Recording,
    config: &mut Config,
    events: &Events,
    cancel: &CancelToken,
) -> Result<camera_timing::Settled, Error> {
    events.stage(camera_timing::STAGE, 0, || camera_timing::settle(dataset, config, events, cancel))
}

/// How far the trajectory may be trusted.
fn verdict(
    tracked: &Tracked,
    scale: &StatedScale,
    report: Option<&TrajectoryReport>,
    is_interrupted: bool,
) -> Verdict {
    let mut findings = Findings::default();
    findings.when(is_interrupted, Level::Bad, || "interrupted: only a part was tracked".into());
    if tracked.quality.longest().is_none() {
        let why = tracked.why_not_started().unwrap_or_else(|| "no images".into());
        findings.add(Level::Bad, format!("never started: {why}"));
        return findings.verdict(None);
    }
    findings.track(&tracked.quality);
    findings.scale(scale);
    let compared = report.and_then(|report| {
        findings.trajectory(report, scale);
        let ate = report.ate_se3_m.as_ref()?;
        Some(format!("ATE SE(3) {:.4} m against ground truth", ate.rmse))
    });
    findings.verdict(compared)
}

/// Scores against ground truth, where there are both and their bodies can be compared.
fn against_truth(
    trajectory: Option<&Trajectory>,
    dataset: &Recording,
    config: &Config,
) -> Result<Option<TrajectoryReport>, Error> {
    let truth = input::truth_in_imu(dataset).ok().flatten();
    let (Some(trajectory), Some(truth)) = (trajectory, truth) else { return Ok(None) };
    match vidar_eval::evaluate_trajectory(trajectory, &truth, &config.eval.trajectory) {
        Ok(report) => Ok(Some(report)),
        Err(vidar_eval::EvalError::NoMatches { .. }) => Ok(None),
        Err(other) => Err(other.into()),
    }
}

/// What is known before tracking.
fn start_manifest(
    request: &OdometryRequest,
    dataset: &Recording,
    started: String,
) -> Result<Manifest, Error> {
    Ok(Manifest {
        schema: MANIFEST_SCHEMA.into(),
        version: crate::VERSION.into(),
        command: request.command.clone(),
        started,
        dataset: json!({
            "name": dataset.name, "kind": dataset.kind.to_string(), "path": request.path.display().to_string(),
            "images": dataset.images.len(), "imu_samples": dataset.imu.len(),
        }),
        dataset_sha256: input::fingerprint(dataset)?,
        config_sha256: vidar_hub::sha256_hex(request.layered.to_toml(false).as_bytes()),
        poses: json!({ "source": "odometry" }),
        hardware: json!(crate::system::hardware()),
        ..Manifest::default()
    })
}

fn manifest(start: Manifest, outcome: &OdometryOutcome, artifacts: BTreeSet<String>) -> Manifest {
    let mut counts = std::collections::BTreeMap::<String, u64>::new();
    outcome.warnings.iter().for_each(|w| *counts.entry(w.kind.clone()).or_default() += 1);
    Manifest {
        peak_memory_bytes: crate::system::peak_memory_bytes(),
        result: outcome.result_json(),
        warnings: json!(counts),
        artifacts: artifacts.into_iter().collect(),
        exit: Some(outcome.status as i32),
        ..start
    }
}
