//! What a coupling estimates, and the placement that is reported of it.

use super::chunk::Chunk;
use super::coupling::CouplingMode;
use super::history::{History, LoopMeasurement, NEIGHBOURS, reports};
use super::pose_fit::{CameraPair, center_rms};
use super::report::{
    ChunkPlacement, ChunkStatus, DriftReport, GraphFailure, GraphReport, KeyframePlacement, LoopReport,
    Placement, PoseCorrection, RejectionCounts, RejectionReason, ViewPlacement,
};
use nalgebra::Vector3;
use std::collections::BTreeMap;
use vidar_core::model::ChunkFrame;
use vidar_core::{FrameId, LieGroup, Se3, Sim3};
use vidar_solve::statistics::median_upper;

/// Gauges of chunks and, where something other than their chunk determines them, poses of keyframes.
#[derive(Clone, Debug)]
pub(super) struct Estimate {
    /// `world_from_chunk` per chunk; `None` leaves the chunk out.
    pub chunks: Vec<Option<Sim3>>,
    /// Keyframes whose pose does not follow from their chunk's.
    pub keyframes: BTreeMap<FrameId, Se3>,
    /// σ of ln(scale) per chunk.
    pub log_scale_std: Vec<f64>,
    pub is_metric: bool,
    pub rejections: Vec<RejectionReason>,
    pub graph: Option<GraphReport>,
    /// Graphs without a solution.
    pub failures: Vec<GraphFailure>,
    pub loops: Vec<LoopReport>,
}

impl Estimate {
    pub fn new(
        history: &History,
        chunks: Vec<Option<Sim3>>,
        loops: Vec<LoopMeasurement>,
        is_metric: bool,
    ) -> Self {
        Self {
            chunks,
            keyframes: BTreeMap::new(),
            log_scale_std: history.chunks.iter().map(|c| c.log_scale_std).collect(),
            is_metric,
            rejections: Vec::new(),
            graph: None,
            failures: Vec::new(),
            loops: reports(loops),
        }
    }

    /// The same with the chunks that came since, each where it began, moved as the last estimated chunk was.
    pub fn extended(&self, history: &History) -> Self {
        let moved = |(place, chunk): (&Option<Sim3>, &Chunk)| Some((*place)? * chunk.initial?.inverse());
        let correction = self.chunks.iter().zip(&history.chunks).rev().find_map(moved);
        let since = &history.chunks[self.chunks.len()..];
        let mut extended = self.clone();
        let place =
            |c: &Chunk| Some(correction.unwrap_or(Sim3::IDENTITY) * c.initial.filter(|_| c.is_usable())?);
        extended.chunks.extend(since.iter().map(place));
        extended.log_scale_std.extend(since.iter().map(|c| c.log_scale_std));
        extended
    }
}

/// The placement of an estimate.
pub(super) fn placement(mode: CouplingMode, history: &History, estimate: Estimate) -> Placement {
    let mut rejections = RejectionCounts::default();
    history.chunks.iter().for_each(|c| rejections.extend(&c.rejections));
    rejections.extend(&estimate.rejections);
    estimate.failures.iter().for_each(|_| rejections.add(RejectionReason::GraphFailed));
    estimate
        .loops
        .iter()
        .filter(|l| l.rejection.is_some())
        .for_each(|_| rejections.add(RejectionReason::LoopRejected));
    let chunks = history.chunks.iter().zip(&estimate.chunks).zip(&estimate.log_scale_std);
    let chunks = chunks.map(|((c, place), std)| ChunkPlacement {
        chunk_id: c.id,
        status: if place.is_none() && c.is_usable() { ChunkStatus::Unplaced } else { c.status },
        world_from_chunk: place.unwrap_or(Sim3::IDENTITY),
        log_scale_std: if estimate.is_metric { *std } else { f64::INFINITY },
    });
    let mut views: BTreeMap<FrameId, ViewPlacement> = BTreeMap::new();
    let mut owners: BTreeMap<FrameId, usize> = BTreeMap::new();
    for (k, (chunk, place)) in history.chunks.iter().zip(&estimate.chunks).enumerate() {
        let Some(place) = place else { continue };
        // The later of two neighbours owns a shared frame: its views extend to later frames. A frame that comes back in a
        // distant chunk keeps its owner, and so does the surface that was fused of it.
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
                world_from_camera: estimate.keyframes.get(&view.frame_id).copied().unwrap_or(chained),
                metres_per_unit: place.scale,
                field: view.field.clone(),
            };
            views.insert(view.frame_id, placed);
        }
    }
    let mut keyframes: BTreeMap<FrameId, Se3> = estimate.keyframes.clone();
    views.values().for_each(|v| {
        keyframes.entry(v.frame_id).or_insert(v.world_from_camera);
    });
    Placement {
        mode,
        is_metric: estimate.is_metric,
        chunks: chunks.collect(),
        drift: drift(history, &estimate),
        views: views.into_values().collect(),
        keyframes: keyframes
            .into_iter()
            .map(|(frame_id, world_from_camera)| KeyframePlacement { frame_id, world_from_camera })
            .collect(),
        loops: estimate.loops,
        rejections,
        graph: estimate.graph,
        graph_failures: estimate.failures,
    }
}

