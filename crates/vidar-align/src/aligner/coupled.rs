//! Keyframes and chunk gauges from everything that is known, in one graph.
//!
//! Factors are those of [`crate::coupled`]: odometry between neighbouring anchored frames, gravity, attachment of each view
//! to its chunk (widened by √n: a model's poses of one chunk share their deformation), overlaps with their covariance,
//! loops in a bounded kernel, scales from landmarks, and for chunks whose scale nothing tells a random walk from their
//! neighbour. Where odometry was seen to contradict chunks that agree with each other, it is loosened.

use super::loops::MeasuredLoop;
use super::memory::{Chunk, OverlapConstraint};
use super::report::{GraphReport, LoopRejection, RejectionReason};
use super::world::{World, reports};
use super::{Aligner, GraphWeights};
use crate::coupled::{
    Attachment, CoupledConfig, CoupledState, Factor, InformationFlow, Kernel, RelativeChunk, Solution,
    inflation, solve,
};
use nalgebra::Matrix6;
use std::collections::BTreeMap;
use vidar_core::model::ChunkFrame;
use vidar_core::{FrameId, LieGroup, PoseCovariance, Se3, Sim3};

/// What models and landmarks say may be grossly wrong.
const ROBUST: Kernel = Kernel::Cauchy { k: 3.0 };
/// A loop that is false must not pull at all.
const LOOP: Kernel = Kernel::GemanMcClure { k: 4.0 };
/// Where odometry is not believed its standard deviations grow by this.
const LOOSENED: f64 = 30.0;
/// A loop that ends with less weight than this was let go.
const LET_GO: f64 = 0.05;
/// Deformation between neighbours that no overlap's covariance knows of: rotation (rad), share of depth, ln(scale).
const OVERLAP_FLOOR: [f64; 3] = [0.004, 0.004, 0.004];

/// Unknowns by their index in the graph.
struct Index {
    keyframes: Vec<FrameId>,
    by_frame: BTreeMap<FrameId, usize>,
    /// Chunk of the machine → chunk of the graph.
    chunks: Vec<Option<usize>>,
}

/// The coupled world. Without a single usable anchor it is the pose-free one.
pub(super) fn coupled(machine: &Aligner) -> World {
    let anchored = machine.frames.iter().any(|f| machine.frames.pose_prior(f.frame_id).is_some());
    let places = first_places(machine);
    if !anchored || places.iter().all(Option::is_none) {
        return super::world::pose_free(machine);
    }
    let mut judged = machine.evaluated_loops();
    let (index, start) = unknowns(machine, &places);
    let mut built = Built::default();
    built.odometry(machine, &index);
    built.has_loops = judged.iter().any(|l| l.report.rejection.is_none())
        || machine.chunks.iter().any(|c| !c.revisits.is_empty());
    built.chunks(machine, &index, &start);
    built.loops(machine, &index, &judged);
    let config = CoupledConfig {
        max_iterations: machine.config.graph.max_iterations,
        max_odometry_chi2: machine.config.graph.max_odometry_chi2,
        ..CoupledConfig::default()
    };
    let mut world = World::of(machine, places, true);
    world.rejections.append(&mut built.rejections);
    match solve(&start, &built.factors, &config) {
        Ok(solution) if is_sound(&solution) => {
            built.loop_factors.iter().filter(|(_, f)| solution.weights[*f] < LET_GO).for_each(|(l, _)| {
                judged[*l].report.rejection = Some(LoopRejection::GraphOutlier);
            });
            if solution.flow == InformationFlow::OneWay {
                world.rejections.push(RejectionReason::OneWay);
            }
            world.graph = Some(report(&solution));
            for (k, at) in index.chunks.iter().enumerate() {
                world.chunks[k] = at.map(|at| solution.state.chunks[at]);
            }
            let poses = index.keyframes.iter().copied().zip(solution.state.keyframes);
            world.keyframes.extend(poses);
        }
        _ => {
            world.rejections.push(RejectionReason::GraphFailed);
            world.keyframes.extend(index.keyframes.iter().copied().zip(start.keyframes));
        }
    }
    world.log_scale_std = built.scale_stds(machine);
    world.loops = reports(judged);
    world
}

