//! Revisits: found by looks, measured by geometry, believed only when three independent checks agree.
//!
//! 1. Both sides' points agree: more than half within 5 % of depth.
//! 2. The loop is plausible: χ² of the measured transform against what odometry predicts, with its covariance.
//! 3. Loops agree with each other: the largest set of pairwise consistent ones is kept (Mangelson 2018), when there are
//!    three or more.
//!
//! In the graph each still ends in a bounded kernel. With [`Compat::Reference`] in `da3-streaming` nothing is checked.

mod clique;
mod direct;
mod plausible;

use super::memory::{Chunk, View, sampled_thin};
use super::report::{LoopRejection, LoopReport};
use super::{Aligner, CouplingMode, tie};
use crate::AlignError;
use crate::overlap::{OverlapFit, SampledView, shared_views};
use crate::streaming::Compat;
use nalgebra::SMatrix;
use vidar_core::{ChunkId, FrameId, GeometryPrediction, LieGroup, Sim3};

/// Two chunks that seem to show one place.
#[derive(Clone, Debug, PartialEq)]
pub struct LoopCandidate {
    /// The later chunk.
    pub later: ChunkId,
    /// Its frame that looks alike.
    pub later_frame: FrameId,
    /// Frames of the later chunk around it: one half of a loop chunk.
    pub later_window: Vec<FrameId>,
    /// The earlier chunk.
    pub earlier: ChunkId,
    /// Its frame that looks alike.
    pub earlier_frame: FrameId,
    /// Frames of the earlier chunk around it: the other half.
    pub earlier_window: Vec<FrameId>,
    /// Inner product of the two descriptors.
    pub similarity: f32,
}

/// A loop with what the graph needs of it.
#[derive(Clone, Debug)]
pub(super) struct MeasuredLoop {
    pub later: usize,
    pub earlier: usize,
    pub earlier_from_later: Sim3,
    /// Of δ in `earlier_from_later · exp(δ)`, units of the later chunk.
    pub covariance: SMatrix<f64, 7, 7>,
    pub report: LoopReport,
}

/// The best look-alike of a pair of chunks so far.
#[derive(Clone, Copy, Debug)]
pub(super) struct FrameMatch {
    pub later_frame: FrameId,
    pub earlier_frame: FrameId,
    pub similarity: f32,
    pub is_evaluated: bool,
}

impl Aligner {
    /// Revisits that wait for a status ([`Aligner::push_loop`]), most similar first: the best pair of frames per pair of
    /// chunks, neighbours left out, at most so many per chunk.
    pub fn loop_candidates(&self) -> Vec<LoopCandidate> {
        let mut waiting: Vec<(&(usize, usize), &FrameMatch)> =
            self.frame_matches.iter().filter(|(_, l)| !l.is_evaluated).collect();
        waiting.sort_by(|a, b| b.1.similarity.total_cmp(&a.1.similarity).then(a.0.cmp(b.0)));
        let judged =
            |chunk: usize| self.frame_matches.iter().filter(|(k, l)| k.0 == chunk && l.is_evaluated).count();
        let mut taken = vec![0usize; self.chunks.len()];
        let mut candidates = Vec::new();
        for (&(later, earlier), look) in waiting {
            if taken[later] + judged(later) >= self.config.loops.max_per_chunk {
                continue;
            }
            taken[later] += 1;
            let (a, b) = (&self.chunks[later], &self.chunks[earlier]);
            candidates.push(LoopCandidate {
                later: a.id,
                later_frame: look.later_frame,
                later_window: window(a, look.later_frame, self.config.loops.window),
                earlier: b.id,
                earlier_frame: look.earlier_frame,
                earlier_window: window(b, look.earlier_frame, self.config.loops.window),
                similarity: look.similarity,
            });
        }
        candidates
    }

