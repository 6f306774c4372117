//! What the machine says: of a chunk when it comes, of a loop when it is judged, of the world when asked.

use super::CouplingMode;
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

/// Something went wrong and was kept from spreading.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RejectionReason {
    /// A metric scale ratio left its range and was taken as 1 (the paper's clamp).
    ScaleOutOfRange,
    /// Camera centres fix no similarity (a line, a place): identity in the paper's modes, rotation from rotations in `coupled`.
    RankDeficient,
    /// A view's pose or all of its depth is not a number; the view was left out.
    ViewNotFinite,
    /// A chunk has no usable view, or contradicts its neighbour and its anchors; it was left out.
    InconsistentChunk,
    /// A chunk shares no usable frame with those before.
    NoOverlap,
    /// Neither motion nor landmarks tell a chunk's scale; overlap and a random-walk prior hold it.
    ScaleUnobservable,
    /// Odometry contradicts chunks that agree with each other; it was loosened there.
    OdometryDownweighted,
    /// Coupled poses would have bent the odometry beyond belief; information flowed one way only.
    OneWay,
    /// A loop was refused.
    LoopRejected,
    /// A fitted depth field did not improve held-out landmarks; only the view's own scale was kept.
    DepthFieldRejected,
    /// Landmarks contradict the depth of a chunk whose poses were given; the depth was brought to them.
    DepthRescaled,
    /// The graph had no answer; chunks stay where anchors and overlaps put them.
    GraphFailed,
}

/// How often each guard acted.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct RejectionCounts(BTreeMap<RejectionReason, usize>);

impl RejectionCounts {
    /// How often one acted.
    pub fn of(&self, guard: RejectionReason) -> usize {
        self.0.get(&guard).copied().unwrap_or(0)
    }

    /// Those that acted, in order.
    pub fn iter(&self) -> impl Iterator<Item = (RejectionReason, usize)> + '_ {
        self.0.iter().map(|(g, n)| (*g, *n))
    }

    /// Whether none acted.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    pub(crate) fn add(&mut self, guard: RejectionReason) {
        *self.0.entry(guard).or_insert(0) += 1;
    }

    pub(crate) fn extend(&mut self, rejections: &[RejectionReason]) {
        rejections.iter().for_each(|g| self.add(*g));
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
    /// Middle residual, share of depth.
    pub median_residual: f64,
    /// Standard deviation of the logarithm of the scale between them.
    pub log_scale_std: f64,
}

/// What is known of a chunk as soon as it is there.
#[derive(Clone, Debug, PartialEq)]
pub struct ChunkReport {
    /// Which chunk.
    pub chunk_id: ChunkId,
    /// How it stands.
    pub status: ChunkStatus,
    /// Where it would be placed now; later chunks and loops may move it. `None` when nothing places it.
    pub world_from_chunk: Option<Sim3>,
    /// Views whose camera has a metric anchor.
    pub matched: usize,
    /// RMS distance of placed and anchored camera centres, m; NaN without anchors.
    pub center_rms_m: f64,
    /// Agreement with the chunk before.
    pub overlap: Option<OverlapReport>,
    /// Standard deviation of ln(metres per unit) from this chunk's own motion and landmarks; infinite when neither tells.
    pub log_scale_std: f64,
    /// Guards that acted.
    pub rejections: Vec<RejectionReason>,
}

/// A chunk's place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ChunkPlacement {
    /// Which chunk.
    pub chunk_id: ChunkId,
    /// How it stands; unusable chunks own no view.
    pub status: ChunkStatus,
    /// Maps chunk coordinates and units to the world and metres (to the first chunk's in modes that are not metric).
    pub world_from_chunk: Sim3,
    /// Standard deviation of ln(scale): how far to trust it. Infinite where nothing metric tells.
    pub log_scale_std: f64,
}

/// A view's place.
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

/// What became of a supposed revisit.
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
    /// χ² against the prediction, 7 degrees of freedom; NaN where none could be made.
    pub chi2: f64,
    /// Why it was refused; `None` = accepted.
    pub rejection: Option<LoopRejection>,
}

/// Why a loop is not believed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum LoopRejection {
    /// No geometry could be compared.
    NoGeometry,
    /// Too few points agree on one side.
    FewInliers,
    /// It contradicts odometry and overlaps beyond their covariance.
    Chi2TooLarge,
    /// It contradicts the other loops.
    Inconsistent,
    /// The graph let it go.
    GraphOutlier,
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

/// How far chain and anchors part: what a metric map would lose without the other.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct DriftReport {
    /// RMS distance of placed camera centres from their anchors, m.
    pub center_rms_m: f64,
    /// Largest such distance, m.
    pub center_max_m: f64,
    /// Standard deviation over chunks of the scale step between neighbours against their overlap, ln.
    pub scale_step_std: f64,
    /// Anchored camera centres compared.
    pub matched: usize,
}

/// One world.
#[derive(Clone, Debug, PartialEq)]
pub struct Placement {
    /// How it was made.
    pub mode: CouplingMode,
    /// Whether lengths are metres.
    pub is_metric: bool,
    /// Every chunk, in the order they came.
    pub chunks: Vec<ChunkPlacement>,
    /// Every view that a usable chunk holds, once, by frame.
    pub views: Vec<ViewPlacement>,
    /// Every frame whose pose is known, by frame: views and anchored frames without geometry.
    pub keyframes: Vec<KeyframePlacement>,
    /// Loops judged.
    pub loops: Vec<LoopReport>,
    /// Guards that acted.
    pub rejections: RejectionCounts,
    /// The graph, in mode `coupled`.
    pub graph: Option<GraphReport>,
    /// Chain against anchors.
    pub drift: DriftReport,
}

impl Placement {
    /// Where a chunk stands.
    pub fn chunk(&self, id: ChunkId) -> Option<&ChunkPlacement> {
        self.chunks.iter().find(|c| c.chunk_id == id)
    }

    /// Where a view stands.
    pub fn view(&self, frame: FrameId) -> Option<&ViewPlacement> {
        self.views.binary_search_by_key(&frame, |v| v.frame_id).ok().map(|i| &self.views[i])
    }
}
