//! The push machine of a run: predicted chunks in, one [`Placement`] out.
//!
//! ```text
//!              ┌─ overlap constraint to the chunk before     ┌─ da3-streaming, pose-free: chain, loops, Sim(3) graph
//! push(chunk) ─┼─ fit to its pose priors                ──▶ ─┼─ hybrid: the chain, then one similarity onto the pose priors
//!              ├─ scale and depth fields from landmarks      ├─ pose-conditioned, ground-truth: pose priors, scale per chunk
//!              └─ descriptors ─▶ loop_candidates ─▶ push_loop└─ coupled: one graph of all of it
//!                                                           placement_so_far / finish ─▶ Placement
//! ```
//!
//! It owns no thread, file or clock. Of a chunk it keeps poses, a few hundred depths per view and measurements; of the chunk
//! before also some thousand depths per view (with [`Compat::Reference`](crate::streaming::Compat) its full views). A chunk
//! that cannot be used is no error: it is left out or held by its neighbours, and the reason is counted in
//! [`Placement::rejections`]. Same input, same bits.
//!
//! ```
//! use nalgebra::Vector3;
//! use vidar_align::aligner::{Aligner, AlignerConfig, ChunkObservation, CouplingMode, FrameObservation, PosePrior};
//! use vidar_core::model::ChunkFrame;
//! use vidar_core::{
//!     ChunkId, Confidence, FrameId, GeometryPrediction, Image, Pinhole, RelativeDepth, Se3, Timestamp, ViewGeometry,
//! };
//!
//! // A wall two units away; the model takes one unit for half a metre.
//! let view = |i: u32| ViewGeometry {
//!     frame_id: FrameId(i),
//!     chunk_from_camera: Se3::from_translation(Vector3::new(f64::from(i), f64::from(i * i) * 0.1, 0.0)),
//!     intrinsics: Pinhole { fx: 20.0, fy: 20.0, cx: 15.5, cy: 11.5, width: 32, height: 24 },
//!     depth: RelativeDepth::new(Image::filled(32, 24, 2.0)),
//!     confidence: Confidence::full(32, 24),
//! };
//! let views: Vec<ViewGeometry> = (0..5).map(view).collect();
//! let frames = views.iter().map(|v| {
//!     let mut metric = v.chunk_from_camera;
//!     metric.translation *= 0.5;
//!     FrameObservation::new(v.frame_id, Timestamp::from_nanos(i64::from(v.frame_id.0) * 100_000_000))
//!         .with_pose_prior(PosePrior::new(metric))
//! });
//! let frames = frames.collect();
//! let prediction = GeometryPrediction { chunk_id: ChunkId(0), frame: ChunkFrame::ModelNative, views };
//!
//! let mut aligner = Aligner::new(CouplingMode::Coupled, &AlignerConfig::default())?;
//! aligner.push(ChunkObservation { prediction: prediction.clone(), frames })?;
//! let placement = aligner.finish();
//! let metric = placement.aligned_views(prediction, &[])?;
//! assert!((metric[0].depth().image()[(16, 12)] - 1.0).abs() < 1e-3);
//! # Ok::<(), vidar_align::AlignError>(())
//! ```

mod aligned_views;
mod chain;
mod chunk;
mod config;
mod coupling;
mod estimate;
mod frames;
mod history;
mod landmarks;
mod loops;
mod observation;
mod overlaps;
mod pose_fit;
mod report;
mod view_consistency;

pub use aligned_views::color_at_size;
pub use config::{AlignerConfig, GraphWeights, LoopsConfig};
pub use coupling::CouplingMode;
pub use loops::candidate::LoopCandidate;
pub use observation::{ChunkObservation, DepthPoint, FrameObservation, PosePrior};
pub use report::{
    ChunkPlacement, ChunkReport, ChunkStatus, DriftReport, GraphFailure, GraphReport, KeyframePlacement,
    LoopRejection, LoopReport, OverlapReport, Placement, PoseCorrection, RejectionCounts, RejectionReason,
    ViewPlacement,
};