    /// Judges a revisit. `prediction` is the model's answer to the frames of both windows together; without it the stored
    /// geometry of the two chunks is compared directly, which costs no inference.
    ///
    /// # Errors
    /// [`AlignError::UnknownChunk`]. A loop that is no good is no error: its report says so.
    pub fn push_loop(
        &mut self,
        candidate: &LoopCandidate,
        prediction: Option<&GeometryPrediction>,
    ) -> Result<LoopReport, AlignError> {
        let index = |id| {
            self.chunks.iter().position(|c: &Chunk| c.id == id).ok_or(AlignError::UnknownChunk { chunk: id })
        };
        let (later, earlier) = (index(candidate.later)?, index(candidate.earlier)?);
        if let Some(look) = self.frame_matches.get_mut(&(later, earlier)) {
            look.is_evaluated = true;
        }
        let measured = match prediction {
            Some(prediction) => self.measure_by_chunk(later, earlier, prediction),
            None => direct::measure(self, later, earlier, candidate),
        };
        let mut report = LoopReport {
            later: candidate.later,
            earlier: candidate.earlier,
            similarity: candidate.similarity,
            earlier_from_later: None,
            inlier_ratio: 0.0,
            chi2: f64::NAN,
            rejection: Some(LoopRejection::NoGeometry),
        };
        if let Some(fit) = measured {
            let (transform, covariance) = (fit.target_from_source, fit.covariance);
            report.earlier_from_later = Some(transform);
            report.inlier_ratio = fit.inlier_ratio;
            report.chi2 = plausible::chi2(self, later, earlier, candidate, &fit).unwrap_or(f64::NAN);
            report.rejection = self.rejection(&report);
            let report = report.clone();
            self.loops.push(MeasuredLoop {
                later,
                earlier,
                earlier_from_later: transform,
                covariance,
                report,
            });
        } else {
            let nothing = SMatrix::identity();
            let earlier_from_later = Sim3::IDENTITY;
            let report = report.clone();
            self.loops.push(MeasuredLoop { later, earlier, earlier_from_later, covariance: nothing, report });
        }
        Ok(report)
    }

    fn rejection(&self, report: &LoopReport) -> Option<LoopRejection> {
        if self.mode == CouplingMode::Da3Streaming && self.config.compat == Compat::Reference {
            return None;
        }
        if report.inlier_ratio <= self.config.loops.min_inlier_ratio {
            return Some(LoopRejection::FewInliers);
        }
        // Without anchors there is nothing to be implausible against.
        (report.chi2 > self.config.loops.max_chi2).then_some(LoopRejection::Chi2TooLarge)
    }

    /// `b_from_a = b_from_loop ∘ a_from_loop⁻¹`, each by the frames the loop chunk shares with that side.
    fn measure_by_chunk(
        &self,
        later: usize,
        earlier: usize,
        prediction: &GeometryPrediction,
    ) -> Option<OverlapFit> {
        let loop_views: Vec<SampledView> = prediction.views.iter().map(sampled_thin).collect();
        let side = |chunk: usize| {
            let views = shared_views(self.chunks[chunk].views.iter().map(|v| &v.thin), loop_views.iter());
            tie::robust(&views, &self.config)
        };
        let (a, b) = (side(later)?, side(earlier)?);
        let a_from_loop = a.target_from_source;
        // b_L e^{δ_b} (a_L e^{δ_a})⁻¹ = b_L a_L⁻¹ e^{Ad(a_L)(δ_b − δ_a)} to first order.
        let carry = a_from_loop.adjoint();
        Some(OverlapFit {
            target_from_source: b.target_from_source * a_from_loop.inverse(),
            covariance: carry * (a.covariance + b.covariance) * carry.transpose(),
            pairs: a.pairs + b.pairs,
            inlier_ratio: a.inlier_ratio.min(b.inlier_ratio),
            median_residual: a.median_residual.max(b.median_residual),
            iterations: a.iterations + b.iterations,
        })
    }

