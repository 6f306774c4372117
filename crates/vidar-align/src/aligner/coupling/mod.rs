//! How prediction and odometry are coupled: one file per coupling, behind the shared core of overlap constraints and loops.

mod coupled;
mod hybrid;
mod pose_conditioned;
mod pose_free;
mod streaming;

use super::chunk::{Chunk, OverlapConstraint};
use super::config::AlignerConfig;
use super::estimate::Estimate;
use super::history::{History, LoopMeasurement};
use super::landmarks::DepthCorrection;
use super::loops::checks;
use super::observation::FrameObservation;
use super::overlaps;
use super::pose_fit::CameraPair;
use super::report::{ChunkStatus, LoopRejection, RejectionReason};
use crate::overlap::{OverlapFit, SampledView};
use crate::streaming::Compat;
use serde::{Deserialize, Serialize};
use vidar_core::{GeometryPrediction, Sim3, ViewGeometry};

/// How prediction and odometry are coupled. All but `da3-streaming` measure overlaps and use landmarks and loops in the same
/// way, as far as these are given.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum CouplingMode {
    /// The reference: chunks chained by their overlaps, loops, Sim(3) graph. Not metric.
    #[serde(rename = "da3-streaming")]
    Da3Streaming,
    /// The same chain without the reference's quirks: the paper's PF column. Not metric.
    PoseFree,
    /// The paper's VIO column: poses are the odometry's, each chunk's depth is divided by its Umeyama scale.
    PoseConditioned,
    /// The same with true poses: the upper bound of the paper's tables.
    GroundTruth,
    /// The paper's decoupled hybrid: the pose-free chain, then one similarity onto the odometry's camera centres.
    Hybrid,
    /// Keyframes and chunk gauges estimated together from odometry, gravity, overlaps, landmarks and loops.
    #[default]
    Coupled,
}

impl CouplingMode {
    /// The name in files and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Da3Streaming => "da3-streaming",
            Self::PoseFree => "pose-free",
            Self::PoseConditioned => "pose-conditioned",
            Self::GroundTruth => "ground-truth",
            Self::Hybrid => "hybrid",
            Self::Coupled => "coupled",
        }
    }

    /// All couplings, in the order of the paper's tables.
    pub const ALL: [Self; 6] = [
        Self::Da3Streaming,
        Self::PoseFree,
        Self::PoseConditioned,
        Self::GroundTruth,
        Self::Hybrid,
        Self::Coupled,
    ];

    /// Whether chunks are connected by overlaps and loops; else each is placed by its pose priors alone.
    pub fn chains(self) -> bool {
        !matches!(self, Self::PoseConditioned | Self::GroundTruth)
    }

    /// Whether metric pose priors take part.
    pub fn uses_pose_priors(self) -> bool {
        !matches!(self, Self::Da3Streaming | Self::PoseFree)
    }

    /// What the coupling does.
    pub(super) fn coupling(self, compat: Compat) -> &'static dyn Coupling {
        match (self, compat) {
            (Self::Da3Streaming, Compat::Reference) => &streaming::StreamingReference,
            (Self::Da3Streaming, Compat::Off) => &streaming::Streaming,
            (Self::PoseFree, _) => &pose_free::PoseFree,
            (Self::PoseConditioned | Self::GroundTruth, _) => &pose_conditioned::PoseConditioned,
            (Self::Hybrid, _) => &hybrid::Hybrid,
            (Self::Coupled, _) => &coupled::Coupled,
        }
    }
}

impl std::fmt::Display for CouplingMode {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

/// Frames that the newest chunk shares with the last usable one.
pub(super) struct SharedFrames<'a> {
    /// (earlier, later) samples of the same frames.
    pub sampled: &'a [(&'a SampledView, &'a SampledView)],
    /// Full views of the earlier chunk, where the coupling keeps them.
    pub earlier: &'a [ViewGeometry],
    /// Full views of the newest chunk.
    pub later: &'a [ViewGeometry],
}

/// What differs between couplings. Defaults are those of a chain of chunks.
pub(super) trait Coupling: std::fmt::Debug + Sync {
    /// Scale and depth corrections from the landmarks of a chunk, where its frames have any.
    fn correct_depth(
        &self,
        prediction: &GeometryPrediction,
        frames: &[FrameObservation],
        config: &AlignerConfig,
    ) -> DepthCorrection {
        DepthCorrection::from_landmarks(prediction, frames, &config.landmarks)
    }

    /// Whether the full views of the last usable chunk are kept for [`Coupling::fit_overlap`].
    fn keeps_full_views(&self) -> bool {
        false
    }

    /// The similarity between two chunks from the frames that both hold; `None` where they do not agree.
    fn fit_overlap(&self, shared: &SharedFrames<'_>, config: &AlignerConfig) -> Option<OverlapFit> {
        let fit = overlaps::fit_robust(shared.sampled, config).ok();
        fit.filter(|fit| fit.inlier_ratio >= config.overlap.min_inlier_ratio)
    }

    /// Constraints to older chunks that hold some of a new chunk's frames: loops closed within an ordinary chunk.
    fn revisits(&self, history: &History, chunk: &Chunk) -> Vec<OverlapConstraint> {
        overlaps::revisits(history, chunk)
    }

    /// Whether initial places are in the world of the pose priors, so that they move with these.
    fn starts_at_priors(&self) -> bool {
        false
    }

    /// Sets status, initial place and σ of the scale of a new chunk; `pairs` are its cameras with pose priors.
    fn initialise(&self, history: &History, chunk: &mut Chunk, pairs: &[CameraPair]);

    /// Whether loops are looked for: where chunks are not connected to each other, a loop has nothing to close.
    fn closes_loops(&self) -> bool {
        true
    }

    /// Why a loop is rejected on its own evidence.
    fn check_loop(&self, history: &History, measurement: &LoopMeasurement) -> Option<LoopRejection> {
        checks::by_evidence(&history.config.loops, &measurement.report)
    }

    /// χ² of a loop against the pose priors, 7 degrees of freedom; `None` where there is nothing to compare with.
    fn loop_chi2(&self, history: &History, candidate: &checks::CheckedLoop<'_>) -> Option<f64> {
        checks::chi2(history, candidate)
    }

    /// All loops; those accepted one by one are then checked against each other.
    fn loops(&self, history: &History) -> Vec<LoopMeasurement> {
        checks::mutually_consistent(history)
    }

    /// Places of all chunks and keyframes from everything observed so far.
    fn estimate(&self, history: &History) -> Estimate;
}

/// Initialises a chunk by its overlap alone. A chunk that shares frames with the one before and disagrees with it there is
/// rejected; the first usable chunk is the origin.
pub(super) fn initialise_by_overlap(history: &History, chunk: &mut Chunk) {
    let last = history.last_usable();
    let shares_frames = last.is_some_and(|last| chunk.views.iter().any(|v| last.view(v.frame_id).is_some()));
    let disagrees = chunk.overlap.is_none() && shares_frames;
    chunk.status = if disagrees { ChunkStatus::Rejected } else { ChunkStatus::Chained };
    if disagrees {
        chunk.rejections.push(RejectionReason::InconsistentChunk);
    }
    chunk.initial = match chunk.overlap {
        Some(_) => history.initial_by_overlap(chunk),
        None if last.is_some() => None,
        None => Some(Sim3::IDENTITY),
    };
}
