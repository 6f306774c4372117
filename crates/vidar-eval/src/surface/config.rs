//! Settings of surface evaluation.

use crate::error::EvalError;
use serde::{Deserialize, Serialize};

/// Settings of surface evaluation; the defaults are the paper's protocol.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SurfaceEvalConfig {
    /// Distances τ below which (strictly) a point counts as correct, metres, each above 0. ΔF is taken at the largest.
    pub thresholds_m: Vec<f64>,
    /// Scales between which the native placement's refinement is accepted.
    pub scale_bounds: ScaleBounds,
    /// What to do when the refinement is rejected: its scale is out of bounds, or the fit became worse.
    pub on_rejection: OnRejection,
    /// The refinement.
    pub icp: IcpConfig,
    /// Put one point (their mean) in each voxel of this edge in both clouds before evaluation, metres, above 0.
    /// Absent: evaluate the points as given. Use it when sampling is uneven; keep it well below the smallest threshold.
    pub voxel_size_m: Option<f64>,
    /// Leave out estimated points further than this outside the reference's bounding box, metres, at least 0.
    /// Absent: evaluate all. Use it when the reference covers a part of what was mapped.
    pub crop_margin_m: Option<f64>,
    /// Return the error of every given point, for colouring.
    #[serde(skip)] // for callers that draw the errors; not a user setting
    pub keep_point_errors: bool,
}

/// Scales between which a refinement is accepted, ends included; metres of truth per unit of the estimate.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ScaleBounds {
    /// Smallest, above 0, at most 1.
    pub min: f64,
    /// Largest, at least 1.
    pub max: f64,
}

/// What to do when the refinement is rejected.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum OnRejection {
    /// Keep the SE(3) fit as it is: the paper's protocol.
    KeepRigidFit,
    /// Refine the SE(3) fit by ICP without scale.
    RefineRigid,
}

/// Point-to-point ICP with trimming (Chetverikov et al., ICPR 2002), Umeyama's closed form at each step.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct IcpConfig {
    /// Most steps, at least 1.
    pub max_iterations: usize,
    /// Share of pairs kept, the nearest ones, above 0 and at most 1. Lower it when much of the estimate has no
    /// counterpart in the reference.
    pub keep_ratio: f64,
    /// Points of the estimate that take part, spread evenly over it, at least 100.
    pub max_points: usize,
    /// Stop when a step moves the points by less than this (RMS), metres, at least 0.
    pub tolerance_m: f64,
}

impl Default for SurfaceEvalConfig {
    fn default() -> Self {
        Self {
            thresholds_m: vec![0.05, 0.10],
            scale_bounds: ScaleBounds::default(),
            on_rejection: OnRejection::KeepRigidFit,
            icp: IcpConfig::default(),
            voxel_size_m: None,
            crop_margin_m: None,
            keep_point_errors: false,
        }
    }
}

impl Default for ScaleBounds {
    fn default() -> Self {
        Self { min: 0.85, max: 1.15 }
    }
}

impl ScaleBounds {
    /// Whether `scale` is within the bounds, ends included.
    pub fn contains(&self, scale: f64) -> bool {
        (self.min..=self.max).contains(&scale)
    }
}

impl Default for IcpConfig {
    fn default() -> Self {
        Self { max_iterations: 100, keep_ratio: 0.9, max_points: 50_000, tolerance_m: 1e-5 }
    }
}

impl SurfaceEvalConfig {
    /// Checks every value's range.
    pub fn validate(&self) -> Result<(), EvalError> {
        let check = |key, value: f64, ok: bool, expected| {
            if ok { Ok(()) } else { Err(EvalError::Config { key, found: value.to_string(), expected }) }
        };
        let above_zero = |v: f64| v.is_finite() && v > 0.0;
        if self.thresholds_m.is_empty() {
            let expected = "at least one threshold";
            return Err(EvalError::Config { key: "thresholds_m", found: "[]".into(), expected });
        }
        for &t in &self.thresholds_m {
            check("thresholds_m", t, above_zero(t), "each above 0 m")?;
        }
        let ScaleBounds { min, max } = self.scale_bounds;
        check("scale_bounds.min", min, min > 0.0 && min <= 1.0, "above 0, at most 1")?;
        check("scale_bounds.max", max, max >= 1.0 && max.is_finite(), "at least 1")?;
        let keep = self.icp.keep_ratio;
        check("icp.keep_ratio", keep, keep > 0.0 && keep <= 1.0, "above 0, at most 1")?;
        check(
            "icp.max_iterations",
            self.icp.max_iterations as f64,
            self.icp.max_iterations >= 1,
            "at least 1",
        )?;
        check("icp.max_points", self.icp.max_points as f64, self.icp.max_points >= 100, "at least 100")?;
        let tolerance = self.icp.tolerance_m;
        check("icp.tolerance_m", tolerance, tolerance.is_finite() && tolerance >= 0.0, "at least 0 m")?;
        if let Some(voxel) = self.voxel_size_m {
            check("voxel_size_m", voxel, above_zero(voxel), "above 0 m")?;
        }
        if let Some(margin) = self.crop_margin_m {
            check("crop_margin_m", margin, margin.is_finite() && margin >= 0.0, "at least 0 m")?;
        }
        Ok(())
    }

    /// The threshold at which ΔF is taken: the largest.
    pub(super) fn delta_f_threshold(&self) -> f64 {
        self.thresholds_m.iter().copied().fold(0.0, f64::max)
    }
}