    /// Learns how the places of the newest chunk look, and whether any was seen before.
    pub(super) fn learn_places(&mut self, frames: &[super::FrameObservation]) {
        // Where chunks are not tied to each other, a loop has nothing to close.
        let Some(newest) = self.chunks.len().checked_sub(1).filter(|_| self.mode.chains()) else { return };
        let l = &self.config.loops;
        let has_travel = self.mode.uses_pose_priors();
        let least = if self.places.is_whitened() { l.min_token_similarity } else { l.min_similarity };
        for frame in frames {
            let Some(descriptor) = &frame.descriptor else { continue };
            if self.chunks[newest].view(frame.frame_id).is_none() {
                continue;
            }
            let travel = self.frames.travel_m(frame.frame_id);
            let min_travel = if has_travel && travel.is_some() { l.min_travel_m } else { 0.0 };
            let travel = travel.unwrap_or(0.0);
            let found = self.places.search(frame.time, travel, descriptor, l.top_k, l.min_gap_s, min_travel);
            for place in found.into_iter().filter(|m| m.similarity > least) {
                let holds = |c: &Chunk| c.is_usable() && c.view(place.frame_id).is_some();
                let Some(earlier) = self.chunks[..newest].iter().rposition(holds) else { continue };
                if !self.chunks[newest].is_usable() || newest - earlier <= 1 {
                    continue;
                }
                let look = FrameMatch {
                    later_frame: frame.frame_id,
                    earlier_frame: place.frame_id,
                    similarity: place.similarity,
                    is_evaluated: false,
                };
                let best = self.frame_matches.entry((newest, earlier)).or_insert(look);
                if !best.is_evaluated && look.similarity > best.similarity {
                    *best = look;
                }
            }
            if self.known_places.insert(frame.frame_id) {
                self.places.add(frame.frame_id, frame.time, travel, descriptor);
            }
        }
    }

    /// All loops as they stand: those that passed their own gates are held against each other.
    pub(super) fn evaluated_loops(&self) -> Vec<MeasuredLoop> {
        let mut loops = self.loops.clone();
        let verbatim = self.mode == CouplingMode::Da3Streaming && self.config.compat == Compat::Reference;
        let open: Vec<usize> = (0..loops.len()).filter(|&i| loops[i].report.rejection.is_none()).collect();
        if open.len() < 3 || verbatim {
            return loops;
        }
        let agree =
            |i: usize, j: usize| plausible::consistent(self, &self.loops[open[i]], &self.loops[open[j]]);
        let kept = clique::largest(open.len(), agree);
        for (position, &i) in open.iter().enumerate() {
            if !kept.contains(&position) {
                loops[i].report.rejection = Some(LoopRejection::Inconsistent);
            }
        }
        loops
    }

    /// Accepted loops as (later, earlier, `earlier_from_later`), chunks by index; frames that came back count, too.
    pub(super) fn loop_edges(&self, judged: &[MeasuredLoop]) -> Vec<(usize, usize, Sim3)> {
        let revisits = self
            .chunks
            .iter()
            .enumerate()
            .flat_map(|(k, c)| c.revisits.iter().map(move |t| (k, t.to, t.fit.target_from_source)));
        judged
            .iter()
            .filter(|l| l.report.rejection.is_none())
            .map(|l| (l.later, l.earlier, l.earlier_from_later))
            .chain(revisits)
            .collect()
    }
}

/// Frames of a chunk around one of them, shifted inwards at the chunk's ends.
fn window(chunk: &Chunk, frame: FrameId, half: usize) -> Vec<FrameId> {
    let n = chunk.views.len();
    let at = chunk.views.iter().position(|v: &View| v.frame_id == frame).unwrap_or(0);
    let start = at.saturating_sub(half).min(n.saturating_sub(2 * half));
    chunk.views[start..n.min(start + 2 * half)].iter().map(|v| v.frame_id).collect()
}
