//! The metric trajectory of a recording from its own camera and IMU: `vidar odometry`.

pub(crate) mod adjusted;
mod dump;
mod files;
pub(crate) mod map;
mod poses;
mod report;
mod summary;
mod tracked;

pub(crate) use map::EarlierMap;
pub use map::MapUse;
pub(crate) use poses::TrackedPoses;
pub use tracked::{ApartSpan, LostSpan, Tracked, TrackedFrame};

use crate::calibrate;
use crate::camera_timing;
use crate::config::{Config, Layered};
use crate::error::{Error, ExitStatus};
use crate::events::{CancelToken, Event, Events};
use crate::input::{self, Measurement, UnseenScale};
use crate::recorder::Recorder;
use crate::run_folder::{MANIFEST_SCHEMA, Manifest, OutputLocation, RunFolder};
use crate::verdict::{Findings, Level, StatedScale, Verdict};
use serde_json::json;
use std::collections::BTreeSet;
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Instant;
use vidar_core::{Trajectory, Warning};
use vidar_dataset::{OpenOptions, Recording};
use vidar_eval::TrajectoryReport;
use vidar_odometry::bundle_adjustment::{CalibrationSigmas, Progress};
use vidar_odometry::{ImuUse, Odometry};

/// The stage of the adjustment, in events.
const ADJUSTMENT: &str = "adjustment";
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
    let sigmas = adjusted::adjustable(&dataset, &config);
    calibrate::complete(&mut dataset, &mut config.odometry, events, cancel)?;
    input::require_calibration(&dataset)?;
    let started_manifest = start_manifest(request, &dataset, started)?;
    let earlier = request.place.earlier(&started_manifest, &request.layered.to_toml(false))?;
    let folder = Arc::new(RunFolder::create(&request.place)?);
    recorder.keep_log_in(folder.clone());
    folder.write_manifest(&started_manifest)?;
    folder.write("config.resolved.toml", request.layered.to_toml(true).as_bytes())?;
    let mut dump = if request.debug_dump { Some(dump::Dump::create(&folder)?) } else { None };
    let timing = settle_timing(&mut dataset, &mut config, events, cancel)?;
    let recording = TrackingInput { dataset: &dataset, config: &config, map: earlier_map.as_ref() };
    let tracked = track(&recording, sigmas.as_ref(), events, cancel, dump.as_mut())?;
    let dumped = dump.is_some();
    dump.map_or(Ok(()), dump::Dump::finish)?;

    let trajectory = tracked.longest_segment();
    let scale = tracked.stated_scale(UnseenScale::of(&dataset, &config));
    let mut warnings = dataset.warnings.clone();
    warnings.extend(timing);
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
    settle_timing(dataset, config, events, cancel)
}

fn settle_timing(
    dataset: &mut Recording,
    config: &mut Config,
    events: &Events,
    cancel: &CancelToken,
) -> Result<Option<Warning>, Error> {
    events.stage(camera_timing::STAGE, 0, || camera_timing::settle(dataset, config, events, cancel))
}

/// What is tracked.
pub(crate) struct TrackingInput<'a> {
    pub dataset: &'a Recording,
    pub config: &'a Config,
    /// The map to look in.
    pub map: Option<&'a EarlierMap>,
}

/// Noise of the gyroscope, as a multiple of the data sheet's, with which images that are shifted by half a degree against it are followed. With 30, 60 and 100
/// six rendered phones began 1 to 13, 1 to 4 and 1 to 2 s after the first image; once they were adjusted, their errors were the same.
const STABILISED_NOISE_FACTOR: f64 = 60.0;

/// Feeds a recording to the odometry, and adjusts all states after its end where `adjustable` says what may change. Where images and IMU contradict
/// each other, all of it happens once more as for stabilised images; that result stands where the adjustment shows that they are, and explains the recording.
pub(crate) fn track(
    recording: &TrackingInput<'_>,
    adjustable: Option<&CalibrationSigmas>,
    events: &Events,
    cancel: &CancelToken,
    mut dump: Option<&mut dump::Dump>,
) -> Result<Tracked, Error> {
    let tracked = track_calibrated(recording, adjustable, events, cancel, dump.as_deref_mut())?;
    if adjustable.is_none() || !tracked.is_contradicted() || cancel.is_cancelled() {
        return Ok(tracked);
    }
    let mut config = recording.config.clone();
    let factor = &mut config.odometry.gyro_noise_factor;
    *factor = factor.max(STABILISED_NOISE_FACTOR);
    if let Some(dump) = dump.as_deref_mut() {
        dump.begin_again()?;
    }
    let recording = TrackingInput { config: &config, ..*recording };
    let again = track_calibrated(&recording, adjustable, events, cancel, dump)?;
    Ok(if again.adjusted.as_ref().is_some_and(adjusted::explains_as_shifted) { again } else { tracked })
}

