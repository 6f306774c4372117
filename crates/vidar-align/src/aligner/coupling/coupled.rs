//! Coupled: keyframes and chunk gauges from odometry, gravity, overlaps, landmarks and loops in one graph.
//!
//! Factors are those of [`crate::coupled`]: odometry between consecutive frames with pose priors, gravity, attachment of each
//! view to its chunk (σ widened by √n: a model's poses of one chunk share their deformation), overlaps with their
//! covariance, loops in a bounded kernel, scales from landmarks, and for chunks whose scale is not observable a random walk
//! from their neighbour. Odometry that contradicts chunks which agree with each other is down-weighted there.

mod factors;

use super::super::chunk::Chunk;
use super::super::estimate::Estimate;
use super::super::history::{History, reject, reports};
use super::super::pose_fit::{CameraPair, PoseFit, with_landmark_scale};
use super::super::report::{ChunkStatus, GraphFailure, GraphReport, LoopRejection, RejectionReason};
use super::pose_free::first_chain;
use super::{Coupling, initialise_by_overlap};
use crate::coupled::{CoupledConfig, CoupledState, Factor, InformationFlow, Solution, solve};
use factors::GraphBuilder;
use std::collections::BTreeMap;
use vidar_core::model::ChunkFrame;
use vidar_core::{FrameId, LieGroup, Se3, Sim3};

/// Rotations of a chunk this far (rad, RMS) from those of its pose priors contradict them.
const MAX_ROTATION_RMS_RAD: f64 = 0.14;
/// Centres this far from their pose priors, as a share of the chunk's own radius, contradict them.
const MAX_CENTER_SHARE: f64 = 0.2;
/// Distances of centres below this (m) contradict nothing.
const SMALL_CENTER_RMS_M: f64 = 0.08;
/// A loop that ends with less weight than this is an outlier of the graph.
const OUTLIER_WEIGHT: f64 = 0.05;

/// Unknowns by their index in the graph.
struct Index {
    keyframes: Vec<FrameId>,
    by_frame: BTreeMap<FrameId, usize>,
    /// Index of the chunk in the history → index in the graph.
    chunks: Vec<Option<usize>>,
}

/// The coupling.
#[derive(Debug)]
pub(in crate::aligner) struct Coupled;

impl Coupling for Coupled {
    fn starts_at_priors(&self) -> bool {
        true
    }

    /// A chunk that contradicts both its pose priors and its neighbour is rejected.
    fn initialise(&self, history: &History, chunk: &mut Chunk, pairs: &[CameraPair]) {
        let by_overlap = history.initial_by_overlap(chunk);
        let scale = match chunk.frame {
            ChunkFrame::PriorWorld => 1.0,
            ChunkFrame::ModelNative => by_overlap.map_or(1.0, |b| b.scale),
        };
        let Some(fit) = history.pose_fit(chunk, pairs, scale) else {
            initialise_by_overlap(history, chunk);
            return;
        };
        let fit = with_landmark_scale(fit, chunk.landmark_scale, pairs);
        chunk.log_scale_std = fit.log_scale_std;
        let contradicts = contradicts(&fit, pairs.len(), history.config.max_center_rms_m);
        (chunk.status, chunk.initial) = match (contradicts, by_overlap) {
            (false, _) => (ChunkStatus::Fitted, Some(fit.world_from_chunk)),
            (true, Some(chained)) => {
                chunk.rejections.push(RejectionReason::OdometryDownweighted);
                chunk.odometry_trusted = false;
                (ChunkStatus::Chained, Some(chained))
            }
            (true, None) => {
                chunk.rejections.push(RejectionReason::InconsistentChunk);
                (ChunkStatus::Rejected, None)
            }
        };
        if chunk.frame == ChunkFrame::PriorWorld && chunk.status == ChunkStatus::Fitted {
            chunk.status = ChunkStatus::PriorWorld;
        }
    }

