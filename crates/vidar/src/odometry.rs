//! The metric trajectory of a recording from its own camera and IMU: `vidar odometry`.

pub(crate) mod adjusted;
mod dump;
mod files;
mod poses;
mod report;

pub(crate) use poses::TrackedPoses;

use crate::calibrate;
use crate::camera_timing;
use crate::config::{Config, Layered};
use crate::error::{Error, ExitStatus};
use crate::events::{CancelToken, Event, Events};
use crate::input::{self, Measurement, UnseenScale};
use crate::quality::TrackQuality;
use crate::run_folder::{MANIFEST_SCHEMA, Manifest, OutputLocation, RunFolder};
use crate::verdict::{Findings, Level, ScaleSource, StatedScale, Verdict};
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::ops::ControlFlow;
use std::path::PathBuf;
use std::time::Instant;
use vidar_core::{BodyFrame, OdometryKeyframe, RevisedPose, Severity, StampedPose, Trajectory, Warning};
use vidar_dataset::{Dataset, OpenOptions};
use vidar_eval::TrajectoryReport;
use vidar_odometry::bundle_adjustment::{Adjusted, CalibrationSigmas, Progress};
use vidar_odometry::{ImuUse, InputCounts, Joined, Odometry, OdometryOutput, Status};

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

/// One image as the odometry left it.
#[derive(Clone, Debug)]
pub struct TrackedFrame {
    /// The output for it; landmarks, keyframe and revisions are kept elsewhere.
    pub output: OdometryOutput,
    /// Wall time that it took, s, decoding left out.
    pub seconds: f64,
}

/// A span of images without a state, after there had been one.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct LostSpan {
    /// First image of the span, ns.
    pub from_ns: i64,
    /// First image with a state again, ns; `None` when there was none.
    pub until_ns: Option<i64>,
    /// Why the state was given up.
    pub reason: String,
    /// Image at which the place was found again, ns: the states after the span are in the world of those before it. `None` where it was not.
    pub found_again_ns: Option<i64>,
}

/// All outputs of the odometry on a recording.
#[derive(Clone, Debug, Default)]
pub struct Tracked {
    /// Every image, in order.
    pub frames: Vec<TrackedFrame>,
    /// Keyframes with their last poses.
    pub keyframes: Vec<OdometryKeyframe>,
    /// Spans without a state.
    pub lost: Vec<LostSpan>,
    /// What was taken and left out.
    pub counts: InputCounts,
    /// Errors of images that could not be read; they are skipped.
    pub unreadable: Vec<String>,
    /// Whether camera and IMU were used together; else the trajectory is known up to scale.
    pub with_imu: bool,
    /// Health, coverage and scale over the whole recording.
    pub quality: TrackQuality,
    /// All states adjusted together after the end, where that was asked for and camera and IMU agree in it.
    pub adjusted: Option<Adjusted>,
    /// Why there are none.
    pub not_adjusted: Option<String>,
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
    let mut config = request.layered.build()?;
    let mut dataset =
        events.stage("read", 0, || input::open_dataset(&request.path, &request.open, &config))?;
    let sigmas = adjusted::adjustable(&dataset, &config);
    calibrate::complete(&mut dataset, &mut config.odometry, events, cancel)?;
    input::require_calibration(&dataset)?;
    let started_manifest = start_manifest(request, &dataset, started)?;
    let earlier = request.place.earlier(&started_manifest, &request.layered.to_toml(false))?;
    let folder = RunFolder::create(&request.place)?;
    folder.write_manifest(&started_manifest)?;
    folder.write("config.resolved.toml", request.layered.to_toml(true).as_bytes())?;
    let mut dump = if request.debug_dump { Some(dump::Dump::create(&folder)?) } else { None };
    let timing = events.stage(camera_timing::STAGE, 0, || {
        camera_timing::settle(&mut dataset, &mut config, events, cancel)
    })?;
    let tracked = track(&dataset, &config, sigmas.as_ref(), events, cancel, dump.as_mut())?;
    let dumped = dump.is_some();
    dump.map_or(Ok(()), dump::Dump::finish)?;

