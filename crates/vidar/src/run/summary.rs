//! A run in at most twelve lines for the terminal.

use super::RunOutcome;
use super::by_source::SourceScore;
use crate::evaluate::refinement;
use vidar_align::aligner::RejectionReason;

/// How good it is, what was made, how far to trust it, how long it took, what next.
pub(super) fn lines(outcome: &RunOutcome) -> Vec<(&'static str, String)> {
    let map = &outcome.map;
    let folder = outcome.folder.display();
    let coverage = &map.surface.coverage;
    let mut lines = vec![
        ("verdict", outcome.verdict.line()),
        (
            "map",
            format!(
                "{folder}/map/mesh.ply ({} triangles), points.ply ({} points)",
                map.surface.mesh.triangles.len(),
                map.surface.cloud.len()
            ),
        ),
        (
            "keyframes",
            format!(
                "{} of {} with depth; surface {}, seen by {:.1} views on average",
                map.views.len(),
                map.keyframes.len(),
                area(coverage.surface_area_m2, outcome.is_metric(), 1),
                coverage.mean_observations
            ),
        ),
        ("metric poses", poses_line(outcome)),
        ("coupling", coupling_line(outcome)),
        ("scale", outcome.scale.words.clone()),
    ];
    if let Some(t) = &outcome.evaluation.trajectory {
        let ate =
            t.ate_se3_m.as_ref().map_or_else(|| "not determined".into(), |s| format!("{:.4} m", s.rmse));
        let scale = t.scale_error.map_or_else(|| "not determined".into(), |v| format!("{v:.4}"));
        let held = match map.uses_ground_truth() && outcome.plan.mode.uses_pose_priors() {
            true => "; the map was placed by ground truth: an upper bound",
            false => "",
        };
        lines.push(("trajectory", format!("ATE {ate}, |ln s| {scale} ({} matched){held}", t.matched)));
    }
    match &outcome.evaluation.surface {
        Some(surface) => {
            let f: Vec<String> = surface
                .rigid
                .iter()
                .map(|s| {
                    format!("F@{:.2} {:.3} (P {:.3}, R {:.3})", s.threshold_m, s.f, s.precision, s.recall)
                })
                .collect();
            let refined = surface.native.last().map_or_else(String::new, |s| {
                format!("; F@{:.2} {:.3} with {}", s.threshold_m, s.f, refinement(surface))
            });
            lines.push(("how good", format!("{}{refined}", f.join("  "))));
        }
        None => lines.push(("how good", "not evaluated: no reference".into())),
    }
    if let Some(depth) = outcome.evaluation.depth.as_ref().map(|d| &d.summary.pixel_weighted)
        && let Some(metric) = &depth.metric
    {
        lines.push((
            "depth",
            format!(
                "AbsRel {:.4}, delta<1.25 {:.3}, on {:.0} % of the sensor's pixels",
                metric.abs_rel,
                metric.delta_1,
                depth.completeness * 100.0
            ),
        ));
    }
    if let Some(by_source) = outcome.evaluation.depth.as_ref().map(|d| &d.by_source).filter(|s| !s.is_empty())
    {
        let one = |s: &SourceScore| {
            format!("{} {:.0} % (AbsRel {:.3})", s.source.name(), 100.0 * s.share, s.abs_rel)
        };
        lines.push(("depth by source", by_source.iter().map(one).collect::<Vec<_>>().join(", ")));
    }
    if let Some(live) = &outcome.live {
        lines.push(("live", live.words()));
    }
    if let Some(remote) = &outcome.remote {
        lines.push(("geometry from", remote.words()));
    }
    let memory = crate::system::peak_memory_bytes()
        .map_or_else(String::new, |b| format!(", peak memory {}", super::bytes(b)));
    lines.push(("took", format!("{:.1} s{}{memory}", outcome.seconds, of_budget(outcome))));
    let report = outcome.folder.join("report.html");
    let shown = if report.exists() { report } else { outcome.folder.join("map/mesh.ply") };
    lines.push(("look at it", shown.display().to_string()));
    lines
}

/// How the time compares with the budget, and the speed that would have been right.
fn of_budget(outcome: &RunOutcome) -> String {
    let Some(budget) = &outcome.plan.budget else { return String::new() };
    let found = budget.found_speed(outcome.seconds);
    // A quarter is what one run differs from the next beside other work.
    let is_off = !(0.8..1.25).contains(&(found / budget.speed));
    let hint = if is_off { format!(" (here budget.speed is {found:.2})") } else { String::new() };
    format!(" of a budget of {}{hint}", budget.words())
}

/// An area with the unit it has.
pub(super) fn area(value: f64, is_metric: bool, digits: usize) -> String {
    match is_metric {
        true => format!("{value:.digits$} m2"),
        false => format!("{value:.digits$} square units (not metres)"),
    }
}

/// Where poses come from, and what the odometry says of its own.
fn poses_line(outcome: &RunOutcome) -> String {
    let poses = match &outcome.map.quality {
        Some(quality) => format!("{}; odometry: {}", outcome.map.poses(), quality.words()),
        None => outcome.map.poses(),
    };
    let Some((correction, std)) = outcome.map.pose_correction() else { return poses };
    format!(
        "{poses}; corrected by the images by {:.1} mm and {:.2} deg (1 σ {:.1} mm, {:.2} deg)",
        1e3 * correction.center_rms_m,
        correction.rotation_rms_rad.to_degrees(),
        1e3 * std.translation_m,
        std.rotation_rad.to_degrees()
    )
}

/// How chunks were coupled, and what was left out and why.
fn coupling_line(outcome: &RunOutcome) -> String {
    let mut text = outcome.plan.mode.to_string();
    let Some(placement) = &outcome.map.placement else { return text };
    let accepted = placement.loops.iter().filter(|l| l.rejection.is_none()).count();
    if !placement.loops.is_empty() {
        text += &format!(", {accepted} of {} loops accepted", placement.loops.len());
    }
    let rejections: Vec<String> =
        placement.rejections.iter().map(|(reason, n)| format!("{} ({n}x)", in_words(reason))).collect();
    if !rejections.is_empty() {
        text += &format!("; not used: {}", rejections.join(", "));
    }
    text
}

/// A rejection in plain words; files and JSON have its name.
fn in_words(reason: RejectionReason) -> &'static str {
    match reason {
        RejectionReason::ScaleOutOfRange => "scales out of range",
        RejectionReason::RankDeficient => "chunks whose camera positions lie on a line",
        RejectionReason::ViewNotFinite => "views without usable depth",
        RejectionReason::InconsistentChunk => "chunks that contradict their neighbours and poses",
        RejectionReason::NoOverlap => "overlaps of chunks that do not agree",
        RejectionReason::ScaleUnobservable => "chunks whose scale nothing determines",
        RejectionReason::OdometryDownweighted => "odometry where chunks agree against it",
        RejectionReason::OneWay => "depth as a correction of the poses",
        RejectionReason::LoopRejected => "loops",
        RejectionReason::DepthFieldRejected => "depth corrections that did not help on held-out landmarks",
        RejectionReason::DepthRescaled => "scales of chunks that landmarks contradict",
        RejectionReason::SingularCovariance => "measurements without a valid covariance",
        RejectionReason::GraphFailed => "graphs without a solution",
    }
}
