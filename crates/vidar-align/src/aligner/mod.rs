//! The machine that a run drives chunk by chunk: predictions in, one world out.
//!
//! ```text
//!              ┌─ tie to the chunk before (frames both hold)      ┌─ da3-streaming, pose-free: chain, loops, Sim(3) graph
//! push(chunk) ─┼─ fit to its anchors (centres, rotations)   ──▶  ─┼─ hybrid: the chain, then one similarity onto the anchors
//!              ├─ scale and fields of depth from landmarks        ├─ pose-conditioned, ground-truth: anchors, scale per chunk
//!              └─ descriptors ─▶ loop_candidates ─▶ push_loop     └─ coupled: one graph of all of it
//!                                                            placement_so_far / finish ─▶ Placement
//! ```
//!
//! It owns no thread, file or clock. Of a chunk it keeps poses, a few hundred depths per view and what was measured; of
//! the chunk before also some thousand depths per view (with [`Compat::Reference`](crate::streaming::Compat) its views
//! in full). What is wrong with a chunk is no error: the chunk is left out or held by its neighbours, the guard that acted
//! is counted, and [`Placement::rejections`] tells. Same input, same bits.
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
//! let mut machine = Aligner::new(CouplingMode::Coupled, &AlignerConfig::default())?;
//! machine.push(ChunkObservation { prediction: prediction.clone(), frames })?;
//! let world = machine.finish();
//! let metric = world.aligned_views(prediction, &[])?;
//! assert!((metric[0].depth().image()[(16, 12)] - 1.0).abs() < 1e-3);
//! # Ok::<(), vidar_align::AlignError>(())
//! ```

mod agreement;
mod anchored;
mod chain;
mod config;
mod coupled;
mod landmarks;
mod loops;
mod memory;
mod observation;
mod report;
mod tie;
mod views;
mod world;

pub use config::{AlignerConfig, CouplingMode, GraphWeights, LoopsConfig};
pub use loops::LoopCandidate;
pub use observation::{ChunkObservation, FrameObservation, PosePrior};
pub use report::{
    ChunkPlacement, ChunkReport, ChunkStatus, DriftReport, GraphReport, KeyframePlacement, LoopRejection,
    LoopReport, OverlapReport, Placement, RejectionCounts, RejectionReason, ViewPlacement,
};
pub use views::color_at_size;

use crate::AlignError;
use crate::overlap::{SampledView, shared_views};
use crate::place_recognition::PlaceIndex;
use crate::streaming::Compat;
use anchored::{Pair, PoseFit, center_rms, fit_about_rotations, robust_umeyama};
use landmarks::Landmarks;
use loops::{FrameMatch, MeasuredLoop};
use memory::{Chunk, Frames, OverlapConstraint, sampled_views};
use std::collections::{BTreeMap, BTreeSet};
use vidar_core::model::ChunkFrame;
use vidar_core::{FrameId, GeometryPrediction, LieGroup, Sim3, ViewGeometry};

/// The machine.
#[derive(Debug)]
pub struct Aligner {
    mode: CouplingMode,
    config: AlignerConfig,
    frames: Frames,
    chunks: Vec<Chunk>,
    previous: Previous,
    loops: Vec<MeasuredLoop>,
    places: PlaceIndex,
    known_places: BTreeSet<FrameId>,
    /// Best look-alike frames per (later, earlier) chunk.
    frame_matches: BTreeMap<(usize, usize), FrameMatch>,
}

/// Geometry of the last usable chunk.
#[derive(Debug, Default)]
struct Previous {
    chunk: usize,
    sampled: Vec<SampledView>,
    /// Only when the reference is followed number for number.
    full: Vec<ViewGeometry>,
}

/// Chunks this far apart or further share a frame only because it came back.
const NEIGHBOURS: usize = 3;
/// Rotations of a chunk this far (rad, RMS) from their anchors' say that one of the two is wrong.
const GROSS_ROTATION_RAD: f64 = 0.14;
/// Centres this far from their anchors, as a share of the chunk's own radius, say the same.
const GROSS_CENTERS: f64 = 0.2;
/// Below this (m) distances of centres say nothing.
const SMALL_CENTERS_M: f64 = 0.08;

impl Aligner {
    /// A machine that has seen nothing.
    ///
    /// # Errors
    /// What [`AlignerConfig::validate`] says.
    pub fn new(mode: CouplingMode, config: &AlignerConfig) -> Result<Self, AlignError> {
        config.validate()?;
        Ok(Self {
            mode,
            config: config.clone(),
            frames: Frames::default(),
            chunks: Vec::new(),
            previous: Previous::default(),
            loops: Vec::new(),
            places: PlaceIndex::default(),
            known_places: BTreeSet::new(),
            frame_matches: BTreeMap::new(),
        })
    }