    let trajectory = tracked.longest_segment();
    let scale = tracked.stated_scale(UnseenScale::of(&dataset, &config));
    let mut warnings = dataset.warnings.clone();
    warnings.extend(timing);
    warnings.extend(tracked.warnings());
    warnings.extend(trajectory.as_ref().and_then(|_| scale.warning()));
    warnings.iter().for_each(|w| events.warn(w));
    let final_trajectory = tracked.adjusted.as_ref().and_then(adjusted::trajectory);
    let report = against_truth(trajectory.as_ref(), &dataset, &config)?;
    tracked.adjusted.iter().for_each(|adjusted| adjusted::apply(adjusted, &mut dataset));
    let final_report = against_truth(final_trajectory.as_ref(), &dataset, &config)?;
    let is_degraded = warnings.iter().any(|w| w.severity == Severity::Degraded);
    let judged = final_report.as_ref().or(report.as_ref());
    let verdict = verdict(&tracked, &scale, judged, cancel.is_cancelled());
    let status = match (cancel.is_cancelled(), is_degraded) {
        (true, _) => ExitStatus::Interrupted,
        (false, true) => ExitStatus::Degraded,
        (false, false) => ExitStatus::Done,
    };
    let outcome = OdometryOutcome {
        folder: folder.path().to_owned(),
        status,
        tracked,
        trajectory,
        final_trajectory,
        report,
        final_report,
        warnings,
        scale,
        verdict,
        seconds: clock.elapsed().as_secs_f64(),
    };
    let mut artifacts = events.stage("write", 0, || files::write(&outcome, &folder, events))?;
    if dumped {
        artifacts.extend([dump::TRACKS, dump::STATES].map(String::from));
    }
    let truth = dataset.ground_truth.as_ref().and_then(|t| t.in_frame(BodyFrame::Imu, &dataset.rig).ok());
    let made = report::write(&outcome, truth.as_ref(), &dataset.name, &request.command, &folder)?;
    artifacts.extend(made);
    artifacts.extend(["log.jsonl", "manifest.json"].map(String::from));
    let artifacts: BTreeSet<String> = artifacts.into_iter().collect();
    if let Some(earlier) = earlier {
        earlier.remove_all_but(folder.path(), &artifacts);
    }
    folder.write_manifest(&manifest(started_manifest, &outcome, artifacts))?;
    events.emit(&Event::Finished { exit: status as i32, seconds: outcome.seconds });
    Ok(outcome)
}

/// Feeds a recording to the odometry, and adjusts all states after its end where `adjustable` says what may change.
pub(crate) fn track(
    dataset: &Dataset,
    config: &Config,
    adjustable: Option<&CalibrationSigmas>,
    events: &Events,
    cancel: &CancelToken,
    dump: Option<&mut dump::Dump>,
) -> Result<Tracked, Error> {
    let total = dataset.images.len();
    let keeps_log = adjustable.is_some();
    let (mut tracked, odometry) =
        events.stage("odometry", total, || push_all(dataset, config, keeps_log, events, cancel, dump))?;
    if let Some(sigmas) = adjustable.filter(|_| tracked.with_imu && !cancel.is_cancelled()) {
        let mut tell = |progress: Progress| {
            events.emit(&Event::Progress { stage: ADJUSTMENT, done: progress.states, total: progress.of });
            if cancel.is_cancelled() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        };
        match events.stage(ADJUSTMENT, 0, || odometry.adjust_with(sigmas, &mut tell)) {
            Ok(adjusted) if adjusted.is_consistent() => {
                tracked.quality.adjust(&adjusted);
                tracked.adjusted = Some(adjusted);
            }
            Ok(_) => tracked.not_adjusted = Some("camera and IMU contradict each other".into()),
            Err(reason) => tracked.not_adjusted = Some(reason.to_string()),
        }
    }
    Ok(tracked)
}

fn push_all(
    dataset: &Dataset,
    config: &Config,
    keeps_log: bool,
    events: &Events,
    cancel: &CancelToken,
    mut dump: Option<&mut dump::Dump>,
) -> Result<(Tracked, Odometry), Error> {
    let settings = &config.odometry;
    let mut odometry = Odometry::new(&dataset.rig, dataset.camera, settings)?;
    let with_imu = settings.imu != ImuUse::Off && dataset.rig.imu.is_some();
    if keeps_log && with_imu {
        odometry.keep_log();
    }
    let mut tracked = Tracked { with_imu, ..Tracked::default() };
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
    Ok((tracked, odometry))
}

impl Tracked {
    fn keep(&mut self, mut output: OdometryOutput, seconds: f64) {
        let time_ns = output.time.nanos();
        self.quality.add(&output);
        match &mut output.status {
            Status::Tracking(tracking) => {
                if let Some(open) = self.lost.last_mut().filter(|l| l.until_ns.is_none()) {
                    open.until_ns = Some(time_ns);
                }
                tracking.joined.iter().for_each(|joined| self.join(joined, time_ns));
                self.keyframes.extend(tracking.keyframe.take().map(|k| *k));
                let revised = std::mem::take(&mut tracking.revised);
                revised.iter().for_each(|r| self.revise(r));
                tracking.landmarks.clear();
            }
            Status::Lost(reason) => {
                let reason = reason.to_string();
                self.lost.push(LostSpan { from_ns: time_ns, until_ns: None, reason, found_again_ns: None });
            }
            Status::Waiting(_) => {}
        }
        self.frames.push(TrackedFrame { output, seconds });
    }

