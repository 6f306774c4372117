//! One world from what is known, each mode in its way.

use super::chain::chain;
use super::coupled::coupled;
use super::loops::MeasuredLoop;
use super::memory::Chunk;
use super::report::{
    ChunkPlacement, ChunkStatus, DriftReport, KeyframePlacement, RejectionCounts, RejectionReason,
    ViewPlacement,
};
use super::{Aligner, CouplingMode, GraphReport, LoopReport, NEIGHBOURS, Placement};
use nalgebra::Vector3;
use std::collections::BTreeMap;
use vidar_core::{FrameId, LieGroup, Se3, Sim3, umeyama_sim3};

/// Places of chunks and, where something other than their chunk decides, of keyframes.
pub(super) struct World {
    /// Per chunk; `None` leaves it out.
    pub chunks: Vec<Option<Sim3>>,
    /// Keyframes whose pose does not follow from their chunk's.
    pub keyframes: BTreeMap<FrameId, Se3>,
    /// Standard deviation of ln(scale) per chunk.
    pub log_scale_std: Vec<f64>,
    pub is_metric: bool,
    pub rejections: Vec<RejectionReason>,
    pub graph: Option<GraphReport>,
    pub loops: Vec<LoopReport>,
}

/// The world as it is known now.
pub(super) fn place(machine: &Aligner) -> Placement {
    let world = match machine.mode {
        CouplingMode::Da3Streaming | CouplingMode::PoseFree => pose_free(machine),
        CouplingMode::Hybrid => hybrid(machine),
        CouplingMode::PoseConditioned | CouplingMode::GroundTruth => conditioned(machine),
        CouplingMode::Coupled => coupled(machine),
    };
    assemble(machine, world)
}

/// The first chain; chunks of other chains share nothing with it.
pub(super) fn pose_free(machine: &Aligner) -> World {
    let judged = machine.evaluated_loops();
    let links = chain(&machine.chunks, &machine.loop_edges(&judged));
    let root = links.iter().flatten().map(|l| l.root).next();
    let chunks =
        links.iter().map(|l| l.filter(|l| Some(l.root) == root).map(|l| l.root_from_chunk)).collect();
    World { loops: reports(judged), ..World::of(machine, chunks, false) }
}

/// Each chain by one similarity of all its camera centres onto their anchors.
fn hybrid(machine: &Aligner) -> World {
    let judged = machine.evaluated_loops();
    let links = chain(&machine.chunks, &machine.loop_edges(&judged));
    let mut roots: Vec<usize> = links.iter().flatten().map(|l| l.root).collect();
    roots.sort_unstable();
    roots.dedup();
    let mut chunks: Vec<Option<Sim3>> = vec![None; links.len()];
    let mut rejections = Vec::new();
    let mut is_metric = true;
    let mut log_scale_std = vec![f64::INFINITY; links.len()];
    for root in &roots {
        let members = || (0..links.len()).filter_map(|k| Some((k, links[k].filter(|l| l.root == *root)?)));
        let mut centers: BTreeMap<FrameId, (Vector3<f64>, Vector3<f64>)> = BTreeMap::new();
        for (k, link) in members() {
            for view in &machine.chunks[k].views {
                if let Some(anchor) = machine.frames.pose_prior(view.frame_id) {
                    let placed = link.root_from_chunk.act(&view.chunk_from_camera.translation);
                    centers.insert(view.frame_id, (placed, anchor.world_from_camera.translation));
                }
            }
        }
        let (chained, anchored): (Vec<_>, Vec<_>) = centers.into_values().unzip();
        let onto = match umeyama_sim3(&chained, &anchored) {
            Ok(onto) => onto,
            Err(_) => {
                // The paper's guard: identity. A second chain that nothing places is left out.
                rejections.push(RejectionReason::RankDeficient);
                is_metric = false;
                if *root != roots[0] {
                    continue;
                }
                Sim3::IDENTITY
            }
        };
        let std = spread(&onto, &chained, &anchored);
        members().for_each(|(k, link)| {
            chunks[k] = Some(onto * link.root_from_chunk);
            log_scale_std[k] = std;
        });
    }
    World { rejections, log_scale_std, loops: reports(judged), ..World::of(machine, chunks, is_metric) }
}

/// Standard deviation of ln(scale) of a similarity over correlated centres: its residual over their radius.
fn spread(onto: &Sim3, chained: &[Vector3<f64>], anchored: &[Vector3<f64>]) -> f64 {
    let n = anchored.len().max(1) as f64;
    let mean = anchored.iter().sum::<Vector3<f64>>() / n;
    let radius: f64 = anchored.iter().map(|a| (a - mean).norm_squared()).sum();
    let residual: f64 = chained.iter().zip(anchored).map(|(c, a)| (onto.act(c) - a).norm_squared()).sum();
    (residual / radius).sqrt()
}

