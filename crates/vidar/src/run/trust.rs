//! How far a map may be trusted.

use super::{Evaluation, MetricMap};
use crate::error::ExitStatus;
use crate::input::{TrajectorySource, UnseenScale};
use crate::verdict::{
    BAD_F, Findings, GOOD_F, LEAST_AREA, LEAST_PRECISION, Level, ScaleSource, StatedScale, Verdict,
};
use vidar_align::CouplingMode;
use vidar_core::{Severity, Warning};
use vidar_solve::statistics::median_upper;

/// What is said of the map's scale: chunks, metric poses, and what no estimate sees.
pub(super) fn stated_scale(map: &MetricMap, mode: CouplingMode, unseen: UnseenScale) -> StatedScale {
    let mut chunks: Vec<f64> = map
        .placement
        .iter()
        .flat_map(|p| &p.chunks)
        .map(|c| c.log_scale_std)
        .filter(|s| s.is_finite())
        .collect();
    let disagreement = map.pose_correction().map(|(correction, _)| correction.log_scale_std);
    let source = match map.trajectory.as_ref().map(|t| &t.source).filter(|_| mode.uses_pose_priors()) {
        None => ScaleSource::None,
        Some(TrajectorySource::External { .. }) => ScaleSource::Given { disagreement },
        Some(TrajectorySource::GroundTruth) => ScaleSource::GroundTruth { disagreement },
        Some(TrajectorySource::Odometry) => {
            map.quality.as_ref().map_or(ScaleSource::None, |quality| unseen.source(quality))
        }
    };
    StatedScale::new(source, median_upper(&mut chunks))
}

/// Degradations that the whole result shows.
pub(super) fn warnings(map: &MetricMap, evaluation: &Evaluation, scale: &StatedScale) -> Vec<Warning> {
    let mut warnings: Vec<Warning> = scale.warning().into_iter().collect();
    if let Some(share) = map.share_of_a_view().filter(|s| *s < LEAST_AREA) {
        let message = format!(
            "the surface has {:.1} m2, {:.1} % of what one view sees: views contradict each other",
            map.surface.coverage.surface_area_m2,
            100.0 * share
        );
        let hint = "poses of another recording, of another clock or of another camera end like this; see failures.md";
        warnings.push(Warning::degraded("map-almost-empty", message).hint(hint));
    }
    let rigid = evaluation.surface.as_ref().and_then(|s| s.rigid.last()).filter(|_| scale.is_metric);
    if let Some(s) = rigid.filter(|s| s.precision < LEAST_PRECISION) {
        let message = format!(
            "{:.0} % of the map are within {:.2} m of the reference: it does not show what the reference shows",
            100.0 * s.precision,
            s.threshold_m
        );
        warnings.push(Warning::degraded("map-off-reference", message));
    }
    warnings
}

/// The verdict on a map.
pub(super) fn verdict(
    map: &MetricMap,
    evaluation: &Evaluation,
    scale: &StatedScale,
    warnings: &[Warning],
    status: ExitStatus,
) -> Verdict {
    let mut findings = Findings::default();
    findings
        .when(status == ExitStatus::Interrupted, Level::Bad, || "interrupted: only a part was mapped".into());
    findings.when(map.surface.mesh.triangles.is_empty(), Level::Bad, || "the map is empty".into());
    for warning in warnings.iter().filter(|w| w.severity == Severity::Degraded) {
        let level = match warning.kind.as_str() {
            "map-almost-empty" | "map-off-reference" => Level::Bad,
            // Said by what follows.
            "scale-not-converged" | "track-lost" => continue,
            _ => Level::Caution,
        };
        findings.add(level, warning.message.clone());
    }
    findings.scale(scale);
    let is_odometry = map.trajectory.as_ref().is_some_and(|t| t.source == TrajectorySource::Odometry);
    if let Some(quality) = map.quality.as_ref().filter(|_| is_odometry) {
        findings.track(quality);
    }
    let mut compared = Vec::new();
    if let Some(report) = &evaluation.trajectory {
        if scale.is_metric {
            findings.trajectory(report, scale);
        }
        compared.extend(report.ate_se3_m.as_ref().map(|ate| format!("ATE SE(3) {:.4} m", ate.rmse)));
    }
    if let Some(surface) = &evaluation.surface
        && let Some(s) = surface.rigid.last()
    {
        let text = format!("F {:.3} at {:.2} m against the reference, scale as it is", s.f, s.threshold_m);
        match s.f {
            f if f < BAD_F => findings.add(Level::Bad, text),
            f if f < GOOD_F => findings.add(Level::Caution, text),
            _ => compared.push(text),
        }
        if let Some(w) = surface.warnings.iter().find(|w| w.kind == "scale-refined") {
            findings.add(Level::Caution, w.message.clone());
        }
    }
    if map.uses_ground_truth() {
        compared.iter_mut().for_each(|text| *text += " (poses are ground truth: an upper bound)");
    }
    findings.verdict((!compared.is_empty()).then(|| compared.join(", ")))
}