    /// Compares places by what sets them apart from the average place ([`PlaceIndex::whitened`]), and takes those for alike
    /// that [`LoopsConfig::min_token_similarity`] says: for descriptors that are averages of a model's tokens.
    #[must_use]
    pub fn with_whitened_descriptors(mut self) -> Self {
        self.places = PlaceIndex::whitened();
        self
    }

    /// How prediction and odometry are coupled.
    pub fn mode(&self) -> CouplingMode {
        self.mode
    }

    /// Takes the next chunk.
    ///
    /// # Errors
    /// [`AlignError::RepeatedChunk`]. A chunk that is no good is no error: its report says so.
    pub fn push(&mut self, observation: ChunkObservation) -> Result<ChunkReport, AlignError> {
        let ChunkObservation { prediction, frames } = observation;
        if self.chunks.iter().any(|c| c.id == prediction.chunk_id) {
            return Err(AlignError::RepeatedChunk { chunk: prediction.chunk_id });
        }
        for frame in &frames {
            self.frames.learn(frame.frame_id, frame.time, frame.pose_prior.clone());
        }
        let landmarks = match self.mode {
            CouplingMode::Coupled => Landmarks::learn(&prediction, &frames, &self.config.landmarks),
            _ => Landmarks::default(),
        };
        let prediction = landmarks.corrected(prediction);
        let (mut views, sampled, dropped) = sampled_views(&prediction, &self.config);
        for view in &mut views {
            view.field = landmarks.fields.get(&view.frame_id).cloned();
        }
        let mut rejections = landmarks.rejections;
        rejections.extend(vec![RejectionReason::ViewNotFinite; dropped]);
        let tie = self.tie(&sampled, &prediction, &mut rejections);
        let mut chunk = Chunk {
            id: prediction.chunk_id,
            frame: prediction.frame,
            views,
            status: ChunkStatus::Chained,
            tie,
            revisits: Vec::new(),
            landmark_scale: landmarks.scale,
            rejections,
            first_guess: None,
            log_scale_std: f64::INFINITY,
            odometry_trusted: true,
        };
        let pairs = chunk.pairs(&self.frames);
        self.judge(&mut chunk, &pairs);
        // The reference knows no such chunks.
        if self.mode.chains() && self.mode != CouplingMode::Da3Streaming && chunk.is_usable() {
            chunk.revisits = self.revisits(&chunk);
        }
        let report = self.report(&chunk, &pairs);
        if chunk.is_usable() {
            let full = if self.config.compat == Compat::Reference { prediction.views } else { Vec::new() };
            self.previous = Previous { chunk: self.chunks.len(), sampled, full };
        }
        self.chunks.push(chunk);
        self.learn_places(&frames);
        Ok(report)
    }

    /// Where everything stands with what is known now.
    pub fn placement_so_far(&self) -> Placement {
        world::place(self)
    }

    /// The last word.
    pub fn finish(self) -> Placement {
        world::place(&self)
    }

    /// Bytes held, without allocator overhead.
    pub fn memory_bytes(&self) -> usize {
        let thin: usize = self.chunks.iter().flat_map(|c| &c.views).map(|v| v.thin.bytes()).sum();
        let dense: usize = self.previous.sampled.iter().map(SampledView::bytes).sum();
        let full: usize = self.previous.full.iter().map(|v| v.depth.image().data().len() * 8).sum();
        thin + dense
            + full
            + self.places.memory_bytes()
            + self.frames.len() * size_of::<memory::GraphKeyframe>()
    }

    /// The tie to the last usable chunk, if both hold frames and the two agree.
    fn tie(
        &self,
        sampled: &[SampledView],
        prediction: &GeometryPrediction,
        rejections: &mut Vec<RejectionReason>,
    ) -> Option<OverlapConstraint> {
        if self.chunks.is_empty() {
            return None;
        }
        let views = shared_views(self.previous.sampled.iter(), sampled.iter());
        if views.is_empty() {
            // Chunks in the anchors' own world are tied by the anchors: nothing is missing.
            if prediction.frame != ChunkFrame::PriorWorld {
                rejections.push(RejectionReason::NoOverlap);
            }
            return None;
        }
        let verbatim = self.config.compat == Compat::Reference && self.mode == CouplingMode::Da3Streaming;
        let fit = if verbatim {
            let earlier = &self.previous.full;
            let both: Vec<(&ViewGeometry, &ViewGeometry)> = prediction
                .views
                .iter()
                .filter_map(|l| earlier.iter().find(|e| e.frame_id == l.frame_id).map(|e| (e, l)))
                .collect();
            tie::verbatim(&both, &self.config)
        } else if matches!(self.mode, CouplingMode::Coupled) {
            tie::robust(&views, &self.config)
        } else {
            tie::reference(&views, &self.config)
        };
        // The reference takes every fit for true.
        let believed = |fit: &crate::overlap::OverlapFit| {
            verbatim || fit.inlier_ratio >= self.config.overlap.min_inlier_ratio
        };
        match fit {
            Some(fit) if believed(&fit) => {
                Some(OverlapConstraint { to: self.previous.chunk, frames: views.len(), fit })
            }
            _ => {
                rejections.push(RejectionReason::NoOverlap);
                None
            }
        }
    }

