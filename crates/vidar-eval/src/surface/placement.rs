//! Placement of the estimate in the reference's world frame: the bounded native one and the free ones.

use super::PlacementStart;
use super::config::{IcpConfig, OnRejection, SurfaceEvalConfig};
use super::pairs::{Matching, Pairs};
use super::report::PlacementReport;
use crate::error::EvalError;
use nalgebra::Vector3;
use vidar_core::{Se3, Sim3, UmeyamaError, Warning, umeyama_se3, umeyama_sim3};

/// Change of scale from which the bounded placement is told to hide an error. Trimmed ICP of a true cloud with noise of
/// stereo's size moves the scale by less than 1 %.
const TOLERATED_SCALE_CHANGE: f64 = 0.02;

/// A placement and the start of its refinement.
pub(super) struct Placement {
    pub start: &'static str,
    pub truth_from_estimate: Sim3,
}

/// The native placement and how it was determined.
pub(super) struct Refinement {
    pub truth_from_estimate: Sim3,
    accepted: bool,
    reason: String,
    /// Result of the similarity ICP, accepted or not.
    refined: Option<IcpResult>,
}

/// Result of an ICP.
#[derive(Clone, Copy)]
struct IcpResult {
    truth_from_estimate: Sim3,
    iterations: usize,
    converged: bool,
    rms_before_m: f64,
    rms_after_m: f64,
}

/// Which transforms an ICP may use.
#[derive(Clone, Copy)]
enum Motion {
    Rigid,
    Similarity,
}

/// The SE(3) fit, refined by an ICP without scale where that does not make it worse: the scale is the estimate's own.
pub(super) fn rigid_placement(
    matching: &Matching<'_>,
    start: &PlacementStart,
    config: &SurfaceEvalConfig,
) -> Placement {
    let rigid = Sim3::from_se3(&start.truth_from_estimate);
    refined_rigidly(matching, &rigid, config).map_or(
        Placement { start: "rigid", truth_from_estimate: rigid },
        |truth_from_estimate| Placement { start: "rigid", truth_from_estimate },
    )
}

/// The result of an ICP without scale, unless it fails or fits worse than its start.
fn refined_rigidly(matching: &Matching<'_>, start: &Sim3, config: &SurfaceEvalConfig) -> Option<Sim3> {
    let refined = icp(matching, start, Motion::Rigid, &config.icp).ok();
    refined.filter(|r| r.rms_after_m <= r.rms_before_m).map(|r| r.truth_from_estimate)
}

/// The SE(3) fit, refined by one similarity ICP when its scale is within bounds (the paper's eq. in section IV-B).
pub(super) fn native_placement(
    matching: &Matching<'_>,
    start: &PlacementStart,
    config: &SurfaceEvalConfig,
) -> Result<Refinement, EvalError> {
    let rigid = Sim3::from_se3(&start.truth_from_estimate);
    let bounds = &config.scale_bounds;
    let refined = icp(matching, &rigid, Motion::Similarity, &config.icp);
    let rejection = match &refined {
        Err(error) => format!("refinement failed: {error}"),
        Ok(r) if !bounds.contains(r.truth_from_estimate.scale) => format!(
            "refined scale {:.4} is outside [{}, {}]",
            r.truth_from_estimate.scale, bounds.min, bounds.max
        ),
        Ok(r) if r.rms_after_m > r.rms_before_m => {
            format!("refinement made the fit worse: RMS {:.4} m from {:.4} m", r.rms_after_m, r.rms_before_m)
        }
        Ok(r) => {
            let scale = r.truth_from_estimate.scale;
            let reason = format!("refined scale {scale:.4} is within [{}, {}]", bounds.min, bounds.max);
            let truth_from_estimate = r.truth_from_estimate;
            return Ok(Refinement { truth_from_estimate, accepted: true, reason, refined: Some(*r) });
        }
    };
    let kept = match config.on_rejection {
        OnRejection::KeepRigidFit => rigid,
        OnRejection::RefineRigid => refined_rigidly(matching, &rigid, config).unwrap_or(rigid),
    };
    Ok(Refinement { truth_from_estimate: kept, accepted: false, reason: rejection, refined: refined.ok() })
}

