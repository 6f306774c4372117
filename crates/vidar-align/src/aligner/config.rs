//! What a user may choose of the machine.

use crate::AlignError;
use crate::coupled::CoupledConfig;
use crate::landmark_scale::LandmarkConfig;
use crate::overlap::OverlapConfig;
use crate::streaming::{AlignMethod, Compat};
use serde::{Deserialize, Serialize};

/// How prediction and odometry are coupled.
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
    /// The word as it stands in files and on the command line.
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

    /// All of them, in the order of the paper's tables.
    pub const ALL: [Self; 6] = [
        Self::Da3Streaming,
        Self::PoseFree,
        Self::PoseConditioned,
        Self::GroundTruth,
        Self::Hybrid,
        Self::Coupled,
    ];

    /// Whether chunks are tied to each other by overlaps (else each is tied to its anchors alone).
    pub fn chains(self) -> bool {
        !matches!(self, Self::PoseConditioned | Self::GroundTruth)
    }

    /// Whether metric anchors take part at all.
    pub fn uses_pose_priors(self) -> bool {
        !matches!(self, Self::Da3Streaming | Self::PoseFree)
    }
}

impl std::fmt::Display for CouplingMode {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

/// What decides how chunks become one world.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct AlignerConfig {
    /// Largest RMS distance (m) between placed and anchored camera centres at which a chunk is still trusted.
    /// Raise it for fast vehicles with a coarse trajectory; lower it indoors.
    pub max_center_rms_m: f64,
    /// Whether `da3-streaming` follows the reference where it errs, number for number, on all pixels (`off`, `reference`).
    pub compat: Compat,
    /// What the reference chain estimates between neighbours: `sim3`, `se3` (metric models) or `scale-se3`.
    pub chain: AlignMethod,
    /// Scale ratios between metric neighbours outside this range count as failures (the paper's guard: 0.85 to 1.20).
    pub scale_range: [f64; 2],
    /// Overlaps of neighbouring chunks.
    pub overlap: OverlapConfig,
    /// Loops.
    pub loops: LoopsConfig,
    /// Landmarks of known depth.
    pub landmarks: LandmarkConfig,
    /// The coupled graph.
    pub graph: GraphWeights,
}

impl Default for AlignerConfig {
    fn default() -> Self {
        Self {
            max_center_rms_m: 0.5,
            compat: Compat::Off,
            chain: AlignMethod::Sim3,
            scale_range: [0.85, 1.20],
            overlap: OverlapConfig::default(),
            loops: LoopsConfig::default(),
            landmarks: LandmarkConfig::default(),
            graph: GraphWeights::default(),
        }
    }
}

/// How revisits are sought and believed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct LoopsConfig {
    /// Smallest inner product of two places' descriptors (0 to 1). The paper's τ_loop.
    pub min_similarity: f32,
    /// The same where places are told by the geometry model's tokens, less what all places have in common (−1 to 1).
    pub min_token_similarity: f32,
    /// Nearest places asked for per keyframe, after those near in time were left out (1 to 20).
    pub top_k: usize,
    /// Seconds that must lie between the two ends. Raise it for slow motion.
    pub min_gap_s: f64,
    /// Metres of travel that must lie between the two ends.
    pub min_travel_m: f64,
    /// Keyframes on each side of a loop's two ends that a loop chunk or a direct comparison takes (1 to 60).
    pub window: usize,
    /// Share of pairs that must agree within 5 % of depth, seen from both sides (0 to 1).
    pub min_inlier_ratio: f64,
    /// Largest χ² of a loop against what odometry and overlaps predict, 7 degrees of freedom (24.3: one true loop in a
    /// thousand is lost).
    pub max_chi2: f64,
    /// Most loops kept per chunk (1 or more).
    pub max_per_chunk: usize,
}

impl Default for LoopsConfig {
    fn default() -> Self {
        Self {
            min_similarity: 0.85,
            min_token_similarity: 0.6,
            top_k: 5,
            min_gap_s: 10.0,
            min_travel_m: 3.0,
            window: 10,
            min_inlier_ratio: 0.5,
            max_chi2: 24.3,
            max_per_chunk: 3,
        }
    }
}

