//! What each measurement brings to each coupling: an ablation in which nothing else differs.
//!
//! ```text
//! recording ─▶ odometry, keyframes ─▶ predictions without and with poses ─▶ landmarks, stereo points, descriptors
//!                                              │
//!                     every coupling × {nothing, + landmarks, + stereo points, + loops, all} ─▶ fuse ─▶ evaluate
//! ```
//!
//! The front half runs once per recording and kind of prediction, so that all couplings get the same keyframes, predictions
//! and measurements. Each case pushes them through the product's own aligner and fuses what it places. Poses are the map's
//! keyframes after an SE(3) fit to the truth; the surface is compared with the scan at that fit, the scale as it is.

mod observe;
mod tables;

use super::{BenchRequest, Sequence, row, sequences_of};
use crate::engine::placed::placed_views;
use crate::error::{Error, ExitStatus};
use crate::events::{CancelToken, Events};
use crate::input::{open_every_image, truth_in_camera};
use crate::run::{reference, sampled};
use crate::run_folder::pretty;
use crate::{Config, config::Origin};
use nalgebra::Vector3;
use observe::Observed;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;
use vidar_align::{Aligner, ChunkObservation, CouplingMode, FrameObservation, Placement};
use vidar_core::{BodyFrame, LieGroup, StampedPose, Trajectory};
use vidar_eval::NearestIndex;
use vidar_fusion::TsdfVolume;

/// Schema of `ablation.json`.
pub const ABLATION_SCHEMA: &str = "vidar.ablation/1";

/// Whether the network was given the odometry's poses.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PredictionKind {
    /// Each chunk in a frame and unit of its own.
    #[default]
    PoseFree,
    /// Each chunk in the world of the odometry.
    PoseConditioned,
}

impl PredictionKind {
    const ALL: [Self; 2] = [Self::PoseFree, Self::PoseConditioned];

    /// Couplings of such predictions: the paper's, and the graph on the same predictions.
    fn couplings(self) -> &'static [CouplingMode] {
        match self {
            Self::PoseFree => &[CouplingMode::PoseFree, CouplingMode::Hybrid, CouplingMode::Coupled],
            Self::PoseConditioned => &[CouplingMode::PoseConditioned, CouplingMode::Coupled],
        }
    }

    /// A coupling of the program that asks for such predictions.
    fn asked_by(self) -> CouplingMode {
        match self {
            Self::PoseFree => CouplingMode::Hybrid,
            Self::PoseConditioned => CouplingMode::PoseConditioned,
        }
    }
}

/// Which measurements a case may use besides predictions, overlaps and the odometry's poses.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Measurements {
    /// Landmarks of the odometry: scale of chunks and depth fields.
    pub landmarks: bool,
    /// The surest points of stereo, used in the same way.
    pub stereo: bool,
    /// Loops, measured on what is stored of the two chunks.
    pub loops: bool,
}

impl Measurements {
    /// The columns of the tables.
    const COLUMNS: [(&'static str, Self); 5] = [
        ("nothing", Self { landmarks: false, stereo: false, loops: false }),
        ("+ landmarks", Self { landmarks: true, stereo: false, loops: false }),
        ("+ stereo points", Self { landmarks: false, stereo: true, loops: false }),
        ("+ loops", Self { landmarks: false, stereo: false, loops: true }),
        ("all", Self { landmarks: true, stereo: true, loops: true }),
    ];

    /// Of a frame's measurements those that take part.
    fn of(self, frame: &FrameObservation) -> FrameObservation {
        let mut kept = frame.clone();
        if !self.landmarks {
            kept.landmarks.clear();
        }
        if !self.stereo {
            kept.points.clear();
        }
        kept
    }
}

/// One case on one recording.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct AblationRow {
    /// Which flight.
    pub sequence: String,
    /// Which seed of room, noise and simulated network.
    pub seed: u64,
    /// Kind of the predictions.
    pub prediction: PredictionKind,
    /// Which coupling.
    pub coupling: CouplingMode,
    /// Which measurements.
    pub measurements: Measurements,
    /// Keyframes that were placed.
    pub keyframes: usize,
    /// Keyframes that were offered.
    pub offered: usize,
    /// Loops accepted.
    pub loops: usize,
    /// RMSE of the placed keyframes after a rigid motion, m.
    pub ate_se3_m: Option<f64>,
    /// ln of the scale of the placed keyframes to ground truth.
    pub log_scale: Option<f64>,
    /// F@0.05 at that rigid motion.
    pub f05: Option<f64>,
    /// F@0.10 at that rigid motion.
    pub f10: Option<f64>,
}

/// All cases of one recording.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
struct FlightResult {
    rows: Vec<AblationRow>,
    failure: Option<String>,
}