    /// States of a segment that turns out to be of the same world as another one go there.
    fn join(&mut self, joined: &Joined, time_ns: i64) {
        for frame in &mut self.frames {
            if let Status::Tracking(tracking) = &mut frame.output.status {
                joined.apply(&mut tracking.segment, &mut tracking.state);
            }
        }
        self.keyframes.iter_mut().for_each(|k| joined.apply_to_keyframe(k));
        if let Some(lost) = self.lost.last_mut() {
            lost.found_again_ns = Some(time_ns);
        }
    }

    fn revise(&mut self, revised: &RevisedPose) {
        if let Some(keyframe) = self.keyframes.iter_mut().rev().find(|k| k.id == revised.id) {
            keyframe.world_from_camera = revised.world_from_camera;
        }
    }

    /// Poses of the body in the segment with the most images; `None` when there are fewer than two.
    pub fn longest_segment(&self) -> Option<Trajectory> {
        let with_state = || self.frames.iter().filter_map(|f| Some((f.output.time, f.output.tracking()?)));
        let mut counts = std::collections::BTreeMap::<u32, usize>::new();
        with_state().for_each(|(_, t)| *counts.entry(t.segment).or_default() += 1);
        // Of equally long segments the first.
        let (segment, _) = counts.iter().max_by_key(|(segment, n)| (**n, std::cmp::Reverse(**segment)))?;
        let poses: Vec<StampedPose> = with_state()
            .filter(|(_, t)| t.segment == *segment)
            .map(|(time, t)| StampedPose { time, world_from_body: t.state.world_from_body })
            .collect();
        (poses.len() >= 2).then(|| Trajectory::new(BodyFrame::Imu, poses).ok()).flatten()
    }

    /// Seconds from the first image to the first state.
    pub fn first_state_secs(&self) -> Option<f64> {
        let first = self.frames.first()?.output.time;
        let state = self.frames.iter().find(|f| f.output.tracking().is_some())?;
        Some((state.output.time - first).as_secs_f64())
    }

    /// What is said of the scale; `unseen`: σ(ln s) of what its estimate does not see.
    pub fn stated_scale(&self, unseen: UnseenScale) -> StatedScale {
        let source = match self.with_imu {
            true => unseen.source(&self.quality),
            false => ScaleSource::None,
        };
        StatedScale::new(source, None)
    }

    /// Why it never had a state.
    pub(crate) fn why_not_started(&self) -> Option<String> {
        self.quality.why_not_started()
    }