/// Feeds a recording to the odometry, and adjusts all states after its end where `adjustable` says what may change. Where that leaves
/// camera and IMU apart and the calibration is the recording's own, all of it happens once more with the calibration as adjusted.
fn track_calibrated(
    recording: &TrackingInput<'_>,
    adjustable: Option<&CalibrationSigmas>,
    events: &Events,
    cancel: &CancelToken,
    mut dump: Option<&mut dump::Dump>,
) -> Result<Tracked, Error> {
    let tracked = track_once(recording, adjustable, events, cancel, dump.as_deref_mut())?;
    let TrackingInput { dataset, config, map } = *recording;
    let first = tracked.adjusted.as_ref().filter(|a| input::leaves_calibration_unchecked(dataset, a));
    let Some(first) = first.filter(|_| !cancel.is_cancelled()) else { return Ok(tracked) };
    let focal = |dataset: &Recording| dataset.rig.cameras[dataset.camera.index()].model.intrinsics().fx;
    let before = focal(dataset);
    let (mut dataset, mut config) = (dataset.clone(), config.clone());
    adjusted::apply(first, &mut dataset);
    config.odometry.readout_ms = Some(1e3 * first.calibration.readout_secs);
    if let Some(dump) = dump.as_deref_mut() {
        dump.begin_again()?;
    }
    let again = TrackingInput { dataset: &dataset, config: &config, map };
    let mut again = track_once(&again, adjustable, events, cancel, dump)?;
    again.calibrated_again = Some([before, focal(&dataset)]);
    Ok(if again.adjusted.is_some() { again } else { tracked })
}

fn track_once(
    recording: &TrackingInput<'_>,
    adjustable: Option<&CalibrationSigmas>,
    events: &Events,
    cancel: &CancelToken,
    dump: Option<&mut dump::Dump>,
) -> Result<Tracked, Error> {
    let total = recording.dataset.images.len();
    let keeps_log = adjustable.is_some();
    let (mut tracked, odometry) =
        events.stage("odometry", total, || push_all(recording, keeps_log, events, cancel, dump))?;
    if let Some(sigmas) = adjustable.filter(|_| tracked.with_imu && !cancel.is_cancelled()) {
        let mut tell = |progress: Progress| {
            events.emit(&Event::Progress { stage: ADJUSTMENT, done: progress.states, total: progress.of });
            if cancel.is_cancelled() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        };
        match events.stage(ADJUSTMENT, 0, || odometry.adjust_with(sigmas, &mut tell)) {
            Ok(mut adjusted) if adjusted.is_consistent() => {
                if let Some(joined) = odometry.place_in_map(&adjusted) {
                    adjusted.join(&joined);
                    tracked.map.iter_mut().for_each(|map| map.matches = Some(joined.matches));
                }
                tracked.quality.adjust(&adjusted);
                tracked.adjusted = Some(adjusted);
            }
            Ok(_) => tracked.not_adjusted = Some("camera and IMU contradict each other".into()),
            Err(reason) => tracked.not_adjusted = Some(reason.to_string()),
        }
    }
    tracked.saved_map = odometry.saved_map(tracked.adjusted.as_ref());
    Ok(tracked)
}

fn push_all(
    recording: &TrackingInput<'_>,
    keeps_log: bool,
    events: &Events,
    cancel: &CancelToken,
    mut dump: Option<&mut dump::Dump>,
) -> Result<(Tracked, Odometry), Error> {
    let TrackingInput { dataset, config, map } = *recording;
    let settings = &config.odometry;
    let mut odometry = Odometry::new(&dataset.rig, dataset.camera, settings)?;
    if let Some(earlier) = map {
        odometry = odometry.with_map(&earlier.map);
    }
    let with_imu = settings.imu != ImuUse::Off && dataset.rig.imu.is_some();
    if keeps_log && with_imu {
        odometry.keep_log();
    }
    let map = map.map(|m| MapUse { file: m.path.clone(), found_live_ns: None, matches: None });
    let mut tracked = Tracked { with_imu, map, ..Tracked::default() };
    let total = dataset.images.len();
    let mut spent = 0.0;
    for measurement in input::measurements(dataset, true) {
        if cancel.is_cancelled() {
            break;
        }
        let event = match measurement {
            Measurement::Event(event) => event,
            // A broken image is a gap in the stream, not the end of the flight.
            Measurement::Unreadable(_, error) => {
                tracked.unreadable.push(error.to_string());
                continue;
            }
            Measurement::Stamp(_) => continue,
        };
        let clock = Instant::now();
        let output = odometry.push(event)?;
        spent += clock.elapsed().as_secs_f64();
        if let Some(output) = output {
            if let Some(dump) = &mut dump {
                dump.add(&output, &odometry.tracks())?;
            }
            tracked.keep(output, std::mem::take(&mut spent));
            let done = tracked.frames.len();
            events.emit(&Event::Progress { stage: "odometry", done, total });
        }
    }
    for output in odometry.finish() {
        tracked.keep(output, 0.0);
    }
    tracked.counts = odometry.counts();
    tracked.carrier_share = odometry.carrier_share();
    Ok((tracked, odometry))
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