use crate::AlignError;
use crate::overlap::{SampledView, shared_views};
use chunk::{Chunk, OverlapConstraint, sampled_views};
use coupling::{Coupling, SharedFrames};
use estimate::Estimate;
use history::{History, LoopMeasurement};
use loops::LoopSearch;
use loops::checks::CheckedLoop;
use nalgebra::SMatrix;
use pose_fit::{CameraPair, center_rms};
use vidar_core::model::ChunkFrame;
use vidar_core::{ChunkId, FrameId, GeometryPrediction, Se3, Sim3, ViewGeometry};

/// The aligner.
#[derive(Debug)]
pub struct Aligner {
    mode: CouplingMode,
    coupling: &'static dyn Coupling,
    history: History,
    previous: PreviousChunk,
    search: LoopSearch,
    /// What [`Aligner::provisional_placement`] estimated last.
    latest: Option<Estimate>,
}

/// Share of more chunks that are there when a provisional placement is estimated anew. A graph with loops costs more than in proportion to
/// its length: with an estimate after every chunk 377 chunks with a loop each took 1300 s (`bench/live_hour.py`, on a busy machine).
const CHUNKS_PER_ESTIMATE: usize = 16;

/// Geometry of the last usable chunk.
#[derive(Debug, Default)]
struct PreviousChunk {
    index: usize,
    sampled: Vec<SampledView>,
    /// Only for couplings that fit overlaps on all pixels.
    full: Vec<ViewGeometry>,
}

impl Aligner {
    /// An aligner without chunks.
    ///
    /// # Errors
    /// Those of [`AlignerConfig::validate`].
    pub fn new(mode: CouplingMode, config: &AlignerConfig) -> Result<Self, AlignError> {
        config.validate()?;
        Ok(Self {
            mode,
            coupling: mode.coupling(config.compat),
            history: History::new(config.clone()),
            previous: PreviousChunk::default(),
            search: LoopSearch::default(),
            latest: None,
        })
    }

    /// Compares descriptors after whitening ([`PlaceIndex::whitened`](crate::place_recognition::PlaceIndex::whitened)), with
    /// the threshold [`LoopsConfig::min_token_similarity`]: for descriptors that are averages of a model's tokens.
    #[must_use]
    pub fn with_whitened_descriptors(mut self) -> Self {
        self.search = LoopSearch::whitened();
        self
    }

    /// How prediction and odometry are coupled.
    pub fn mode(&self) -> CouplingMode {
        self.mode
    }

    /// Takes the next chunk.
    ///
    /// # Errors
    /// [`AlignError::RepeatedChunk`]. A chunk that cannot be used is no error: its report has the reason.
    pub fn push(&mut self, observation: ChunkObservation) -> Result<ChunkReport, AlignError> {
        let ChunkObservation { prediction, frames } = observation;
        if self.history.chunks.iter().any(|c| c.id == prediction.chunk_id) {
            return Err(AlignError::RepeatedChunk { chunk: prediction.chunk_id });
        }
        for frame in &frames {
            self.history.frames.insert(frame.frame_id, frame.time, frame.pose_prior.clone());
        }
        let correction = self.coupling.correct_depth(&prediction, &frames, &self.history.config);
        let prediction = correction.corrected(prediction);
        let (mut views, sampled, dropped) = sampled_views(&prediction, &self.history.config);
        for view in &mut views {
            view.field = correction.fields.get(&view.frame_id).cloned();
        }
        let mut rejections = correction.rejections;
        rejections.extend(vec![RejectionReason::ViewNotFinite; dropped]);
        let overlap = self.overlap(&sampled, &prediction, &mut rejections);
        let mut chunk = Chunk {
            id: prediction.chunk_id,
            frame: prediction.frame,
            views,
            status: ChunkStatus::Chained,
            overlap,
            revisits: Vec::new(),
            landmark_scale: correction.scale,
            rejections,
            now_from_then: Sim3::IDENTITY,
            initial: None,
            log_scale_std: f64::INFINITY,
            odometry_trusted: true,
        };
        let pairs = chunk.pairs(&self.history.frames);
        if chunk.views.is_empty() {
            chunk.status = ChunkStatus::Rejected;
            chunk.rejections.push(RejectionReason::InconsistentChunk);
        } else {
            self.coupling.initialise(&self.history, &mut chunk, &pairs);
        }
        if chunk.is_usable() {
            chunk.revisits = self.coupling.revisits(&self.history, &chunk);
        }
        let report = self.report(&chunk, &pairs);
        if chunk.is_usable() {
            let full = if self.coupling.keeps_full_views() { prediction.views } else { Vec::new() };
            self.previous = PreviousChunk { index: self.history.chunks.len(), sampled, full };
        }
        self.history.chunks.push(chunk);
        if self.coupling.closes_loops() {
            let config = &self.history.config.loops;
            let min_travel_m = if self.mode.uses_pose_priors() { config.min_travel_m } else { 0.0 };
            self.search.update(&self.history, &frames, min_travel_m);
        }
        Ok(report)
    }

