//! Configuration of the aligner.

use crate::AlignError;
use crate::coupled::CoupledConfig;
use crate::landmark_scale::LandmarkConfig;
use crate::overlap::OverlapConfig;
use crate::streaming::{AlignMethod, Compat};
use serde::{Deserialize, Serialize};

/// Configuration of the alignment.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct AlignerConfig {
    /// Largest RMS distance (m) of placed camera centres from their pose priors at which a chunk is still accepted.
    /// Raise it for fast vehicles with a coarse trajectory; lower it indoors.
    pub max_center_rms_m: f64,
    /// Whether `da3-streaming` follows the reference where it errs, number for number, on all pixels (`off`, `reference`).
    pub compat: Compat,
    /// What the reference chain estimates between neighbours: `sim3`, `se3` (metric models) or `scale-se3`.
    pub chain: AlignMethod,
    /// Scale ratios between metric neighbours outside this range are taken as 1 (the paper: 0.85 to 1.20).
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

/// How loops are found and accepted.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct LoopsConfig {
    /// Smallest inner product of two places' descriptors (0 to 1). The paper's τ_loop.
    pub min_similarity: f32,
    /// The same for descriptors of the geometry model's tokens, after whitening (−1 to 1).
    pub min_token_similarity: f32,
    /// Nearest places asked for per keyframe, after those near in time were left out (1 to 20).
    pub top_k: usize,
    /// Seconds that must lie between the two ends. Raise it for slow motion.
    pub min_gap_s: f64,
    /// Metres of travel that must lie between the two ends.
    pub min_travel_m: f64,
    /// Keyframes on each side of a loop's two ends that a loop chunk or a direct comparison takes (1 to 60).
    pub window: usize,
    /// Share of pairs that must agree within 5 % of depth, from both sides (0 to 1).
    pub min_inlier_ratio: f64,
    /// Largest χ² of a loop against odometry and overlaps, 7 degrees of freedom (24.3: one true loop in a thousand is lost).
    pub max_chi2: f64,
    /// Most loops measured per chunk (1 or more).
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

/// Standard deviations of the coupled graph's factors.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct GraphWeights {
    /// σ of a camera centre within its chunk, as a share of the chunk's median depth (0.003: good models indoors).
    pub attachment_depth_ratio: f64,
    /// σ of a camera's rotation within its chunk, degrees.
    pub attachment_rotation_deg: f64,
    /// Odometry without a covariance of its own: σ per metre of step.
    pub odometry_per_metre: f64,
    /// Odometry without a covariance of its own: least σ of a step, m.
    pub odometry_floor_m: f64,
    /// Odometry without a covariance of its own: σ of rotation, degrees per square root of a second.
    pub odometry_rotation_deg: f64,
    /// σ of the direction of gravity, degrees.
    pub gravity_deg: f64,
    /// σ of the random walk of ln(scale) from chunk to chunk beyond the scale step of their overlap.
    pub scale_walk: f64,
    /// σ of ln(scale) above which a chunk's scale counts as not observable from motion and landmarks.
    pub max_log_scale_std: f64,
    /// Mean χ² per degree of freedom of the odometry above which coupled poses are rejected and information flows one way
    /// only, from odometry to chunks.
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