    /// Older chunks that hold some of the chunk's frames: a loop closed within an ordinary chunk.
    fn revisits(&self, chunk: &Chunk) -> Vec<OverlapConstraint> {
        // Next neighbours share frames when overlaps are long; their chain of ties says the same already.
        let distant = self.chunks.len().saturating_sub(NEIGHBOURS - 1);
        let tied = chunk.tie.as_ref().map(|t| t.to);
        let older = self.chunks.iter().take(distant).enumerate();
        let older = older.filter(|(k, c)| Some(*k) != tied && c.is_usable());
        older
            .filter_map(|(k, c)| tie::revisit(&c.views, &chunk.views, k, &self.config))
            .filter(|t| t.fit.inlier_ratio > self.config.loops.min_inlier_ratio)
            .collect()
    }

    /// Decides how a chunk stands and where it goes first.
    fn judge(&self, chunk: &mut Chunk, pairs: &[Pair]) {
        if chunk.views.is_empty() {
            chunk.status = ChunkStatus::Rejected;
            chunk.rejections.push(RejectionReason::InconsistentChunk);
            return;
        }
        match self.mode {
            CouplingMode::Da3Streaming | CouplingMode::PoseFree => self.judge_unanchored(chunk),
            CouplingMode::PoseConditioned | CouplingMode::GroundTruth => self.judge_conditioned(chunk, pairs),
            CouplingMode::Hybrid => self.judge_unanchored(chunk),
            CouplingMode::Coupled => self.judge_coupled(chunk, pairs),
        }
    }

    /// Without anchors only the neighbour can vouch for a chunk. The first one vouches for itself.
    fn judge_unanchored(&self, chunk: &mut Chunk) {
        let disagrees = chunk.tie.is_none() && self.shares_frames(chunk);
        chunk.status = if disagrees { ChunkStatus::Rejected } else { ChunkStatus::Chained };
        if disagrees {
            chunk.rejections.push(RejectionReason::InconsistentChunk);
        }
        chunk.first_guess = match &chunk.tie {
            Some(tie) => self.chunks[tie.to].first_guess.map(|g| g * tie.fit.target_from_source),
            None if self.chunks.iter().any(Chunk::is_usable) => None,
            None => Some(Sim3::IDENTITY),
        };
    }

    fn shares_frames(&self, chunk: &Chunk) -> bool {
        chunk.views.iter().any(|v| self.previous.sampled.iter().any(|s| s.frame_id == v.frame_id))
    }

    /// The paper's pose-conditioned coupling: `D ← D / s*`, rejections.
    fn judge_conditioned(&self, chunk: &mut Chunk, pairs: &[Pair]) {
        if pairs.is_empty() {
            chunk.status = ChunkStatus::Unplaced;
            return;
        }
        let fitted = match chunk.frame {
            ChunkFrame::PriorWorld => Ok((Sim3::IDENTITY, ChunkStatus::PriorWorld)),
            ChunkFrame::ModelNative => {
                robust_umeyama(pairs, u64::from(chunk.id.0)).map(|s| (s, ChunkStatus::Fitted))
            }
        };
        let (mut place, status) = fitted.unwrap_or((Sim3::IDENTITY, ChunkStatus::RankDeficient));
        chunk.status = status;
        if status == ChunkStatus::RankDeficient {
            chunk.rejections.push(RejectionReason::RankDeficient);
        }
        if let Some(guarded) = self.clamped_scale(chunk, &place) {
            // In the anchors' own world the scale is 1 already: what the overlap says instead is what is not believed.
            if chunk.frame != ChunkFrame::PriorWorld {
                place = rescaled_about_centers(&place, guarded, pairs);
            }
            chunk.rejections.push(RejectionReason::ScaleOutOfRange);
        }
        if status.is_usable() && center_rms(&place, pairs) > self.config.max_center_rms_m {
            chunk.status = ChunkStatus::Inconsistent;
        }
        chunk.log_scale_std = match chunk.frame {
            ChunkFrame::PriorWorld => chunk.prior_world_std(),
            ChunkFrame::ModelNative => {
                self.pose_fit(chunk, pairs, place.scale).map_or(f64::INFINITY, |f| f.log_scale_std)
            }
        };
        chunk.first_guess = Some(place);
    }

