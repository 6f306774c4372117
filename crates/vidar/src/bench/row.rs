//! One run as one row, stored so that it is not repeated.

use super::{BenchRequest, Sequence, layered_for, open_options};
use crate::error::{Error, ExitStatus};
use crate::events::{CancelToken, Events};
use crate::input::{open_dataset, truth_in_camera};
use crate::odometry::{OdometryRequest, odometry};
use crate::run::{RunOutcome, RunRequest, run};
use crate::run_folder::{OutputLocation, pretty};
use crate::{config::Origin, system};
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};
use vidar_align::CouplingMode;
use vidar_eval::{Scores, TrajectoryReport};
use vidar_solve::statistics::median_upper;

/// One sequence under one coupling.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct BenchRow {
    /// Which sequence.
    pub sequence: String,
    /// Which coupling.
    pub mode: CouplingMode,
    /// Why there is no result.
    pub failure: Option<String>,
    /// Whether part of the input is missing in the result.
    pub degraded: bool,
    /// The keyframes as placed in the map.
    pub trajectory: TrajectoryScores,
    /// F@0.05 of the rigid fit: scale as it is.
    pub f05_rigid: Option<f64>,
    /// F@0.10 of the rigid fit.
    pub f10_rigid: Option<f64>,
    /// F@0.05 of the paper's bounded placement.
    pub f05: Option<f64>,
    /// F@0.10 of the same.
    pub f10: Option<f64>,
    /// F@0.10 with the scale of ground truth.
    pub f10_free: Option<f64>,
    /// Mean relative error of depth against a depth sensor.
    pub abs_rel: Option<f64>,
    /// Keyframes with depth.
    pub keyframes: usize,
    /// Wall time, s.
    pub seconds: f64,
    /// Largest resident memory of the run, bytes, if the system reports it.
    pub peak_memory_bytes: Option<u64>,
    /// The most memory of a graphics processor held at a time, bytes; `None` where none was used.
    #[serde(default)]
    pub device_peak_bytes: Option<u64>,
    /// Rejections, and loops accepted of those evaluated.
    pub placement: serde_json::Value,
    /// The run folder, relative to the bench's.
    pub folder: PathBuf,
}

/// One sequence under the odometry alone.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct OdometryRow {
    /// Which sequence.
    pub sequence: String,
    /// Whether the IMU was used.
    pub with_imu: bool,
    /// Why there is no result.
    pub failure: Option<String>,
    /// Whether a span of it was lost.
    pub degraded: bool,
    /// Its poses.
    pub trajectory: TrajectoryScores,
    /// Milliseconds per image, median.
    pub milliseconds: Option<f64>,
    /// The run folder, relative to the bench's.
    pub folder: PathBuf,
}

/// A trajectory against ground truth.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TrajectoryScores {
    /// RMSE after a similarity, m.
    pub ate_sim3_m: Option<f64>,
    /// RMSE after a rigid motion, m.
    pub ate_se3_m: Option<f64>,
    /// ln of the Umeyama scale to ground truth.
    pub log_scale: Option<f64>,
    /// Share of ground truth's time that is covered.
    pub coverage: Option<f64>,
}

impl From<&TrajectoryReport> for TrajectoryScores {
    fn from(report: &TrajectoryReport) -> Self {
        Self {
            ate_sim3_m: report.ate_sim3_m.as_ref().map(|s| s.rmse),
            ate_se3_m: report.ate_se3_m.as_ref().map(|s| s.rmse),
            log_scale: report.scale.map(f64::ln).filter(|s| s.is_finite()),
            coverage: Some(report.coverage.truth_time_ratio),
        }
    }
}

/// Runs one coupling on one sequence, or reads the stored row.
pub(super) fn run_row(
    request: &BenchRequest,
    sequence: &Sequence,
    mode: CouplingMode,
    cancel: &CancelToken,
) -> Result<BenchRow, Error> {
    let folder = PathBuf::from("runs").join(&sequence.name).join(mode.name());
    let layered = layered_for(request, mode)?;
    let key = key(sequence, &layered.to_toml(false))?;
    let place = request.out.join(&folder);
    if let Some(row) = stored(&place, &key)? {
        return Ok(row);
    }
    system::reset_peak_memory();
    let run_request = RunRequest {
        path: sequence.path.clone(),
        open: open_options(),
        layered,
        reference: None,
        place: OutputLocation::Replaced { path: place.clone() },
        mcap: None,
        command: request.command.clone(),
    };
    let clock = std::time::Instant::now();
    let mut row = BenchRow { sequence: sequence.name.clone(), mode, folder, ..BenchRow::default() };
    match run(&run_request, &Events::none(), cancel) {
        Err(error) if affects_all_runs(&error) => return Err(error),
        Err(error) => row.failure = Some(format!("{} {error}", error.code())),
        Ok(outcome) if outcome.status == ExitStatus::Interrupted => {
            return Err(Error::Interrupted { path: request.out.clone() });
        }
        Ok(outcome) => {
            let evaluation = &outcome.evaluation;
            let f = |scores: &[Scores], at: f64| {
                scores.iter().find(|s| (s.threshold_m - at).abs() < 1e-9).map(|s| s.f)
            };
            row.degraded = outcome.status == ExitStatus::Degraded;
            row.trajectory = keyframes_against_truth(&run_request, &outcome)?;
            row.device_peak_bytes = outcome.device_peak_bytes;
            if let Some(surface) = &evaluation.surface {
                (row.f05, row.f10) = (f(&surface.native, 0.05), f(&surface.native, 0.10));
                (row.f05_rigid, row.f10_rigid) = (f(&surface.rigid, 0.05), f(&surface.rigid, 0.10));
                row.f10_free = f(&surface.free, 0.10);
            }
            row.abs_rel =
                evaluation.depth.as_ref().and_then(|d| d.summary.pixel_weighted.metric).map(|m| m.abs_rel);
            row.keyframes = outcome.map.views.len();
            row.placement = outcome.result_json()["placement"].clone();
        }
    }
    row.seconds = clock.elapsed().as_secs_f64();
    row.peak_memory_bytes = system::peak_memory_bytes();
    store(&place, &key, &row)?;
    Ok(row)
}