/// Each chunk where its anchors put it; poses are the anchors' own.
fn conditioned(machine: &Aligner) -> World {
    let chunks: Vec<Option<Sim3>> =
        machine.chunks.iter().map(|c| c.first_guess.filter(|_| c.is_usable())).collect();
    let mut world = World::of(machine, chunks, true);
    for frame in machine.frames.iter() {
        if let Some(anchor) = machine.frames.pose_prior(frame.frame_id) {
            world.keyframes.insert(frame.frame_id, anchor.world_from_camera);
        }
    }
    world
}

impl World {
    pub fn of(machine: &Aligner, chunks: Vec<Option<Sim3>>, is_metric: bool) -> Self {
        Self {
            chunks,
            keyframes: BTreeMap::new(),
            log_scale_std: machine.chunks.iter().map(|c| c.log_scale_std).collect(),
            is_metric,
            rejections: Vec::new(),
            graph: None,
            loops: reports(machine.evaluated_loops()),
        }
    }
}

/// What is told of loops.
pub(super) fn reports(loops: Vec<MeasuredLoop>) -> Vec<LoopReport> {
    loops.into_iter().map(|l| l.report).collect()
}

fn assemble(machine: &Aligner, world: World) -> Placement {
    let mut rejections = RejectionCounts::default();
    machine.chunks.iter().for_each(|c| rejections.extend(&c.rejections));
    rejections.extend(&world.rejections);
    world
        .loops
        .iter()
        .filter(|l| l.rejection.is_some())
        .for_each(|_| rejections.add(RejectionReason::LoopRejected));
    let chunks = machine.chunks.iter().zip(&world.chunks).zip(&world.log_scale_std);
    let chunks = chunks.map(|((c, place), std)| ChunkPlacement {
        chunk_id: c.id,
        status: if place.is_none() && c.is_usable() { ChunkStatus::Unplaced } else { c.status },
        world_from_chunk: place.unwrap_or(Sim3::IDENTITY),
        log_scale_std: if world.is_metric { *std } else { f64::INFINITY },
    });
    let mut views: BTreeMap<FrameId, ViewPlacement> = BTreeMap::new();
    let mut owners: BTreeMap<FrameId, usize> = BTreeMap::new();
    for (k, (chunk, place)) in machine.chunks.iter().zip(&world.chunks).enumerate() {
        let Some(place) = place else { continue };
        // The later of two neighbours takes over: it has seen what comes after. A frame that came back much later stays
        // where it was, and so does what was fused of it.
        for view in &chunk.views {
            let owner = owners.entry(view.frame_id).or_insert(k);
            if k - *owner >= NEIGHBOURS {
                continue;
            }
            *owner = k;
            let chained = place.transform_pose(&view.chunk_from_camera);
            let placed = ViewPlacement {
                frame_id: view.frame_id,
                owner: chunk.id,
                world_from_camera: world.keyframes.get(&view.frame_id).copied().unwrap_or(chained),
                metres_per_unit: place.scale,
                field: view.field.clone(),
            };
            views.insert(view.frame_id, placed);
        }
    }
    let mut keyframes: BTreeMap<FrameId, Se3> = world.keyframes.clone();
    views.values().for_each(|v| {
        keyframes.entry(v.frame_id).or_insert(v.world_from_camera);
    });
    Placement {
        mode: machine.mode,
        is_metric: world.is_metric,
        chunks: chunks.collect(),
        drift: drift(machine, &world),
        views: views.into_values().collect(),
        keyframes: keyframes
            .into_iter()
            .map(|(frame_id, world_from_camera)| KeyframePlacement { frame_id, world_from_camera })
            .collect(),
        loops: world.loops,
        rejections,
        graph: world.graph,
    }
}

/// Placed cameras against their anchors, and scale steps against overlaps.
fn drift(machine: &Aligner, world: &World) -> DriftReport {
    let mut report = DriftReport::default();
    let (mut squares, mut steps) = (0.0, Vec::new());
    for (k, (chunk, place)) in machine.chunks.iter().zip(&world.chunks).enumerate() {
        let Some(place) = place else { continue };
        for pair in chunk.pairs(&machine.frames) {
            let placed = place.act(&pair.chunk_from_camera.translation);
            let apart = (placed - pair.world_from_camera.translation).norm();
            squares += apart * apart;
            report.center_max_m = report.center_max_m.max(apart);
            report.matched += 1;
        }
        if let Some(step) = scale_step(chunk, world, k) {
            steps.push(step);
        }
    }
    report.center_rms_m = (squares / report.matched.max(1) as f64).sqrt();
    let n = steps.len().max(1) as f64;
    report.scale_step_std = (steps.iter().map(|s| s * s).sum::<f64>() / n).sqrt();
    report
}

/// ln of the scale step from the chunk it is tied to beyond what their overlap says.
fn scale_step(chunk: &Chunk, world: &World, k: usize) -> Option<f64> {
    let tie = chunk.tie.as_ref()?;
    let (before, now) = (world.chunks[tie.to]?, world.chunks[k]?);
    Some((now.scale / (before.scale * tie.fit.target_from_source.scale)).ln())
}