fn is_sound(solution: &Solution) -> bool {
    solution.state.chunks.iter().all(Sim3::is_finite) && solution.state.keyframes.iter().all(Se3::is_finite)
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

/// Where each usable chunk starts: its own guess, or through a neighbour on either side that has one.
fn first_places(machine: &Aligner) -> Vec<Option<Sim3>> {
    let chunks = &machine.chunks;
    let mut places: Vec<Option<Sim3>> =
        chunks.iter().map(|c| c.first_guess.filter(|_| c.is_usable() && is_metric(machine, c))).collect();
    for k in 0..chunks.len() {
        if let (None, true, Some(tie)) = (places[k], chunks[k].is_usable(), &chunks[k].tie) {
            places[k] = places[tie.to].map(|p| p * tie.fit.target_from_source);
        }
    }
    for k in (0..chunks.len()).rev() {
        if let (Some(place), Some(tie)) = (places[k], &chunks[k].tie) {
            let before = &mut places[tie.to];
            *before = before.or_else(|| Some(place * tie.fit.target_from_source.inverse()));
        }
    }
    places
}

/// Whether a chunk's first guess came from anchors: a chain that met none yet is in units of its own.
fn is_metric(machine: &Aligner, chunk: &Chunk) -> bool {
    chunk.pairs(&machine.frames).len() >= 2 && chunk.odometry_trusted
}

fn unknowns(machine: &Aligner, places: &[Option<Sim3>]) -> (Index, CoupledState) {
    let mut state = CoupledState::default();
    let mut chunks = vec![None; places.len()];
    for (k, place) in places.iter().enumerate() {
        if let Some(place) = place {
            chunks[k] = Some(state.chunks.len());
            state.chunks.push(*place);
        }
    }
    let mut poses: BTreeMap<FrameId, Se3> = BTreeMap::new();
    for (chunk, place) in machine.chunks.iter().zip(places) {
        let Some(place) = place else { continue };
        for view in &chunk.views {
            poses.insert(view.frame_id, place.transform_pose(&view.chunk_from_camera));
        }
    }
    for frame in machine.frames.iter() {
        if let Some(anchor) = machine.frames.pose_prior(frame.frame_id) {
            let loose =
                machine.chunks.iter().any(|c| !c.odometry_trusted && c.view(frame.frame_id).is_some());
            if !(loose && poses.contains_key(&frame.frame_id)) {
                poses.insert(frame.frame_id, anchor.world_from_camera);
            }
        }
    }
    let (keyframes, start): (Vec<FrameId>, Vec<Se3>) = poses.into_iter().unzip();
    state.keyframes = start;
    let by_frame = keyframes.iter().copied().zip(0..).collect();
    (Index { keyframes, by_frame, chunks }, state)
}

/// Factors as they gather.
#[derive(Default)]
struct Built {
    factors: Vec<Factor>,
    /// (judged loop, factor).
    loop_factors: Vec<(usize, usize)>,
    rejections: Vec<RejectionReason>,
    has_loops: bool,
    /// Information on ln(scale) per chunk.
    scale_information: BTreeMap<usize, f64>,
}

impl Built {
    fn odometry(&mut self, machine: &Aligner, index: &Index) {
        let weights = &machine.config.graph;
        let anchored = index
            .keyframes
            .iter()
            .filter_map(|f| Some((*f, index.by_frame[f], machine.frames.pose_prior(*f)?)));
        if let Some((_, i, anchor)) = anchored.clone().next() {
            self.factors.push(Factor::GaugePrior {
                i,
                world_from_camera: anchor.world_from_camera,
                position_std_m: 1e-3,
                heading_std_rad: 1e-3,
            });
        }
        for (_, i, anchor) in anchored {
            if let Some(up_in_camera) = anchor.up_in_camera {
                self.factors.push(Factor::Gravity {
                    i,
                    up_in_camera,
                    std_rad: weights.gravity_deg.to_radians(),
                });
            }
        }
        let distrusted: Vec<&Chunk> = machine.chunks.iter().filter(|c| !c.odometry_trusted).collect();
        for step in machine.frames.steps() {
            let (Some(&i), Some(&j)) = (index.by_frame.get(&step.from), index.by_frame.get(&step.to)) else {
                continue;
            };
            // A step of a frame that is not believed itself is not odometry.
            let known = machine.frames.pose_prior(step.from).is_some()
                && machine.frames.pose_prior(step.to).is_some();
            let loose = distrusted.iter().any(|c| c.view(step.from).is_some() || c.view(step.to).is_some());
            if !known {
                continue;
            }
            let widening = if loose { LOOSENED * LOOSENED } else { 1.0 };
            if let Some(whitening) = whitening(&(step.covariance(weights) * widening)) {
                let i_from_j = step.from_from_to;
                self.factors.push(Factor::Odometry { i, j, i_from_j, whitening: Box::new(whitening) });
            }
        }
    }

    fn chunks(&mut self, machine: &Aligner, index: &Index, start: &CoupledState) {
        let weights = &machine.config.graph;
        for (number, chunk) in machine.chunks.iter().enumerate() {
            let Some(k) = index.chunks[number] else { continue };
            let scale = start.chunks[k].scale;
            self.attach(chunk, k, index, scale, weights);
            let own = self.own_scale(machine, number, k, scale);
            self.scale_information.insert(number, own);
            let tie = chunk.tie.as_ref().and_then(|t| Some((t, index.chunks[t.to]?)));
            if let Some((tie, l)) = tie {
                self.relative(tie, k, l, machine.chunks[tie.to].median_depth(), ROBUST);
                let std = if own > 0.0 { 1.0 / own.sqrt() } else { f64::INFINITY };
                if std > weights.max_log_scale_std {
                    self.rejections.push(RejectionReason::ScaleUnobservable);
                    let log_ratio = tie.fit.target_from_source.scale.ln();
                    let std = weights.scale_walk.hypot(tie.fit.log_scale_std());
                    self.factors.push(Factor::ScaleWalk { k, l, log_ratio, std });
                }
            }
            for tie in &chunk.revisits {
                if let Some(l) = index.chunks[tie.to] {
                    self.relative(tie, k, l, machine.chunks[tie.to].median_depth(), LOOP);
                }
            }
        }
    }

    fn attach(&mut self, chunk: &Chunk, k: usize, index: &Index, scale: f64, weights: &GraphWeights) {
        let widened = inflation(chunk.views.len());
        // What two chunks disagree by where they overlap, the model does not know better inside of one.
        let self_residual = chunk.tie.as_ref().map_or(0.0, |t| t.fit.median_residual / 2.0);
        let ratio = weights.attachment_depth_ratio.max(self_residual.min(0.05));
        let position_std_m = widened * ratio * chunk.median_depth() * scale;
        let rotation_std_rad = widened * weights.attachment_rotation_deg.to_radians();
        for view in &chunk.views {
            self.factors.push(Factor::Attachment(Attachment {
                i: index.by_frame[&view.frame_id],
                k,
                chunk_from_camera: view.chunk_from_camera,
                rotation_std_rad,
                position_std_m,
                kernel: ROBUST,
                // A model that was given the poses repeats them and says nothing new, but a loop must reach keyframes
                // through their chunks.
                moves_keyframe: chunk.frame == ChunkFrame::ModelNative || self.has_loops,
            }));
        }
    }

    /// The landmarks' factor, and the information on ln(scale) from centres and landmarks together.
    fn own_scale(&mut self, machine: &Aligner, number: usize, k: usize, scale: f64) -> f64 {
        let chunk = &machine.chunks[number];
        let mut information = 0.0;
        if chunk.frame == ChunkFrame::PriorWorld {
            // Its depth was seen with the anchors' baselines; where its centres lie, which were given, says nothing of it.
            let std = prior_world_std(&machine.chunks, number);
            self.factors.push(Factor::Scale { k, log_scale: 0.0, std, kernel: ROBUST });
            information += std.powi(-2);
        }
        if chunk.odometry_trusted {
            if chunk.frame == ChunkFrame::ModelNative {
                let centers = machine.pose_fit(chunk, &chunk.pairs(&machine.frames), scale);
                information += centers.map_or(0.0, |c| c.log_scale_std.powi(-2));
            }
            if let Some(z) = chunk.landmark_scale {
                self.factors.push(Factor::Scale { k, log_scale: z.log_scale, std: z.std, kernel: ROBUST });
                information += z.std.powi(-2);
            }
        }
        information
    }

    fn relative(&mut self, tie: &OverlapConstraint, k: usize, l: usize, depth_in_l: f64, kernel: Kernel) {
        let s = tie.fit.target_from_source;
        let covariance = with_floor(&tie.fit.covariance, depth_in_l / s.scale, OVERLAP_FLOOR);
        self.factors
            .extend(RelativeChunk::from_covariance(k, l, s, &covariance, kernel).map(Factor::Relative));
    }

    fn loops(&mut self, machine: &Aligner, index: &Index, judged: &[MeasuredLoop]) {
        for (number, found) in judged.iter().enumerate().filter(|(_, l)| l.report.rejection.is_none()) {
            let (Some(k), Some(l)) = (index.chunks[found.later], index.chunks[found.earlier]) else {
                continue;
            };
            let s = found.earlier_from_later;
            let depth = machine.chunks[found.earlier].median_depth() / s.scale;
            let covariance = with_floor(&found.covariance, depth, OVERLAP_FLOOR.map(|f| 2.0 * f));
            if let Some(factor) = RelativeChunk::from_covariance(k, l, s, &covariance, LOOP) {
                self.loop_factors.push((number, self.factors.len()));
                self.factors.push(Factor::Relative(factor));
            }
        }
    }

    /// How far each chunk's scale may be trusted: its own evidence, and its neighbours' through the overlaps.
    fn scale_stds(&self, machine: &Aligner) -> Vec<f64> {
        let n = machine.chunks.len();
        let own = |k: usize| self.scale_information.get(&k).copied().unwrap_or(0.0);
        let walk = machine.config.graph.scale_walk;
        // Forward and backward along the chain, as two filters that meet.
        let passed = |information: f64, std: f64| {
            if information > 0.0 { 1.0 / (1.0 / information + std * std) } else { 0.0 }
        };
        let mut forward = vec![0.0; n];
        let mut backward = vec![0.0; n];
        for k in 0..n {
            if let Some(tie) = &machine.chunks[k].tie {
                let std = walk.hypot(tie.fit.log_scale_std());
                forward[k] = passed(own(tie.to) + forward[tie.to], std);
            }
        }
        for k in (0..n).rev() {
            if let Some(tie) = &machine.chunks[k].tie {
                let std = walk.hypot(tie.fit.log_scale_std());
                backward[tie.to] += passed(own(k) + backward[k], std);
            }
        }
        // What the landmarks of all chunks share, neighbours do not average out.
        let shared = |k: usize| machine.chunks[k].landmark_scale.map_or(0.0, |z| z.shared_std);
        (0..n).map(|k| (own(k) + forward[k] + backward[k]).powf(-0.5).hypot(shared(k))).collect()
    }
}

/// How far the depth of a chunk in the anchors' world may be trusted: no farther than both its neighbours bear out.
fn prior_world_std(chunks: &[Chunk], number: usize) -> f64 {
    let next = chunks.get(number + 1).filter(|c| c.frame == ChunkFrame::PriorWorld);
    let by_next = next.filter(|c| c.tie.as_ref().is_none_or(|t| t.to == number)).map(Chunk::prior_world_std);
    by_next.into_iter().fold(chunks[number].prior_world_std(), f64::max)
}

/// A covariance with what the model is off by besides: lengths are shares of `depth`.
fn with_floor(
    covariance: &nalgebra::SMatrix<f64, 7, 7>,
    depth: f64,
    floor: [f64; 3],
) -> nalgebra::SMatrix<f64, 7, 7> {
    let mut widened = *covariance;
    for i in 0..3 {
        widened[(i, i)] += floor[0] * floor[0];
        widened[(i + 3, i + 3)] += (floor[1] * depth).powi(2);
    }
    widened[(6, 6)] += floor[2] * floor[2];
    widened
}

/// W with `Wᵀ W = Σ⁻¹`.
fn whitening(covariance: &PoseCovariance) -> Option<Matrix6<f64>> {
    let symmetric = (covariance + covariance.transpose()) * 0.5;
    let information = symmetric.cholesky()?.inverse();
    Some(((information + information.transpose()) * 0.5).cholesky()?.l().transpose())
}
