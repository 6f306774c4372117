//! The paper's tables in one command: every sequence with every coupling, evaluated in the same way.
//!
//! ```text
//! sequences ─▶ odometry (camera + IMU, camera only) ─▶ Table I
//!          └─▶ run per coupling mode ─▶ evaluation against scan and truth ─▶ Tables II and III
//! ```
//!
//! A failed run is a row with its reason; it is counted and excluded from the means. Finished rows are stored: the same
//! command in the same folder continues where it stopped.

pub mod ablation;
mod figures;
mod orderings;
mod paper;
mod row;
mod sequences;
mod tables;

pub use row::{BenchRow, OdometryRow};
pub use sequences::Sequence;
pub use tables::Cells;

use crate::config::{Layered, Origin, PoseSource};
use crate::error::{Error, ExitStatus};
use crate::events::{CancelToken, Event, Events};
use crate::run_folder::pretty;
use serde::Serialize;
use std::path::{Path, PathBuf};
use vidar_align::CouplingMode;
use vidar_core::Trajectory;
use vidar_dataset::{OpenOptions, TrajectoryReadOptions};
use vidar_synth::{FlightKind, SceneKind, Simulation, SynthConfig};

/// Schema of `bench.json`.
pub const BENCH_SCHEMA: &str = "vidar.bench/1";

/// Which dataset.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum BenchKind {
    /// EuRoC MAV.
    Euroc,
    /// TUM RGB-D.
    Tum,
    /// TUM-VI.
    TumVi,
    /// 7-Scenes.
    #[serde(rename = "7scenes")]
    SevenScenes,
}

impl BenchKind {
    /// Whether its recordings have an IMU that odometry can use.
    fn has_imu(self) -> bool {
        matches!(self, Self::Euroc | Self::TumVi)
    }
}

/// What to run.
#[derive(Clone, Debug)]
pub struct BenchRequest {
    /// Which dataset.
    pub kind: BenchKind,
    /// The folder with its sequences. With `synthetic`, only its ground truth is used: rendered rooms are flown through along it.
    pub root: Option<PathBuf>,
    /// Render the sequences instead of reading their images.
    pub synthetic: Option<SyntheticBench>,
    /// Prefixes of the names of sequences to run; empty = all.
    pub sequences: Vec<String>,
    /// Couplings to compare.
    pub modes: Vec<CouplingMode>,
    /// Whether the odometry alone is evaluated, too (Table I).
    pub trajectories: bool,
    /// Settings of all runs; `coupling.mode` is set per run.
    pub layered: Layered,
    /// Where everything goes.
    pub out: PathBuf,
    /// The command as typed.
    pub command: Vec<String>,
}

/// How sequences are rendered.
#[derive(Clone, Debug)]
pub struct SyntheticBench {
    /// The world; its scene and flight are set per sequence.
    pub world: SynthConfig,
}

/// Everything that was measured.
#[derive(Debug)]
pub struct BenchOutcome {
    /// The folder.
    pub folder: PathBuf,
    /// Sequences in order.
    pub sequences: Vec<String>,
    /// One row per sequence and coupling.
    pub rows: Vec<BenchRow>,
    /// One row per sequence and kind of odometry.
    pub odometry: Vec<OdometryRow>,
    /// The tables as Markdown.
    pub markdown: String,
    /// Done, or degraded when a run failed.
    pub status: ExitStatus,
}

/// Runs everything that is not there yet, and writes tables, figures and report.
pub fn bench(request: &BenchRequest, events: &Events, cancel: &CancelToken) -> Result<BenchOutcome, Error> {
    let sequences = sequences_of(request, events, cancel)?;
    let (mut rows, mut odometry) = (Vec::new(), Vec::new());
    let total = sequences.len() * request.modes.len();
    events.stage("bench", total, || -> Result<(), Error> {
        for sequence in &sequences {
            if request.trajectories && request.kind.has_imu() {
                for with_imu in [true, false] {
                    interrupted(request, cancel)?;
                    odometry.push(row::odometry_row(request, sequence, with_imu, cancel)?);
                }
            }
            for mode in &request.modes {
                interrupted(request, cancel)?;
                rows.push(row::run_row(request, sequence, *mode, cancel)?);
                events.emit(&Event::Progress { stage: "bench", done: rows.len(), total });
            }
        }
        Ok(())
    })?;
    interrupted(request, cancel)?;
    let failed = rows.iter().any(|r| r.failure.is_some()) || odometry.iter().any(|r| r.failure.is_some());
    let names: Vec<String> = sequences.iter().map(|s| s.name.clone()).collect();
    let cells = Cells::new(request, &names, &rows, &odometry);
    let outcome = BenchOutcome {
        folder: request.out.clone(),
        markdown: cells.markdown(),
        sequences: names,
        rows,
        odometry,
        status: if failed { ExitStatus::Degraded } else { ExitStatus::Done },
    };
    write(request, &outcome, &cells)?;
    Ok(outcome)
}

fn interrupted(request: &BenchRequest, cancel: &CancelToken) -> Result<(), Error> {
    match cancel.is_cancelled() {
        true => Err(Error::Interrupted { path: request.out.clone() }),
        false => Ok(()),
    }
}

