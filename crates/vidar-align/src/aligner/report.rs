//! Reports: of a chunk when it is pushed, of a loop when it is measured, of the whole alignment.

use super::coupling::CouplingMode;
use crate::coupled::InformationFlow;
use crate::depth_field::DepthField;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use vidar_core::{ChunkId, FrameId, Se3, Sim3};

/// How a chunk stands in the map.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ChunkStatus {
    /// The prediction is in the world of its pose priors; nothing was fitted.
    PriorWorld,
    /// A similarity onto the pose priors was fitted and agrees with them.
    Fitted,
    /// The camera centres do not determine a similarity (collinear, or fewer than three): identity (section III-F).
    RankDeficient,
    /// The fitted similarity leaves camera centres farther from their pose priors than `max_center_rms_m`.
    Inconsistent,
    /// Placed by overlap constraints; its own cameras have no pose prior, or one that was rejected.
    Chained,
    /// The prediction contradicts its neighbour and its pose priors, or holds no finite view: left out of the map.
    Rejected,
    /// Neither a pose prior nor a neighbour determines its place: left out of the map.
    Unplaced,
}

impl ChunkStatus {
    /// Whether the chunk may enter the map.
    pub fn is_usable(self) -> bool {
        matches!(self, Self::PriorWorld | Self::Fitted | Self::Chained)
    }

    /// A clause for messages.
    pub fn description(self) -> &'static str {
        match self {
            Self::PriorWorld => "predicted in the world of its pose priors",
            Self::Fitted => "fitted to its pose priors",
            Self::RankDeficient => "its cameras are collinear or too few to determine a similarity",
            Self::Inconsistent => "its cameras do not fit their pose priors",
            Self::Chained => "placed by its neighbours",
            Self::Rejected => "it contradicts its neighbour and its pose priors, or holds no finite view",
            Self::Unplaced => "neither a pose prior nor a neighbour determines its place",
        }
    }
}

/// Why a measurement, a chunk or an estimate was rejected, replaced or down-weighted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RejectionReason {
    /// A metric scale ratio left its range and was taken as 1 (the paper's clamp).
    ScaleOutOfRange,
    /// Camera centres determine no similarity (collinear, or coincident): identity in the paper's modes, rotation from
    /// rotations in `coupled`.
    RankDeficient,
    /// A view's pose or all of its depth is not finite; the view was left out.
    ViewNotFinite,
    /// A chunk has no usable view, or contradicts its neighbour and its pose priors; it was left out.
    InconsistentChunk,
    /// A chunk has no frame in common with the chunk before on which both agree.
    NoOverlap,
    /// Neither motion nor landmarks determine a chunk's scale; overlap and a random-walk prior hold it.
    ScaleUnobservable,
    /// Odometry contradicts chunks that agree with each other; it was down-weighted there.
    OdometryDownweighted,
    /// The coupled poses exceeded [`max_odometry_chi2`](super::GraphWeights::max_odometry_chi2); information flowed one way only.
    OneWay,
    /// A loop was rejected.
    LoopRejected,
    /// A fitted depth field did not improve held-out landmarks; only the view's own scale was kept.
    DepthFieldRejected,
    /// Landmarks contradict the depth of a chunk whose poses were given; the depth was scaled to them.
    DepthRescaled,
    /// A covariance is not positive definite; the constraint was left out of the graph.
    SingularCovariance,
    /// A graph has no solution ([`Placement::graph_failures`]); chunks stay at their initial places.
    GraphFailed,
}

/// How often each reason applied.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct RejectionCounts(BTreeMap<RejectionReason, usize>);

impl RejectionCounts {
    /// How often one applied.
    pub fn of(&self, reason: RejectionReason) -> usize {
        self.0.get(&reason).copied().unwrap_or(0)
    }