    /// The scale that makes the step from the chunk before equal to what their overlap says, where the fitted one leaves
    /// [0.85, 1.20] of it: between metric chunks the ratio is 1 (the paper's clamp).
    fn clamped_scale(&self, chunk: &Chunk, place: &Sim3) -> Option<f64> {
        let tie = chunk.tie.as_ref()?;
        let before = self.chunks[tie.to].first_guess.filter(|_| chunk.status.is_usable())?;
        let expected = before.scale * tie.fit.target_from_source.scale;
        let ratio = place.scale / expected;
        let [low, high] = self.config.scale_range;
        (!(ratio >= low && ratio <= high)).then_some(expected)
    }

    fn pose_fit(&self, chunk: &Chunk, pairs: &[Pair], scale_hint: f64) -> Option<PoseFit> {
        let floor = self.config.graph.attachment_depth_ratio * chunk.median_depth() * scale_hint;
        fit_about_rotations(pairs, scale_hint, floor)
    }

    /// Anchors, neighbour and landmarks vouch for a chunk; one that contradicts all is left out.
    fn judge_coupled(&self, chunk: &mut Chunk, pairs: &[Pair]) {
        let before = chunk
            .tie
            .as_ref()
            .and_then(|t| self.chunks[t.to].first_guess.map(|g| g * t.fit.target_from_source));
        let hint = before.map_or(1.0, |b| b.scale);
        let fit = match chunk.frame {
            ChunkFrame::PriorWorld => self.pose_fit(chunk, pairs, 1.0),
            ChunkFrame::ModelNative => self.pose_fit(chunk, pairs, hint),
        };
        let Some(fit) = fit else {
            self.judge_unanchored(chunk);
            return;
        };
        let fit = self.with_landmarks(fit, chunk, pairs);
        chunk.log_scale_std = fit.log_scale_std;
        let gross = is_gross(&fit, pairs.len(), self.config.max_center_rms_m);
        (chunk.status, chunk.first_guess) = match (gross, before) {
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

    /// The same place with the scale that centres and landmarks tell together, by inverse variance.
    fn with_landmarks(&self, fit: PoseFit, chunk: &Chunk, pairs: &[Pair]) -> PoseFit {
        let Some(landmarks) = chunk.landmark_scale else { return fit };
        let information = [fit.log_scale_std.powi(-2), landmarks.std.powi(-2)];
        let sum = information[0] + information[1];
        let log =
            (information[0] * fit.world_from_chunk.scale.ln() + information[1] * landmarks.log_scale) / sum;
        let world_from_chunk = rescaled_about_centers(&fit.world_from_chunk, log.exp(), pairs);
        let center_rms_m = center_rms(&world_from_chunk, pairs);
        PoseFit {
            world_from_chunk,
            center_rms_m,
            log_scale_std: sum.powf(-0.5).hypot(landmarks.shared_std),
            ..fit
        }
    }

    fn report(&self, chunk: &Chunk, pairs: &[Pair]) -> ChunkReport {
        let overlap = chunk.tie.as_ref().map(|t| OverlapReport {
            with: self.chunks[t.to].id,
            frames: t.frames,
            earlier_from_later: t.fit.target_from_source,
            pairs: t.fit.pairs,
            inlier_ratio: t.fit.inlier_ratio,
            median_residual: t.fit.median_residual,
            log_scale_std: t.fit.log_scale_std(),
        });
        ChunkReport {
            chunk_id: chunk.id,
            status: chunk.status,
            world_from_chunk: chunk.first_guess,
            matched: pairs.len(),
            center_rms_m: chunk.first_guess.map_or(f64::NAN, |g| center_rms(&g, pairs)),
            overlap,
            log_scale_std: chunk.log_scale_std,
            rejections: chunk.rejections.clone(),
        }
    }
}

/// Whether a chunk's cameras and their anchors cannot both be right.
fn is_gross(fit: &PoseFit, pairs: usize, max_center_rms_m: f64) -> bool {
    if pairs < 3 {
        return false;
    }
    let limit = (GROSS_CENTERS * fit.radius_m).max(SMALL_CENTERS_M).min(max_center_rms_m);
    fit.rotation_rms_rad > GROSS_ROTATION_RAD || fit.center_rms_m > limit
}

/// The same place with another scale, the mean of the cameras kept.
fn rescaled_about_centers(place: &Sim3, scale: f64, pairs: &[Pair]) -> Sim3 {
    let n = pairs.len().max(1) as f64;
    let mean = pairs.iter().map(|p| p.chunk_from_camera.translation).sum::<nalgebra::Vector3<f64>>() / n;
    let kept = place.act(&mean);
    let moved = Sim3 { scale, ..*place };
    Sim3 { translation: place.translation + kept - moved.act(&mean), ..moved }
}