/// What an ablation measured.
#[derive(Debug)]
pub struct AblationOutcome {
    /// The folder with `ablation.json` and `ablation.md`.
    pub folder: PathBuf,
    /// Every case.
    pub rows: Vec<AblationRow>,
    /// The tables as Markdown.
    pub markdown: String,
    /// Done, or degraded when a recording could not be mapped.
    pub status: ExitStatus,
}

/// Runs every case on rendered flights with `seeds` seeds each. Finished recordings are stored and not repeated.
///
/// # Errors
/// Settings, models or files that cannot be used; Ctrl-C.
pub fn ablation(
    request: &BenchRequest,
    seeds: u64,
    events: &Events,
    cancel: &CancelToken,
) -> Result<AblationOutcome, Error> {
    let Some(synthetic) = &request.synthetic else {
        return Err(Error::Usage {
            what: "an ablation needs rendered flights".into(),
            hint: "add --synthetic: scale and surface are compared with the exact truth".into(),
        });
    };
    let (mut rows, mut failures) = (Vec::new(), Vec::new());
    for seed in 0..seeds {
        let mut world = synthetic.clone();
        world.world.seed = world.world.seed.wrapping_add(seed) & (u64::MAX >> 1);
        let of_seed = BenchRequest {
            synthetic: Some(world),
            out: request.out.join(format!("seed{seed}")),
            ..request.clone()
        };
        for sequence in sequences_of(&of_seed, events, cancel)? {
            super::interrupted(request, cancel)?;
            let recording = events.stage("bench", 0, || recording(&of_seed, &sequence, seed, cancel))?;
            failures.extend(recording.failure.map(|why| (sequence.name.clone(), seed, why)));
            rows.extend(recording.rows);
        }
    }
    let source = request.layered.build()?.geometry.source;
    let markdown = tables::markdown(&source, &rows, &failures);
    let put = |name: &str, bytes: &[u8]| -> Result<(), Error> {
        Ok(vidar_export::atomic::write_file_atomically(&request.out.join(name), bytes)?)
    };
    let json = serde_json::json!({
        "schema": ABLATION_SCHEMA, "command": request.command, "geometry": source, "rows": rows,
        "failures": failures,
    });
    put("ablation.json", &pretty(&json)?)?;
    put("ablation.md", markdown.as_bytes())?;
    let status = if failures.is_empty() { ExitStatus::Done } else { ExitStatus::Degraded };
    Ok(AblationOutcome { folder: request.out.clone(), rows, markdown, status })
}

/// All cases of a recording, or those that are stored of it.
fn recording(
    request: &BenchRequest,
    sequence: &Sequence,
    seed: u64,
    cancel: &CancelToken,
) -> Result<FlightResult, Error> {
    let config = request.layered.build()?;
    let key = row::key(sequence, &format!("ablation\n{}", request.layered.to_toml(false)))?;
    let place = request.out.join("ablation").join(&config.geometry.source).join(&sequence.name);
    if let Some(stored) = row::stored(&place, &key)? {
        return Ok(stored);
    }
    let mut recording = FlightResult::default();
    for kind in PredictionKind::ALL {
        match cases(request, sequence, kind, cancel) {
            Ok(rows) => recording.rows.extend(rows),
            Err(error) if row::affects_all_runs(&error) => return Err(error),
            Err(error) => recording.failure = Some(format!("{} {error}", error.code())),
        }
        super::interrupted(request, cancel)?;
    }
    for row in &mut recording.rows {
        (row.sequence, row.seed) = (sequence.name.clone(), seed);
    }
    row::store(&place, &key, &recording)?;
    Ok(recording)
}

/// All cases on one kind of prediction.
fn cases(
    request: &BenchRequest,
    sequence: &Sequence,
    kind: PredictionKind,
    cancel: &CancelToken,
) -> Result<Vec<AblationRow>, Error> {
    let mut layered = request.layered.clone();
    let text = |value: &str| toml::Value::String(value.into());
    layered.value("coupling.mode", text(kind.asked_by().name()), Origin::Flag("bench"))?;
    layered.value("coupling.landmarks", text("both"), Origin::Flag("bench"))?;
    if layered.build()?.input.poses == crate::config::PoseSource::Auto {
        layered.value("input.poses", text("odometry"), Origin::Flag("bench"))?;
    }
    let config = layered.build()?;
    let dataset = open_every_image(&sequence.path, &super::open_options(), &config)?;
    let observed = observe::observe(&dataset, &config, cancel)?;
    let truth = Truth {
        trajectory: truth_in_camera(&dataset)?,
        scan: reference::cloud(&observed.plan.reference, &dataset, &config, &Events::none())?
            .map(|cloud| {
                Ok::<_, Error>(Scan {
                    index: NearestIndex::build(&cloud.positions)?,
                    points: cloud.positions,
                })
            })
            .transpose()?,
    };
    let mut rows = Vec::new();
    for &coupling in kind.couplings() {
        for (_, measurements) in Measurements::COLUMNS {
            // Where chunks are not connected to each other, a loop has nothing to close.
            if measurements.loops && !coupling.chains() && !measurements.landmarks {
                continue;
            }
            super::interrupted(request, cancel)?;
            let placement = place(&observed, coupling, measurements, &config)?;
            let row = AblationRow { prediction: kind, coupling, measurements, ..AblationRow::default() };
            rows.push(evaluate(row, &observed, &placement, &truth, &config)?);
        }
    }
    Ok(rows)
}