    /// Without a single pose prior that can be used, the estimate is the pose-free one.
    fn estimate(&self, history: &History) -> Estimate {
        let has_priors = history.frames.iter().any(|f| history.frames.pose_prior(f.frame_id).is_some());
        let initial = initial_gauges(history);
        let mut loops = self.loops(history);
        if !has_priors || initial.iter().all(Option::is_none) {
            return first_chain(history, loops);
        }
        let (index, start) = unknowns(history, &initial);
        let mut built = GraphBuilder {
            has_loops: loops.iter().any(|l| l.report.rejection.is_none())
                || history.chunks.iter().any(|c| !c.revisits.is_empty()),
            ..GraphBuilder::default()
        };
        built.odometry(history, &index);
        built.chunks(history, &index, &start);
        built.loops(history, &index, &loops);
        let config = CoupledConfig {
            max_iterations: history.config.graph.max_iterations,
            max_odometry_chi2: history.config.graph.max_odometry_chi2,
            ..CoupledConfig::default()
        };
        let mut estimate = Estimate::new(history, initial, Vec::new(), true);
        estimate.rejections.append(&mut built.rejections);
        match solution(&start, &built.factors, &config) {
            Ok(solution) => {
                let outliers =
                    built.loop_factors.iter().filter(|(_, f)| solution.weights[*f] < OUTLIER_WEIGHT);
                outliers.for_each(|(l, _)| reject(&mut loops[*l], LoopRejection::GraphOutlier));
                if solution.flow == InformationFlow::OneWay {
                    estimate.rejections.push(RejectionReason::OneWay);
                }
                estimate.graph = Some(report(&solution));
                for (k, at) in index.chunks.iter().enumerate() {
                    estimate.chunks[k] = at.map(|at| solution.state.chunks[at]);
                }
                estimate.keyframes.extend(index.keyframes.iter().copied().zip(solution.state.keyframes));
            }
            Err(reason) => {
                let first = index.chunks.iter().position(Option::is_some).unwrap_or(0);
                estimate.failures.push(GraphFailure { first_chunk: history.chunks[first].id, reason });
                estimate.keyframes.extend(index.keyframes.iter().copied().zip(start.keyframes));
            }
        }
        estimate.log_scale_std = built.scale_stds(history);
        estimate.loops = reports(loops);
        estimate
    }
}

/// Whether a chunk's cameras and their pose priors cannot both be right.
fn contradicts(fit: &PoseFit, pairs: usize, max_center_rms_m: f64) -> bool {
    if pairs < 3 {
        return false;
    }
    let limit = (MAX_CENTER_SHARE * fit.radius_m).max(SMALL_CENTER_RMS_M).min(max_center_rms_m);
    fit.rotation_rms_rad > MAX_ROTATION_RMS_RAD || fit.center_rms_m > limit
}

/// The graph's solution; otherwise why there is none.
fn solution(start: &CoupledState, factors: &[Factor], config: &CoupledConfig) -> Result<Solution, String> {
    let solution = solve(start, factors, config).map_err(|e| e.to_string())?;
    let state = &solution.state;
    if state.chunks.iter().all(Sim3::is_finite) && state.keyframes.iter().all(Se3::is_finite) {
        Ok(solution)
    } else {
        Err("the solution is not finite".into())
    }
}

fn report(solution: &Solution) -> GraphReport {
    GraphReport {
        flow: solution.flow,
        keyframes: solution.state.keyframes.len(),
        chunks: solution.state.chunks.len(),
        iterations: solution.iterations,
        cost: solution.cost,
        odometry_chi2: solution.odometry_chi2,
    }
}

/// Where each usable chunk starts: at its own initial place, or through a neighbour on either side that has one.
fn initial_gauges(history: &History) -> Vec<Option<Sim3>> {
    let chunks = &history.chunks;
    let mut places: Vec<Option<Sim3>> =
        chunks.iter().map(|c| c.initial.filter(|_| c.is_usable() && is_metric(history, c))).collect();
    for k in 0..chunks.len() {
        if let (None, true, Some(overlap)) = (places[k], chunks[k].is_usable(), &chunks[k].overlap) {
            places[k] = places[overlap.earlier].map(|p| p * overlap.fit.target_from_source);
        }
    }
    for k in (0..chunks.len()).rev() {
        if let (Some(place), Some(overlap)) = (places[k], &chunks[k].overlap) {
            let before = &mut places[overlap.earlier];
            *before = before.or_else(|| Some(place * overlap.fit.target_from_source.inverse()));
        }
    }
    places
}

/// Whether a chunk's initial place is metric: a chain that met no pose prior yet is in units of its own.
fn is_metric(history: &History, chunk: &Chunk) -> bool {
    chunk.pairs(&history.frames).len() >= 2 && chunk.odometry_trusted
}

fn unknowns(history: &History, places: &[Option<Sim3>]) -> (Index, CoupledState) {
    let mut state = CoupledState::default();
    let mut chunks = vec![None; places.len()];
    for (k, place) in places.iter().enumerate() {
        if let Some(place) = place {
            chunks[k] = Some(state.chunks.len());
            state.chunks.push(*place);
        }
    }
    let mut poses: BTreeMap<FrameId, Se3> = BTreeMap::new();
    for (chunk, place) in history.chunks.iter().zip(places) {
        let Some(place) = place else { continue };
        for view in &chunk.views {
            poses.insert(view.frame_id, place.transform_pose(&view.chunk_from_camera));
        }
    }
    for frame in history.frames.iter() {
        if let Some(prior) = history.frames.pose_prior(frame.frame_id) {
            let is_contradicted =
                history.chunks.iter().any(|c| !c.odometry_trusted && c.view(frame.frame_id).is_some());
            if !(is_contradicted && poses.contains_key(&frame.frame_id)) {
                poses.insert(frame.frame_id, prior.world_from_camera);
            }
        }
    }
    let (keyframes, start): (Vec<FrameId>, Vec<Se3>) = poses.into_iter().unzip();
    state.keyframes = start;
    let by_frame = keyframes.iter().copied().zip(0..).collect();
    (Index { keyframes, by_frame, chunks }, state)
}