/// Placed cameras against their pose priors, and scale steps against overlaps.
fn drift(history: &History, estimate: &Estimate) -> DriftReport {
    let mut report = DriftReport::default();
    let (mut squares, mut steps) = (0.0, Vec::new());
    for (k, (chunk, place)) in history.chunks.iter().zip(&estimate.chunks).enumerate() {
        let Some(place) = place else { continue };
        for pair in chunk.pairs(&history.frames) {
            let placed = place.act(&pair.chunk_from_camera.translation);
            let apart = (placed - pair.world_from_camera.translation).norm();
            squares += apart * apart;
            report.center_max_m = report.center_max_m.max(apart);
            report.matched += 1;
        }
        if let Some(step) = scale_step(chunk, estimate, k) {
            steps.push(step);
        }
    }
    report.center_rms_m = (squares / report.matched.max(1) as f64).sqrt();
    let n = steps.len().max(1) as f64;
    report.scale_step_std = (steps.iter().map(|s| s * s).sum::<f64>() / n).sqrt();
    report.pose_correction = pose_correction(history);
    report
}

/// What the images changed of the poses of the chunks that were predicted in the world of those.
fn pose_correction(history: &History) -> Option<PoseCorrection> {
    let (mut centers, mut shares, mut rotations) = (Vec::new(), Vec::new(), Vec::new());
    for chunk in history.chunks.iter().filter(|c| c.is_usable() && c.frame == ChunkFrame::PriorWorld) {
        let pairs = chunk.pairs(&history.frames);
        let n = pairs.len() as f64;
        let mean = pairs.iter().map(|p| p.world_from_camera.translation).sum::<Vector3<f64>>() / n;
        let rms =
            |of: &dyn Fn(&CameraPair) -> f64| (pairs.iter().map(|p| of(p).powi(2)).sum::<f64>() / n).sqrt();
        let radius = rms(&|p| (p.world_from_camera.translation - mean).norm());
        let moved = center_rms(&chunk.now_from_then, &pairs);
        let given = |p: &CameraPair| chunk.now_from_then.rotation * p.chunk_from_camera.rotation;
        let turned = rms(&|p| (p.world_from_camera.rotation.inverse() * given(p)).angle_rad());
        if radius > 0.0 && moved.is_finite() {
            centers.push(moved);
            shares.push(moved / radius);
            rotations.push(turned);
        }
    }
    let center_share = median_upper(&mut shares)?;
    Some(PoseCorrection {
        center_rms_m: median_upper(&mut centers)?,
        rotation_rms_rad: median_upper(&mut rotations)?,
        center_share,
        log_scale_std: center_share / (shares.len() as f64).sqrt(),
    })
}

/// ln of the scale step from the chunk before over that of their overlap.
fn scale_step(chunk: &Chunk, estimate: &Estimate, k: usize) -> Option<f64> {
    let overlap = chunk.overlap.as_ref()?;
    let (before, now) = (estimate.chunks[overlap.earlier]?, estimate.chunks[k]?);
    Some((now.scale / (before.scale * overlap.fit.target_from_source.scale)).ln())
}