/// The product's aligner on what was observed.
fn place(
    observed: &Observed,
    coupling: CouplingMode,
    measurements: Measurements,
    config: &Config,
) -> Result<Placement, Error> {
    let mut aligner = Aligner::new(coupling, &config.align)?;
    if observed.is_whitened {
        aligner = aligner.with_whitened_descriptors();
    }
    for (stored, frames) in &observed.chunks {
        let frames = frames.iter().map(|f| measurements.of(f)).collect();
        aligner.push(ChunkObservation { prediction: stored.prediction.clone(), frames })?;
        if measurements.loops {
            for candidate in aligner.loop_candidates() {
                aligner.push_loop(&candidate, None)?;
            }
        }
    }
    Ok(aligner.finish())
}

/// What a case is compared with.
struct Truth {
    trajectory: Option<Trajectory>,
    scan: Option<Scan>,
}

/// The reference's points.
struct Scan {
    points: Vec<[f32; 3]>,
    index: NearestIndex,
}

/// Keyframes against the truth, then the fused surface against the scan at the same rigid motion.
fn evaluate(
    mut row: AblationRow,
    observed: &Observed,
    placement: &Placement,
    truth: &Truth,
    config: &Config,
) -> Result<AblationRow, Error> {
    row.offered = observed.keyframes.len();
    row.keyframes = placement.views.len();
    row.loops = placement.loops.iter().filter(|l| l.rejection.is_none()).count();
    let times = &observed.keyframes;
    let posed = placement.views.iter().filter_map(|v| {
        let time = *times.get(&v.frame_id)?;
        Some(StampedPose { time, world_from_body: v.world_from_camera })
    });
    let body = BodyFrame::Camera(observed.plan.camera_id);
    let (Ok(trajectory), Some(exact)) = (Trajectory::new(body, posed.collect()), &truth.trajectory) else {
        return Ok(row);
    };
    let report = match vidar_eval::evaluate_trajectory(&trajectory, exact, &config.eval.trajectory) {
        Ok(report) => report,
        Err(_) => return Ok(row), // too few placed keyframes: the row says how many
    };
    row.ate_se3_m = report.ate_se3_m.as_ref().map(|s| s.rmse);
    row.log_scale = report.scale.map(f64::ln).filter(|s| s.is_finite());
    let Some(scan) = &truth.scan else { return Ok(row) };
    let mut volume = TsdfVolume::new(&config.fusion)?;
    for (stored, _) in &observed.chunks {
        for view in placed_views(placement, stored.clone())? {
            volume.integrate(&view)?;
        }
    }
    let points = sampled(&volume.extract_mesh(), config)?;
    let Some(truth_from_map) = report.truth_from_estimate_se3.and_then(|t| t.to_se3()) else {
        return Ok(row);
    };
    let moved = |p: &[f32; 3]| {
        let q = truth_from_map.act(&Vector3::from(p.map(f64::from)));
        [q.x as f32, q.y as f32, q.z as f32]
    };
    let points: Vec<[f32; 3]> = points.positions.iter().map(moved).collect();
    (row.f05, row.f10) = f_scores(&points, scan)?;
    Ok(row)
}

/// Points of each side that are looked up on the other: F is then known to half a hundredth, in a tenth of the time.
const QUERIES: usize = 20_000;

/// F@0.05 and F@0.10; 0 for a map without surface.
fn f_scores(points: &[[f32; 3]], scan: &Scan) -> Result<(Option<f64>, Option<f64>), Error> {
    if points.is_empty() {
        return Ok((Some(0.0), Some(0.0)));
    }
    let index = NearestIndex::build(points)?;
    let distances = |from: &[[f32; 3]], to: &NearestIndex| -> Vec<f64> {
        let queries: Vec<[f32; 3]> = from.iter().step_by(from.len().div_ceil(QUERIES)).copied().collect();
        let found = to.nearest_all(&queries, Some(0.11));
        found.into_iter().map(|n| n.map_or(f64::INFINITY, |n| n.distance_m)).collect()
    };
    let (accuracy, completeness) = (distances(points, &scan.index), distances(&scan.points, &index));
    let f = |limit: f64| {
        let share = |of: &[f64]| of.iter().filter(|d| **d < limit).count() as f64 / of.len().max(1) as f64;
        let (precision, recall) = (share(&accuracy), share(&completeness));
        Some(2.0 * precision * recall / (precision + recall).max(f64::MIN_POSITIVE))
    };
    Ok((f(0.05), f(0.10)))
}