    /// The odometry has estimated poses of frames again, in another scale perhaps (`world_from_camera`, m): chunks move with their cameras.
    /// Frames without a pose prior are left.
    pub fn revise(&mut self, poses: &[(FrameId, Se3)]) {
        let pairs = |history: &History| -> Vec<Vec<CameraPair>> {
            history.chunks.iter().map(|c| c.pairs(&history.frames)).collect()
        };
        let before = pairs(&self.history);
        self.history.frames.revise(poses);
        let now = pairs(&self.history);
        let mut scale = 1.0;
        for ((chunk, before), now) in self.history.chunks.iter_mut().zip(&before).zip(&now) {
            let Some(now_from_before) = chunk.follow(before, now, scale) else { continue };
            scale = now_from_before.scale;
            if self.coupling.starts_at_priors() {
                chunk.initial = chunk.initial.map(|place| now_from_before * place);
            }
        }
        self.latest = None;
    }

    /// Pairs of chunks that may show one place and wait for [`Aligner::push_loop`], most similar first: the best pair of
    /// frames per pair of chunks, neighbours left out, at most [`LoopsConfig::max_per_chunk`] per chunk.
    pub fn loop_candidates(&self) -> Vec<LoopCandidate> {
        self.search.candidates(&self.history)
    }

    /// Measures and checks a loop. `prediction` is the model's prediction of the frames of both windows together; without
    /// it the stored samples of the two chunks are registered to each other, which costs no inference.
    ///
    /// # Errors
    /// [`AlignError::UnknownChunk`]. A loop that cannot be used is no error: its report has the reason.
    pub fn push_loop(
        &mut self,
        candidate: &LoopCandidate,
        prediction: Option<&GeometryPrediction>,
    ) -> Result<LoopReport, AlignError> {
        let index = |id: ChunkId| {
            let found = self.history.chunks.iter().position(|c| c.id == id);
            found.ok_or(AlignError::UnknownChunk { chunk: id })
        };
        let (later, earlier) = (index(candidate.later)?, index(candidate.earlier)?);
        self.search.mark_evaluated(later, earlier);
        let mut report = LoopReport {
            later: candidate.later,
            earlier: candidate.earlier,
            similarity: candidate.similarity,
            earlier_from_later: None,
            inlier_ratio: 0.0,
            chi2: None,
            rejection: None,
        };
        let measurement = match loops::measure(&self.history, (later, earlier), candidate, prediction) {
            Ok(fit) => {
                report.earlier_from_later = Some(fit.target_from_source);
                report.inlier_ratio = fit.inlier_ratio;
                let checked = CheckedLoop { later, earlier, candidate, fit: &fit };
                report.chi2 = self.coupling.loop_chi2(&self.history, &checked);
                let mut measurement = LoopMeasurement {
                    later,
                    earlier,
                    earlier_from_later: fit.target_from_source,
                    covariance: fit.covariance,
                    report,
                };
                measurement.report.rejection = self.coupling.check_loop(&self.history, &measurement);
                measurement
            }
            Err(reason) => {
                report.rejection = Some(reason);
                let (earlier_from_later, covariance) = (Sim3::IDENTITY, SMatrix::identity());
                LoopMeasurement { later, earlier, earlier_from_later, covariance, report }
            }
        };
        let report = measurement.report.clone();
        self.history.loops.push(measurement);
        Ok(report)
    }

