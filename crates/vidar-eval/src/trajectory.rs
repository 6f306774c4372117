//! Errors of an estimated trajectory against ground truth.
//!
//! Stamps are paired ([`associate`]), the paired positions are aligned in closed form under SE(3) and under
//! Sim(3) (Umeyama 1991; the paper's section III-E), and the remaining distance is the absolute trajectory error:
//! `ATE = |p_truth − (s R p_estimate + t)|` (Sturm et al., IROS 2012; the paper's section IV-B uses Sim(3)).
//! The scale error is `|ln s|` with the Sim(3) fit's `s`, metres of truth per unit of the estimate. The relative
//! error compares motions instead of positions and needs no alignment: [`RpeReport`]. Numbers agree with evo.

mod association;
mod config;
mod relative;
mod report;
#[cfg(test)]
mod tests;

pub use association::associate;
pub use config::TrajectoryEvalConfig;
pub use report::{Coverage, RpeReport, RpeStep, TrajectoryReport};

use crate::error::EvalError;
use crate::stats::ErrorStats;
use nalgebra::Vector3;
use vidar_core::{LieGroup, Se3, Sim3, StampedPose, Trajectory, Warning, umeyama_se3, umeyama_sim3};

/// A pose of the estimate and the pose of the truth at that time.
#[derive(Clone, Copy)]
struct Matched<'a> {
    estimate: &'a StampedPose,
    truth: &'a StampedPose,
}

/// Evaluates `estimate` against `truth`, which must be of the same body.
///
/// Motions that do not determine an alignment (standing still, a straight line) leave the fields that need it `None` and
/// add a warning. Fails when the bodies differ, when a trajectory is empty, and when no stamps match.
pub fn evaluate_trajectory(
    estimate: &Trajectory,
    truth: &Trajectory,
    config: &TrajectoryEvalConfig,
) -> Result<TrajectoryReport, EvalError> {
    config.validate()?;
    if estimate.body() != truth.body() {
        return Err(EvalError::BodyMismatch { estimate: estimate.body(), truth: truth.body() });
    }
    let pairs = associate(estimate, truth, config.max_time_difference())?;
    let matched: Vec<Matched<'_>> = pairs
        .iter()
        .map(|&(e, t)| Matched { estimate: &estimate.poses()[e], truth: &truth.poses()[t] })
        .collect();

    let mut warnings = Vec::new();
    let positions_estimate: Vec<_> = matched.iter().map(|m| m.estimate.world_from_body.translation).collect();
    let positions_truth: Vec<_> = matched.iter().map(|m| m.truth.world_from_body.translation).collect();
    let rigid = fit("SE(3)", umeyama_se3(&positions_estimate, &positions_truth), &mut warnings);
    let similar = fit("Sim(3)", umeyama_sim3(&positions_estimate, &positions_truth), &mut warnings);
    let errors = |transform: &Sim3| absolute_errors(transform, &positions_estimate, &positions_truth);

    let rpe_frames = relative::rpe(&matched, RpeStep::Frames { count: config.rpe_frames });
    let rpe_metres = relative::rpe(&matched, RpeStep::Metres { length: config.rpe_distance_m });
    if rpe_metres.is_none() {
        warnings.push(Warning::new(
            "rpe-too-short",
            format!(
                "the matched path has no step of {} m, so there is no RPE per metre",
                config.rpe_distance_m
            ),
        ));
    }
    let coverage = report::coverage(&matched, estimate, truth, config.coverage_gap());
    if coverage.truth_time_ratio < config.low_coverage_ratio {
        warnings.push(
            Warning::new(
                "low-coverage",
                format!(
                    "matched poses cover {:.1} % of the ground truth's time, the errors do not cover the rest",
                    100.0 * coverage.truth_time_ratio
                ),
            )
            .hint("errors over a part of the recording understate those over the whole"),
        );
    }
    let scale = similar.map(|s| s.scale);
    Ok(TrajectoryReport {
        body: estimate.body().to_string(),
        matched: matched.len(),
        estimate_poses: estimate.len(),
        truth_poses: truth.len(),
        coverage,
        ate_se3_m: rigid.and_then(|t| ErrorStats::from_errors(&errors(&Sim3::from_se3(&t)))),
        ate_sim3_m: similar.and_then(|t| ErrorStats::from_errors(&errors(&t))),
        ate_unaligned_m: ErrorStats::from_errors(&errors(&Sim3::IDENTITY)),
        orientation_se3_deg: rigid.and_then(|t| orientation_errors(&t, &matched)),
        scale,
        scale_error: scale.map(|s| s.ln().abs()),
        rpe_frames,
        rpe_metres,
        estimate_path_m: estimate.path_length_m(),
        truth_path_m: truth.path_length_m(),
        matched_estimate_path_m: path_length(&positions_estimate),
        matched_truth_path_m: path_length(&positions_truth),
        truth_from_estimate_se3: rigid.map(Into::into),
        truth_from_estimate_sim3: similar.map(Into::into),
        warnings,
    })
}

/// The fit, or a warning with the reason why there is none.
fn fit<T, E: std::fmt::Display>(what: &str, fit: Result<T, E>, warnings: &mut Vec<Warning>) -> Option<T> {
    match fit {
        Ok(transform) => Some(transform),
        Err(error) => {
            warnings.push(
                Warning::new(
                    "alignment-undetermined",
                    format!("no {what} alignment of the trajectories: {error}"),
                )
                .hint("alignment, ATE and scale are defined only for a motion that is not a straight line"),
            );
            None
        }
    }
}

fn absolute_errors(transform: &Sim3, estimate: &[Vector3<f64>], truth: &[Vector3<f64>]) -> Vec<f64> {
    estimate.iter().zip(truth).map(|(e, t)| (t - transform.act(e)).norm()).collect()
}

/// Angles between the truth's orientations and the estimate's after the SE(3) fit of positions, degrees.
fn orientation_errors(truth_from_estimate: &Se3, matched: &[Matched<'_>]) -> Option<ErrorStats> {
    let angles: Vec<f64> = matched
        .iter()
        .map(|m| {
            let aligned = truth_from_estimate.rotation * m.estimate.world_from_body.rotation;
            (m.truth.world_from_body.rotation.inverse() * aligned).angle_rad().to_degrees()
        })
        .collect();
    ErrorStats::from_errors(&angles)
}

fn path_length(positions: &[Vector3<f64>]) -> f64 {
    positions.windows(2).map(|w| (w[1] - w[0]).norm()).sum()
}