fn write(request: &BenchRequest, outcome: &BenchOutcome, cells: &Cells) -> Result<(), Error> {
    let put = |name: &str, bytes: &[u8]| -> Result<(), Error> {
        Ok(vidar_export::atomic::write_file_atomically(&request.out.join(name), bytes)?)
    };
    let json = serde_json::json!({
        "schema": BENCH_SCHEMA, "kind": request.kind, "synthetic": request.synthetic.is_some(),
        "command": request.command, "sequences": outcome.sequences, "runs": outcome.rows,
        "odometry": outcome.odometry,
    });
    put("bench.json", &pretty(&json)?)?;
    put("tables.md", outcome.markdown.as_bytes())?;
    put("report.html", figures::report(request, outcome, cells)?.as_bytes())
}

/// The sequences below the root, or rendered ones.
fn sequences_of(
    request: &BenchRequest,
    events: &Events,
    cancel: &CancelToken,
) -> Result<Vec<Sequence>, Error> {
    let real = |root: &Path| sequences::find(root, request.kind, &request.sequences);
    std::fs::create_dir_all(&request.out).map_err(|e| Error::io("create", &request.out, e))?;
    let Some(synthetic) = &request.synthetic else {
        let root = request.root.as_ref().ok_or_else(|| Error::Usage {
            what: "no folder of sequences was given".into(),
            hint: "name the folder where the dataset was unpacked, or add --synthetic".into(),
        })?;
        return real(root);
    };
    let flights: Vec<(String, Option<Trajectory>, SynthConfig)> = match &request.root {
        Some(root) => real(root)?
            .into_iter()
            .map(|s| {
                let flight = truth_of(&s.path)?;
                let (scene, seed) = (scene_of(&s.name), seed_of(&s.name, synthetic.world.seed));
                Ok((s.name, Some(flight), SynthConfig { scene, seed, ..synthetic.world.clone() }))
            })
            .collect::<Result<_, Error>>()?,
        None => built_in(&synthetic.world, &request.sequences)?,
    };
    let mut rendered = Vec::new();
    for (name, flight, world) in flights {
        let path = request.out.join("sequences").join(&name);
        // The file written last shows that a rendered sequence is complete; another world is rendered again.
        let is_whole = path.join("mav0").exists();
        let is_same = || Simulation::open(&path).is_ok_and(|s| *s.config() == world);
        if !(is_whole && is_same()) {
            if path.exists() {
                std::fs::remove_dir_all(&path).map_err(|e| Error::io("remove", &path, e))?;
            }
            crate::demo::synthesise(&path, &world, flight.as_ref(), events, cancel)?;
        }
        rendered.push(Sequence { name, path });
    }
    Ok(rendered)
}

/// The machine hall of EuRoC is a hall, its Vicon room a room.
fn scene_of(name: &str) -> SceneKind {
    if name.starts_with("MH") { SceneKind::Hall } else { SceneKind::Room }
}

/// Every sequence has its own room, noise and simulated network, which depend on its name only.
fn seed_of(name: &str, base: u64) -> u64 {
    name.bytes().fold(base, |seed, b| seed.wrapping_mul(31).wrapping_add(u64::from(b))) & (u64::MAX >> 1)
}

/// Ground truth of a EuRoC sequence, without reading its images.
fn truth_of(sequence: &Path) -> Result<Trajectory, Error> {
    let file = sequence.join("mav0/state_groundtruth_estimate0/data.csv");
    Ok(vidar_dataset::read_trajectory(&file, &TrajectoryReadOptions::default())?.0)
}

/// Flights that need no dataset: three kinds in two rooms each, named after their rooms.
fn built_in(
    world: &SynthConfig,
    prefixes: &[String],
) -> Result<Vec<(String, Option<Trajectory>, SynthConfig)>, Error> {
    let flights = [FlightKind::Sweep, FlightKind::Orbit, FlightKind::Aggressive];
    let all: Vec<_> = (1..=2_u64)
        .flat_map(|room| {
            flights.iter().enumerate().map(move |(k, flight)| {
                let seed = world.seed.wrapping_mul(100).wrapping_add(room * 10 + k as u64);
                let world = SynthConfig { seed, flight: *flight, ..world.clone() };
                (format!("room{room}_{}", k + 1), None, world)
            })
        })
        .collect();
    let names: Vec<String> = all.iter().map(|(name, ..)| name.clone()).collect();
    sequences::require_matches(&names, prefixes)?;
    let is_wanted = |name: &str| prefixes.is_empty() || prefixes.iter().any(|w| name.starts_with(w.as_str()));
    Ok(all.into_iter().filter(|(name, ..)| is_wanted(name)).collect())
}

/// The settings of one run.
fn layered_for(request: &BenchRequest, mode: CouplingMode) -> Result<Layered, Error> {
    let mut layered = request.layered.clone();
    layered.value("coupling.mode", toml::Value::String(mode.to_string()), Origin::Flag("bench"))?;
    // A run falls back to ground truth if the odometry fails; in a table that would be a wrong row.
    let is_open = layered.build()?.input.poses == PoseSource::Auto;
    if is_open && request.kind == BenchKind::Euroc && mode != CouplingMode::GroundTruth {
        layered.value("input.poses", toml::Value::String("odometry".into()), Origin::Flag("bench"))?;
    }
    Ok(layered)
}

/// How sequences are opened.
fn open_options() -> OpenOptions {
    OpenOptions::default()
}
