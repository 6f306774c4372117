//! Factors of the coupled graph: odometry, gravity, attachments, scales, overlaps and loops.

use super::Index;
use crate::aligner::chunk::{Chunk, OverlapConstraint};
use crate::aligner::config::GraphWeights;
use crate::aligner::history::{History, LoopMeasurement};
use crate::aligner::report::RejectionReason;
use crate::coupled::{Attachment, CoupledState, Factor, RelativeChunk, inflation};
use nalgebra::Matrix6;
use std::collections::BTreeMap;
use vidar_core::PoseCovariance;
use vidar_core::model::ChunkFrame;
use vidar_solve::Kernel;

/// Models and landmarks may be grossly wrong.
const ROBUST: Kernel = Kernel::Cauchy { k: 3.0 };

/// A false loop must have no influence at all.
const LOOP: Kernel = Kernel::GemanMcClure { k: 4.0 };

/// Factor on the odometry's standard deviations where it is not trusted.
const ODOMETRY_WIDENING: f64 = 30.0;

/// Deformation between neighbours that the covariance of an overlap does not contain: rotation (rad), share of depth,
/// ln(scale).
const OVERLAP_FLOOR: [f64; 3] = [0.004, 0.004, 0.004];

/// Factors as they gather.
#[derive(Default)]
pub(super) struct GraphBuilder {
    pub(super) factors: Vec<Factor>,
    /// (loop, factor).
    pub(super) loop_factors: Vec<(usize, usize)>,
    pub(super) rejections: Vec<RejectionReason>,
    pub(super) has_loops: bool,
    /// Information on ln(scale) per chunk.
    pub(super) scale_information: BTreeMap<usize, f64>,
}

impl GraphBuilder {
    pub(super) fn odometry(&mut self, history: &History, index: &Index) {
        let weights = &history.config.graph;
        let with_prior = index
            .keyframes
            .iter()
            .filter_map(|f| Some((*f, index.by_frame[f], history.frames.pose_prior(*f)?)));
        if let Some((_, i, prior)) = with_prior.clone().next() {
            self.factors.push(Factor::GaugePrior {
                i,
                world_from_camera: prior.world_from_camera,
                position_std_m: 1e-3,
                heading_std_rad: 1e-3,
            });
        }
        for (_, i, prior) in with_prior {
            if let Some(up_in_camera) = prior.up_in_camera {
                self.factors.push(Factor::Gravity {
                    i,
                    up_in_camera,
                    std_rad: weights.gravity_deg.to_radians(),
                });
            }
        }
        let contradicted: Vec<&Chunk> = history.chunks.iter().filter(|c| !c.odometry_trusted).collect();
        for step in history.frames.steps() {
            let (Some(&i), Some(&j)) = (index.by_frame.get(&step.from), index.by_frame.get(&step.to)) else {
                continue;
            };
            // A step from or to an untrusted pose is not odometry.
            let is_trusted = history.frames.pose_prior(step.from).is_some()
                && history.frames.pose_prior(step.to).is_some();
            if !is_trusted {
                continue;
            }
            let is_contradicted =
                contradicted.iter().any(|c| c.view(step.from).is_some() || c.view(step.to).is_some());
            let widening = if is_contradicted { ODOMETRY_WIDENING * ODOMETRY_WIDENING } else { 1.0 };
            if let Some(whitening) = whitening(&(step.covariance(weights) * widening)) {
                let i_from_j = step.from_from_to;
                self.factors.push(Factor::Odometry { i, j, i_from_j, whitening: Box::new(whitening) });
            } else {
                self.rejections.push(RejectionReason::SingularCovariance);
            }
        }
    }

    pub(super) fn chunks(&mut self, history: &History, index: &Index, start: &CoupledState) {
        let weights = &history.config.graph;
        for (number, chunk) in history.chunks.iter().enumerate() {
            let Some(k) = index.chunks[number] else { continue };
            let scale = start.chunks[k].scale;
            self.attach(chunk, k, index, scale, weights);
            let own = self.own_scale(history, number, k, scale);
            self.scale_information.insert(number, own);
            let overlap = chunk.overlap.as_ref().and_then(|t| Some((t, index.chunks[t.earlier]?)));
            if let Some((overlap, l)) = overlap {
                self.relative(overlap, k, l, history.chunks[overlap.earlier].median_depth(), ROBUST);
                let std = if own > 0.0 { 1.0 / own.sqrt() } else { f64::INFINITY };
                if std > weights.max_log_scale_std {
                    self.rejections.push(RejectionReason::ScaleUnobservable);
                    let log_ratio = overlap.fit.target_from_source.scale.ln();
                    let std = weights.scale_walk.hypot(overlap.fit.log_scale_std());
                    self.factors.push(Factor::ScaleWalk { k, l, log_ratio, std });
                }
            }
            for overlap in &chunk.revisits {
                if let Some(l) = index.chunks[overlap.earlier] {
                    self.relative(overlap, k, l, history.chunks[overlap.earlier].median_depth(), LOOP);
                }
            }
        }
    }