/// How much each kind of evidence counts in the coupled graph, before it is judged.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct GraphWeights {
    /// Error of a camera centre within its chunk, as a share of the chunk's middle depth (0.003: good models indoors).
    pub attachment_depth_ratio: f64,
    /// Error of a camera's rotation within its chunk, degrees.
    pub attachment_rotation_deg: f64,
    /// Odometry without a covariance of its own: error per metre of step.
    pub odometry_per_metre: f64,
    /// Odometry without a covariance of its own: smallest error of a step, m.
    pub odometry_floor_m: f64,
    /// Odometry without a covariance of its own: error of rotation, degrees per square root of a second.
    pub odometry_rotation_deg: f64,
    /// Error of the direction of gravity, degrees.
    pub gravity_deg: f64,
    /// Change of a chunk's metric scale against its neighbour's beyond what the overlap says, standard deviation of ln.
    pub scale_walk: f64,
    /// Standard deviation of ln(scale) above which motion and landmarks count as not telling a chunk's scale.
    pub max_log_scale_std: f64,
    /// Mean χ² per degree of freedom of the odometry above which coupled poses are not believed and information flows one
    /// way only, from odometry to chunks.
    pub max_odometry_chi2: f64,
    /// Most iterations of each descent.
    pub max_iterations: usize,
}

impl Default for GraphWeights {
    fn default() -> Self {
        let solver = CoupledConfig::default();
        Self {
            attachment_depth_ratio: 0.005,
            attachment_rotation_deg: 0.45,
            odometry_per_metre: 0.01,
            odometry_floor_m: 0.001,
            odometry_rotation_deg: 0.1,
            gravity_deg: 0.4,
            scale_walk: 0.02,
            max_log_scale_std: 0.03,
            max_odometry_chi2: solver.max_odometry_chi2,
            max_iterations: solver.max_iterations,
        }
    }
}

impl AlignerConfig {
    /// Checks the ranges.
    ///
    /// # Errors
    /// [`AlignError::BadConfig`] and [`AlignError::OutOfRange`] name the key.
    pub fn validate(&self) -> Result<(), AlignError> {
        let (l, g, o) = (&self.loops, &self.graph, &self.overlap);
        let positive = [
            ("max_center_rms_m", self.max_center_rms_m),
            ("scale_range", self.scale_range[0]),
            ("scale_range", self.scale_range[1]),
            ("loops.max_chi2", l.max_chi2),
            ("graph.attachment_depth_ratio", g.attachment_depth_ratio),
            ("graph.attachment_rotation_deg", g.attachment_rotation_deg),
            ("graph.odometry_per_metre", g.odometry_per_metre),
            ("graph.odometry_floor_m", g.odometry_floor_m),
            ("graph.odometry_rotation_deg", g.odometry_rotation_deg),
            ("graph.gravity_deg", g.gravity_deg),
            ("graph.scale_walk", g.scale_walk),
            ("graph.max_log_scale_std", g.max_log_scale_std),
            ("graph.max_odometry_chi2", g.max_odometry_chi2),
        ];
        if let Some(&(key, found)) = positive.iter().find(|(_, v)| !(v.is_finite() && *v > 0.0)) {
            return Err(AlignError::BadConfig { key, found });
        }
        let ranges = [
            ("scale_range", self.scale_range[1], self.scale_range[0], f64::MAX),
            ("overlap.samples_per_view", o.samples_per_view as f64, 100.0, 20_000.0),
            ("overlap.max_pairs", o.max_pairs as f64, 1000.0, 1e6),
            ("overlap.min_pairs", o.min_pairs as f64, 3.0, 1e6),
            ("overlap.min_inlier_ratio", o.min_inlier_ratio, 0.0, 1.0),
            ("landmarks.model_noise", self.landmarks.model_noise, 0.005, 0.3),
            ("landmarks.view_jitter", self.landmarks.view_jitter, 0.0, 0.2),
            ("landmarks.max_relative_std", self.landmarks.max_relative_std, 0.01, 1.0),
            ("loops.min_similarity", f64::from(l.min_similarity), 0.0, 1.0),
            ("loops.min_token_similarity", f64::from(l.min_token_similarity), -1.0, 1.0),
            ("loops.top_k", l.top_k as f64, 1.0, 20.0),
            ("loops.min_gap_s", l.min_gap_s, 0.0, 1e6),
            ("loops.min_travel_m", l.min_travel_m, 0.0, 1e6),
            ("loops.window", l.window as f64, 1.0, 60.0),
            ("loops.min_inlier_ratio", l.min_inlier_ratio, 0.0, 1.0),
            ("loops.max_per_chunk", l.max_per_chunk as f64, 1.0, 1000.0),
            ("graph.max_iterations", g.max_iterations as f64, 1.0, 1000.0),
        ];
        let outside = ranges.iter().find(|(_, v, low, high)| !(v.is_finite() && *v >= *low && *v <= *high));
        match outside {
            Some(&(key, found, least, most)) => Err(AlignError::OutOfRange { key, found, least, most }),
            None => Ok(()),
        }
    }
}