    pub(crate) fn warnings(&self) -> Vec<Warning> {
        let mut warnings = Vec::new();
        if let Some(first) = self.unreadable.first() {
            let text = format!("{} images left out; the first: {first}", self.unreadable.len());
            warnings.push(Warning::new("odometry-image-unreadable", text));
        }
        for span in &self.lost {
            let at = vidar_core::Timestamp::from_nanos(span.from_ns);
            let hint = match span.found_again_ns.map(vidar_core::Timestamp::from_nanos) {
                Some(again) => format!(
                    "the place was found again at {again} s: one world; odometry/health.csv lists every image"
                ),
                None => {
                    "poses after it are a segment of their own; odometry/health.csv lists every image".into()
                }
            };
            warnings.push(Warning::degraded("track-lost", format!("at {at} s: {}", span.reason)).hint(hint));
        }
        if !self.frames.iter().any(|f| f.output.tracking().is_some()) {
            let why = self.why_not_started().unwrap_or_else(|| "no images".into());
            let text = format!("the odometry never started: {why}");
            let hint =
                "`vidar inspect` shows calibration and units in plain words; docs/failures.md lists causes";
            warnings.push(Warning::degraded(NEVER_STARTED, text).hint(hint));
        }
        if let (Some(reason), true) = (&self.not_adjusted, self.quality.longest().is_some()) {
            warnings.push(Warning::new("not-adjusted", format!("the live states are final: {reason}")));
        }
        warnings.extend(self.adjusted.iter().flat_map(adjusted::warnings));
        if !self.with_imu {
            let text =
                "one camera without an IMU: the trajectory is known up to scale, lengths are not metres";
            warnings.push(Warning::new("scale-unknown", text));
        }
        warnings
    }
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

/// Scores against ground truth, where there are both.
fn against_truth(
    trajectory: Option<&Trajectory>,
    dataset: &Dataset,
    config: &Config,
) -> Result<Option<TrajectoryReport>, Error> {
    let (Some(trajectory), Some(truth)) = (trajectory, &dataset.ground_truth) else { return Ok(None) };
    let truth = truth.in_frame(BodyFrame::Imu, &dataset.rig).ok();
    let Some(truth) = truth.and_then(|t| input::in_image_clock(&t, dataset)) else { return Ok(None) };
    match vidar_eval::evaluate_trajectory(trajectory, &truth, &config.eval.trajectory) {
        Ok(report) => Ok(Some(report)),
        Err(vidar_eval::EvalError::NoMatches { .. }) => Ok(None),
        Err(other) => Err(other.into()),
    }
}

impl OdometryOutcome {
    /// Counts and scores as JSON.
    pub fn result_json(&self) -> Value {
        let tracked = &self.tracked;
        let with_state = tracked.frames.iter().filter(|f| f.output.tracking().is_some()).count();
        let mut health = std::collections::BTreeMap::<&str, usize>::new();
        for frame in &tracked.frames {
            *health.entry(files::word(&frame.output)).or_default() += 1;
        }
        json!({
            "verdict": self.verdict,
            "is_metric": self.scale.is_metric,
            "scale": self.scale,
            "quality": tracked.quality.json(),
            "images": tracked.frames.len(),
            "images_with_state": with_state,
            "first_state_secs": tracked.first_state_secs(),
            "keyframes": tracked.keyframes.len(),
            "path_m": self.trajectory.as_ref().map(Trajectory::path_length_m),
            "health": health,
            "lost": tracked.lost,
            "images_out_of_order": tracked.counts.images_out_of_order,
            "images_repeated": tracked.counts.images_repeated,
            "imu_samples_rejected": tracked.counts.imu_samples_rejected,
            "imu_gaps": tracked.counts.imu_gaps,
            "milliseconds_per_image": files::milliseconds(tracked),
            "trajectory": self.report,
            "final": tracked.adjusted.as_ref().map(|adjusted| json!({
                "images": adjusted.images.len(),
                "scale_std": adjusted.scale_std,
                "adjustment": adjusted.report,
                "calibration": adjusted::calibration_json(adjusted),
                "imu": adjusted::imu_json(adjusted),
                "trajectory": self.final_report,
            })),
        })
    }

    /// What was made and how far to trust it.
    pub fn summary_lines(&self) -> Vec<(&'static str, String)> {
        let tracked = &self.tracked;
        let unit = if self.scale.is_metric { "m" } else { "units (lengths are not metres)" };
        let mut lines = vec![
            ("verdict", self.verdict.line()),
            ("tracked", tracked.quality.words()),
            ("scale", self.scale.words.clone()),
            ("keyframes", tracked.keyframes.len().to_string()),
        ];
        if let Some(trajectory) = &self.trajectory {
            lines.push(("path", format!("{:.2} {unit}", trajectory.path_length_m())));
        }
        if let Some(secs) = tracked.first_state_secs() {
            lines.push(("first state", format!("{secs:.2} s after the first image")));
        }
        let metres = |e: Option<vidar_eval::ErrorStats>| e.map_or("-".into(), |e| format!("{:.4} m", e.rmse));
        let mut both =
            |label, of: &dyn Fn(&TrajectoryReport) -> String| match (&self.final_report, &self.report) {
                (Some(adjusted), Some(live)) => {
                    lines.push((label, format!("{} (live {})", of(adjusted), of(live))));
                }
                (Some(only), None) | (None, Some(only)) => lines.push((label, of(only))),
                (None, None) => {}
            };
        both("ATE SE(3)", &|r| metres(r.ate_se3_m));
        both("ATE Sim(3)", &|r| metres(r.ate_sim3_m));
        both("|ln s|", &|r| r.scale_error.map_or("-".into(), |s| format!("{s:.4}")));
        for span in &tracked.lost {
            let at = vidar_core::Timestamp::from_nanos(span.from_ns);
            lines.push(("lost", format!("at {at} s: {}", span.reason)));
        }
        lines.push(("folder", self.folder.display().to_string()));
        lines
    }
}

/// What is known before tracking.
fn start_manifest(request: &OdometryRequest, dataset: &Dataset, started: String) -> Result<Manifest, Error> {
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