    /// A placement of all chunks so far for who watches them come. It is estimated anew once a sixteenth more chunks are there; those since
    /// stand where they began, moved as the last estimated one was.
    pub fn provisional_placement(&mut self) -> Placement {
        let chunks = self.history.chunks.len();
        let is_recent = |e: &Estimate| chunks <= e.chunks.len() + e.chunks.len() / CHUNKS_PER_ESTIMATE;
        let estimate = match self.latest.take().filter(is_recent) {
            Some(latest) => latest,
            None => self.coupling.estimate(&self.history),
        };
        let placement = estimate::placement(self.mode, &self.history, estimate.extended(&self.history));
        self.latest = Some(estimate);
        placement
    }

    /// The placement from everything that was pushed.
    pub fn finish(self) -> Placement {
        estimate::placement(self.mode, &self.history, self.coupling.estimate(&self.history))
    }

    /// Bytes held, without allocator overhead.
    pub fn memory_bytes(&self) -> usize {
        let sparse: usize =
            self.history.chunks.iter().flat_map(|c| &c.views).map(|v| v.samples.bytes()).sum();
        let dense: usize = self.previous.sampled.iter().map(SampledView::bytes).sum();
        let full: usize = self.previous.full.iter().map(|v| v.depth.image().data().len() * 8).sum();
        sparse + dense + full + self.search.memory_bytes() + self.history.frames.memory_bytes()
    }

    /// The constraint to the last usable chunk, if both hold frames on which they agree.
    fn overlap(
        &self,
        sampled: &[SampledView],
        prediction: &GeometryPrediction,
        rejections: &mut Vec<RejectionReason>,
    ) -> Option<OverlapConstraint> {
        if self.history.chunks.is_empty() {
            return None;
        }
        let views = shared_views(self.previous.sampled.iter(), sampled.iter());
        if views.is_empty() {
            // Chunks in the world of their pose priors are connected by them: no overlap is missing.
            if prediction.frame != ChunkFrame::PriorWorld {
                rejections.push(RejectionReason::NoOverlap);
            }
            return None;
        }
        let shared = SharedFrames { sampled: &views, earlier: &self.previous.full, later: &prediction.views };
        let fit = self.coupling.fit_overlap(&shared, &self.history.config);
        if fit.is_none() {
            rejections.push(RejectionReason::NoOverlap);
        }
        fit.map(|fit| OverlapConstraint { earlier: self.previous.index, frames: views.len(), fit })
    }

    fn report(&self, chunk: &Chunk, pairs: &[CameraPair]) -> ChunkReport {
        let overlap = chunk.overlap.as_ref().map(|o| OverlapReport {
            with: self.history.chunks[o.earlier].id,
            frames: o.frames,
            earlier_from_later: o.fit.target_from_source,
            pairs: o.fit.pairs,
            inlier_ratio: o.fit.inlier_ratio,
            median_residual: o.fit.median_residual,
            log_scale_std: o.fit.log_scale_std(),
        });
        ChunkReport {
            chunk_id: chunk.id,
            status: chunk.status,
            world_from_chunk: chunk.initial,
            matched: pairs.len(),
            center_rms_m: chunk.initial.map_or(f64::NAN, |g| center_rms(&g, pairs)),
            overlap,
            log_scale_std: chunk.log_scale_std,
            rejections: chunk.rejections.clone(),
        }
    }
}