/// Placements of any scale: the rejected refinement, and those from the trajectories' Sim(3) fit.
pub(super) fn free_candidates(
    matching: &Matching<'_>,
    start: &PlacementStart,
    config: &SurfaceEvalConfig,
    native: &Refinement,
) -> Result<Vec<Placement>, EvalError> {
    let mut candidates = Vec::new();
    if let (false, Some(rejected)) = (native.accepted, &native.refined) {
        candidates
            .push(Placement { start: "rigid-start", truth_from_estimate: rejected.truth_from_estimate });
    }
    if let Some(similarity) = &start.truth_from_estimate_sim3 {
        candidates.push(Placement { start: "similarity-start", truth_from_estimate: *similarity });
        if let Ok(refined) = icp(matching, similarity, Motion::Similarity, &config.icp) {
            let truth_from_estimate = refined.truth_from_estimate;
            candidates.push(Placement { start: "similarity-start-refined", truth_from_estimate });
        }
    }
    Ok(candidates)
}

/// Trimmed point-to-point ICP from `start`: `min Σ |T x − y(x)|²` over the nearest pairs, one closed form per step.
fn icp(
    matching: &Matching<'_>,
    start: &Sim3,
    motion: Motion,
    config: &IcpConfig,
) -> Result<IcpResult, UmeyamaError> {
    let mut current = *start;
    let mut followed = matching.followed();
    let mut pairs = matching.trimmed_pairs(&mut followed, &current, config.keep_ratio);
    let rms_before_m = pairs.rms_m;
    let (mut iterations, mut converged) = (0, false);
    while iterations < config.max_iterations && !converged {
        let next = match motion {
            Motion::Similarity => umeyama_sim3(&pairs.source, &pairs.target)?,
            Motion::Rigid => rigid_step(&pairs, start.scale)?,
        };
        iterations += 1;
        converged = step_rms(&pairs.source, &current, &next) <= config.tolerance_m;
        current = next;
        pairs = matching.trimmed_pairs(&mut followed, &current, config.keep_ratio);
    }
    Ok(IcpResult {
        truth_from_estimate: current,
        iterations,
        converged,
        rms_before_m,
        rms_after_m: pairs.rms_m,
    })
}

/// The best motion that keeps the scale.
fn rigid_step(pairs: &Pairs, scale: f64) -> Result<Sim3, UmeyamaError> {
    let scaled: Vec<_> = pairs.source.iter().map(|p| p * scale).collect();
    let Se3 { rotation, translation } = umeyama_se3(&scaled, &pairs.target)?;
    Ok(Sim3 { rotation, translation, scale })
}

fn step_rms(points: &[Vector3<f64>], from: &Sim3, to: &Sim3) -> f64 {
    let sum: f64 = points.iter().map(|p| (*from * *p - *to * *p).norm_squared()).sum();
    (sum / points.len().max(1) as f64).sqrt()
}

impl Refinement {
    pub(super) fn report(&self) -> PlacementReport {
        PlacementReport {
            truth_from_estimate: self.truth_from_estimate.into(),
            accepted: self.accepted,
            reason: self.reason.clone(),
            refined_scale: self.refined.map(|r| r.truth_from_estimate.scale),
            iterations: self.refined.map_or(0, |r| r.iterations),
            converged: self.refined.is_some_and(|r| r.converged),
            rms_before_m: self.refined.map(|r| r.rms_before_m),
            rms_after_m: self.refined.map(|r| r.rms_after_m),
        }
    }

    pub(super) fn rejection_warning(&self, config: &SurfaceEvalConfig) -> Option<Warning> {
        let kept = match config.on_rejection {
            OnRejection::KeepRigidFit => "the SE(3) fit was kept",
            OnRejection::RefineRigid => "the SE(3) fit was refined without scale",
        };
        (!self.accepted).then(|| {
            Warning::new("refinement-rejected", format!("{}; {kept}", self.reason))
                .hint("compare scale_free and delta_f: a large difference means that the scale is not metric")
        })
    }

    /// A refinement that changed the scale by more than [`TOLERATED_SCALE_CHANGE`] says that the map's own is wrong.
    pub(super) fn scale_warning(&self) -> Option<Warning> {
        let scale = self.truth_from_estimate.scale;
        ((scale - 1.0).abs() > TOLERATED_SCALE_CHANGE).then(|| {
            let message = format!(
                "the reference fits best with lengths times {scale:.3}: the bounded placement (scale refined) hides an error of \
                 scale, of poses or of depth of {:.1} %",
                (1.0 / scale - 1.0).abs() * 100.0
            );
            Warning::new("scale-refined", message).hint("read the rigid F, which keeps the scale as it is")
        })
    }
}