    /// The reasons that applied, in order.
    pub fn iter(&self) -> impl Iterator<Item = (RejectionReason, usize)> + '_ {
        self.0.iter().map(|(g, n)| (*g, *n))
    }

    /// Whether none applied.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    pub(crate) fn add(&mut self, reason: RejectionReason) {
        *self.0.entry(reason).or_insert(0) += 1;
    }

    pub(crate) fn extend(&mut self, reasons: &[RejectionReason]) {
        reasons.iter().for_each(|g| self.add(*g));
    }
}

/// How two chunks agree where they overlap.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OverlapReport {
    /// The earlier chunk.
    pub with: ChunkId,
    /// Frames both hold.
    pub frames: usize,
    /// Maps the later chunk to the earlier one.
    pub earlier_from_later: Sim3,
    /// Point pairs.
    pub pairs: usize,
    /// Share of them within 5 % of depth.
    pub inlier_ratio: f64,
    /// Median residual, share of depth.
    pub median_residual: f64,
    /// Standard deviation of the logarithm of the scale between them.
    pub log_scale_std: f64,
}

/// A chunk as it was pushed.
#[derive(Clone, Debug, PartialEq)]
pub struct ChunkReport {
    /// Which chunk.
    pub chunk_id: ChunkId,
    /// How it stands.
    pub status: ChunkStatus,
    /// Its initial place; later chunks and loops may move it. `None` when nothing determines it.
    pub world_from_chunk: Option<Sim3>,
    /// Views whose camera has a pose prior.
    pub matched: usize,
    /// RMS distance of placed camera centres from their pose priors, m; NaN without any.
    pub center_rms_m: f64,
    /// Agreement with the chunk before.
    pub overlap: Option<OverlapReport>,
    /// σ of ln(metres per unit) from this chunk's own motion and landmarks; infinite when neither determines it.
    pub log_scale_std: f64,
    /// Reasons that applied.
    pub rejections: Vec<RejectionReason>,
}

/// A chunk in the world.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ChunkPlacement {
    /// Which chunk.
    pub chunk_id: ChunkId,
    /// How it stands; unusable chunks own no view.
    pub status: ChunkStatus,
    /// Maps chunk coordinates and units to the world and metres (to the first chunk's in modes that are not metric).
    pub world_from_chunk: Sim3,
    /// σ of ln(scale); infinite where nothing metric determines it.
    pub log_scale_std: f64,
}

/// A view in the world.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewPlacement {
    /// Which frame.
    pub frame_id: FrameId,
    /// The chunk whose depth is to be used for it: the later of neighbours that hold it, if it is usable. A frame that comes
    /// back in a distant chunk keeps its owner.
    pub owner: ChunkId,
    /// Its pose, m.
    pub world_from_camera: Se3,
    /// Metres per unit of the owner's depth.
    pub metres_per_unit: f64,
    /// Correction of the depth across the image, where landmarks support one.
    pub field: Option<DepthField>,
}

/// A keyframe's pose, whether or not it has geometry.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KeyframePlacement {
    /// Which frame.
    pub frame_id: FrameId,
    /// Its pose, m.
    pub world_from_camera: Se3,
}

/// A measured loop.
#[derive(Clone, Debug, PartialEq)]
pub struct LoopReport {
    /// The later chunk.
    pub later: ChunkId,
    /// The earlier chunk.
    pub earlier: ChunkId,
    /// Inner product of the descriptors.
    pub similarity: f32,
    /// Measured transform, if it could be.
    pub earlier_from_later: Option<Sim3>,
    /// Smallest share of agreeing pairs on either side.
    pub inlier_ratio: f64,
    /// χ² against the pose priors, 7 degrees of freedom; `None` where there are none to compare with, NaN where the covariance
    /// is singular.
    pub chi2: Option<f64>,
    /// Why it was rejected; `None` = accepted.
    pub rejection: Option<LoopRejection>,
}