/// The map's keyframes against ground truth, for every coupling alike: where poses are given, they are measured, too.
fn keyframes_against_truth(request: &RunRequest, outcome: &RunOutcome) -> Result<TrajectoryScores, Error> {
    let config = request.layered.build()?;
    let dataset = open_dataset(&request.path, &request.open, &config)?;
    // Where it cannot be compared, the run has said so.
    let truth = truth_in_camera(&dataset).ok().flatten();
    let (Some(estimate), Some(truth)) = (outcome.map.keyframe_trajectory(), truth) else {
        return Ok(TrajectoryScores::default());
    };
    let report = vidar_eval::evaluate_trajectory(&estimate, &truth, &config.eval.trajectory);
    Ok(report.as_ref().map_or_else(|_| TrajectoryScores::default(), Into::into))
}

/// Runs the odometry alone on one sequence, or reads the stored row.
pub(super) fn odometry_row(
    request: &BenchRequest,
    sequence: &Sequence,
    with_imu: bool,
    cancel: &CancelToken,
) -> Result<OdometryRow, Error> {
    let name = if with_imu { "odometry" } else { "odometry-mono" };
    let folder = PathBuf::from("runs").join(&sequence.name).join(name);
    let mut layered = request.layered.clone();
    if !with_imu {
        layered.value("odometry.imu", toml::Value::String("off".into()), Origin::Flag("bench"))?;
    }
    let key = key(sequence, &format!("{name}\n{}", layered.to_toml(false)))?;
    let place = request.out.join(&folder);
    if let Some(row) = stored(&place, &key)? {
        return Ok(row);
    }
    let odometry_request = OdometryRequest {
        path: sequence.path.clone(),
        open: open_options(),
        layered,
        place: OutputLocation::Replaced { path: place.clone() },
        command: request.command.clone(),
        debug_dump: false,
    };
    let mut row = OdometryRow { sequence: sequence.name.clone(), with_imu, folder, ..OdometryRow::default() };
    match odometry(&odometry_request, &Events::none(), cancel) {
        Err(error) if affects_all_runs(&error) => return Err(error),
        Err(error) => row.failure = Some(format!("{} {error}", error.code())),
        Ok(outcome) if outcome.status == ExitStatus::Interrupted => {
            return Err(Error::Interrupted { path: request.out.clone() });
        }
        Ok(outcome) => {
            row.degraded = outcome.status == ExitStatus::Degraded;
            row.trajectory = outcome.report.as_ref().map_or_else(Default::default, Into::into);
            let mut times: Vec<f64> = outcome.tracked.frames.iter().map(|f| 1e3 * f.seconds).collect();
            row.milliseconds = median_upper(&mut times);
            if outcome.trajectory.is_none() {
                row.failure =
                    Some(outcome.tracked.why_not_started().unwrap_or_else(|| "no trajectory".into()));
            }
        }
    }
    store(&place, &key, &row)?;
    Ok(row)
}

/// Errors that would occur in every other run, too: a wrong setting, a full disk, a missing model, Ctrl-C.
pub(super) fn affects_all_runs(error: &Error) -> bool {
    matches!(error.exit_status(), ExitStatus::Usage | ExitStatus::ResourceMissing | ExitStatus::Interrupted)
}

/// Hash of the inputs of a row.
pub(super) fn key(sequence: &Sequence, settings: &str) -> Result<String, Error> {
    let mut hash = Sha256::new();
    // A rendered sequence has a file with its world; a recorded one has not.
    let world = std::fs::read_to_string(sequence.path.join("synth.toml")).unwrap_or_default();
    for part in [crate::VERSION, ROW_SCHEMA, &sequence.path.display().to_string(), settings, &world] {
        hash.update(part.as_bytes());
        hash.update([0]);
    }
    Ok(vidar_hub::hex(&hash.finalize()))
}

/// Changes when a row says more, so that rows from before are computed again.
const ROW_SCHEMA: &str = "vidar.bench-row/2";

#[derive(Serialize, Deserialize)]
struct StoredRow<T> {
    key: String,
    row: T,
}

pub(super) fn stored<T: DeserializeOwned>(place: &Path, key: &str) -> Result<Option<T>, Error> {
    let path = place.join("row.json");
    let bytes = match std::fs::read(&path) {
        Ok(bytes) => bytes,
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        Err(e) => return Err(Error::io("read", &path, e)),
    };
    // A row of another version is computed again.
    let stored: Option<StoredRow<T>> = serde_json::from_slice(&bytes).ok();
    Ok(stored.filter(|k| k.key == key).map(|k| k.row))
}

pub(super) fn store<T: Serialize>(place: &Path, key: &str, row: &T) -> Result<(), Error> {
    std::fs::create_dir_all(place).map_err(|e| Error::io("create", place, e))?;
    let stored = StoredRow { key: key.to_owned(), row };
    Ok(vidar_export::atomic::write_file_atomically(&place.join("row.json"), &pretty(&stored)?)?)
}