    fn attach(&mut self, chunk: &Chunk, k: usize, index: &Index, scale: f64, weights: &GraphWeights) {
        let widened = inflation(chunk.views.len());
        // Inside a chunk the model is no better than the disagreement of two chunks on their overlap.
        let self_residual = chunk.overlap.as_ref().map_or(0.0, |t| t.fit.median_residual / 2.0);
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
                // A model that was given the poses repeats them and adds no information, but a loop must reach keyframes
                // through their chunks.
                moves_keyframe: chunk.frame == ChunkFrame::ModelNative || self.has_loops,
            }));
        }
    }

    /// The landmarks' factor, and the information on ln(scale) from centres and landmarks together.
    fn own_scale(&mut self, history: &History, number: usize, k: usize, scale: f64) -> f64 {
        let chunk = &history.chunks[number];
        let mut information = 0.0;
        if chunk.frame == ChunkFrame::PriorWorld {
            // Its depth follows from the baselines of the pose priors; its centres, which were given, are no evidence of it.
            let std = prior_world_std(&history.chunks, number);
            let log_scale = chunk.now_from_then.scale.ln();
            self.factors.push(Factor::Scale { k, log_scale, std, kernel: ROBUST });
            information += std.powi(-2);
        }
        if chunk.odometry_trusted {
            if chunk.frame == ChunkFrame::ModelNative {
                let centers = history.pose_fit(chunk, &chunk.pairs(&history.frames), scale);
                information += centers.map_or(0.0, |c| c.log_scale_std.powi(-2));
            }
            if let Some(z) = chunk.landmark_scale {
                self.factors.push(Factor::Scale { k, log_scale: z.log_scale, std: z.std, kernel: ROBUST });
                information += z.std.powi(-2);
            }
        }
        information
    }

    fn relative(&mut self, overlap: &OverlapConstraint, k: usize, l: usize, depth_in_l: f64, kernel: Kernel) {
        let s = overlap.fit.target_from_source;
        let covariance = with_floor(&overlap.fit.covariance, depth_in_l / s.scale, OVERLAP_FLOOR);
        match RelativeChunk::from_covariance(k, l, s, &covariance, kernel) {
            Some(factor) => self.factors.push(Factor::Relative(factor)),
            None => self.rejections.push(RejectionReason::SingularCovariance),
        }
    }

    pub(super) fn loops(&mut self, history: &History, index: &Index, loops: &[LoopMeasurement]) {
        for (number, found) in loops.iter().enumerate().filter(|(_, l)| l.report.rejection.is_none()) {
            let (Some(k), Some(l)) = (index.chunks[found.later], index.chunks[found.earlier]) else {
                continue;
            };
            let s = found.earlier_from_later;
            let depth = history.chunks[found.earlier].median_depth() / s.scale;
            let covariance = with_floor(&found.covariance, depth, OVERLAP_FLOOR.map(|f| 2.0 * f));
            if let Some(factor) = RelativeChunk::from_covariance(k, l, s, &covariance, LOOP) {
                self.loop_factors.push((number, self.factors.len()));
                self.factors.push(Factor::Relative(factor));
            } else {
                self.rejections.push(RejectionReason::SingularCovariance);
            }
        }
    }

    /// σ of ln(scale) per chunk, from its own centres and landmarks and from its neighbours' through the overlaps.
    pub(super) fn scale_stds(&self, history: &History) -> Vec<f64> {
        let n = history.chunks.len();
        let own = |k: usize| self.scale_information.get(&k).copied().unwrap_or(0.0);
        let walk = history.config.graph.scale_walk;
        // Two filters, forward and backward along the chain.
        let passed = |information: f64, std: f64| {
            if information > 0.0 { 1.0 / (1.0 / information + std * std) } else { 0.0 }
        };
        let mut forward = vec![0.0; n];
        let mut backward = vec![0.0; n];
        for k in 0..n {
            if let Some(overlap) = &history.chunks[k].overlap {
                let std = walk.hypot(overlap.fit.log_scale_std());
                forward[k] = passed(own(overlap.earlier) + forward[overlap.earlier], std);
            }
        }
        for k in (0..n).rev() {
            if let Some(overlap) = &history.chunks[k].overlap {
                let std = walk.hypot(overlap.fit.log_scale_std());
                backward[overlap.earlier] += passed(own(k) + backward[k], std);
            }
        }
        // An error that the landmarks of all chunks share is not averaged out by neighbours.
        let shared = |k: usize| history.chunks[k].landmark_scale.map_or(0.0, |z| z.shared_std);
        (0..n).map(|k| (own(k) + forward[k] + backward[k]).powf(-0.5).hypot(shared(k))).collect()
    }
}

/// σ of ln(metres per unit) of a chunk in the world of its pose priors: no smaller than its overlap with either neighbour shows.
fn prior_world_std(chunks: &[Chunk], number: usize) -> f64 {
    let next = chunks.get(number + 1).filter(|c| c.frame == ChunkFrame::PriorWorld);
    let by_next =
        next.filter(|c| c.overlap.as_ref().is_none_or(|t| t.earlier == number)).map(Chunk::prior_world_std);
    by_next.into_iter().fold(chunks[number].prior_world_std(), f64::max)
}

/// A covariance plus that of the model's deformation; lengths of `floor` are shares of `depth`.
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