/// Why a loop was rejected.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum LoopRejection {
    /// The two sides have too few points in common.
    NoGeometry,
    /// The points of one side determine no similarity.
    Degenerate,
    /// Too few points agree on one side.
    FewInliers,
    /// χ² against odometry and overlaps exceeds [`max_chi2`](super::LoopsConfig::max_chi2), or is not a number.
    Chi2TooLarge,
    /// It contradicts the other loops.
    Inconsistent,
    /// The robust kernel left it no weight in the graph.
    GraphOutlier,
}

/// A pose graph without a solution: its chunks stay at their initial places.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GraphFailure {
    /// The first chunk of the graph.
    pub first_chunk: ChunkId,
    /// The solver's error.
    pub reason: String,
}

/// How the coupled graph ended.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GraphReport {
    /// Which way information flowed.
    pub flow: InformationFlow,
    /// Keyframes and chunks estimated.
    pub keyframes: usize,
    /// Chunks estimated.
    pub chunks: usize,
    /// Iterations.
    pub iterations: usize,
    /// Robust cost at start and end.
    pub cost: [f64; 2],
    /// Mean χ² per degree of freedom of the odometry.
    pub odometry_chi2: f64,
}

/// Distance between the placed chunks and the pose priors.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DriftReport {
    /// RMS distance of placed camera centres from their pose priors, m.
    pub center_rms_m: f64,
    /// Largest such distance, m.
    pub center_max_m: f64,
    /// Standard deviation over chunks of the scale step between neighbours against their overlap, ln.
    pub scale_step_std: f64,
    /// Camera centres compared.
    pub matched: usize,
    /// Of chunks that were predicted in the world of their pose priors: how far the images moved them from those.
    pub pose_correction: Option<PoseCorrection>,
}

/// How far the images move cameras from the poses that chunks were given.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseCorrection {
    /// RMS distance of the camera centres of the median chunk, m.
    pub center_rms_m: f64,
    /// RMS angle of its rotations, rad.
    pub rotation_rms_rad: f64,
    /// The median over chunks of that distance as a share of the RMS distance of the chunk's given centres from their mean. It is what
    /// images and poses say differently of the chunk's size: errors within a chunk are correlated, so n centres know no more of it than
    /// one pair.
    pub center_share: f64,
    /// σ of ln(size of the map) by that: chunks are taken to err independently of each other. A lower bound: images do not show a scale that
    /// is wrong in all of them.
    pub log_scale_std: f64,
}

/// The result of the alignment: chunks, views and keyframes in one world.
#[derive(Clone, Debug, PartialEq)]
pub struct Placement {
    /// How it was estimated.
    pub mode: CouplingMode,
    /// Whether lengths are metres.
    pub is_metric: bool,
    /// Every chunk, in the order they came.
    pub chunks: Vec<ChunkPlacement>,
    /// Every view that a usable chunk holds, once, by frame.
    pub views: Vec<ViewPlacement>,
    /// Every frame whose pose is estimated, by frame: views, and frames with a pose prior but no geometry.
    pub keyframes: Vec<KeyframePlacement>,
    /// Loops measured.
    pub loops: Vec<LoopReport>,
    /// How often something was rejected, by reason.
    pub rejections: RejectionCounts,
    /// The graph, in mode `coupled`.
    pub graph: Option<GraphReport>,
    /// Graphs that have no solution, with the reason.
    pub graph_failures: Vec<GraphFailure>,
    /// Placed chunks against pose priors.
    pub drift: DriftReport,
}

impl Placement {
    /// A chunk's place.
    pub fn chunk(&self, id: ChunkId) -> Option<&ChunkPlacement> {
        self.chunks.iter().find(|c| c.chunk_id == id)
    }

    /// A view's place.
    pub fn view(&self, frame: FrameId) -> Option<&ViewPlacement> {
        self.views.binary_search_by_key(&frame, |v| v.frame_id).ok().map(|i| &self.views[i])
    }
}
