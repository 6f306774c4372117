//! `vidar eval`, scores by name, and thresholds on them.

use crate::config::Config;
use crate::error::Error;
use crate::run::Evaluation;
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;
use vidar_core::{PointCloud, Se3, Trajectory, TriangleMesh, Warning};
use vidar_dataset::TrajectoryReadOptions;
use vidar_eval::{SampleDensity, SurfaceReport, TrajectoryReport};

/// Scores by name: `ate`, `ate-sim3`, `scale`, `chamfer`, `f@0.05`, …. Scores of the surface are those of the rigid fit;
/// `f@0.05-refined` is the paper's, with a scale refined within bounds.
pub type Scores = BTreeMap<String, f64>;

/// Every score of an evaluation.
pub fn scores(evaluation: &Evaluation) -> Scores {
    let mut scores = Scores::new();
    if let Some(report) = &evaluation.trajectory {
        add_trajectory(&mut scores, report);
    }
    if let Some(report) = &evaluation.surface {
        add_surface(&mut scores, report);
    }
    if let Some(depth) = evaluation.depth.as_ref().and_then(|d| d.summary.pixel_weighted.metric) {
        scores.insert("abs-rel".into(), depth.abs_rel);
    }
    scores
}

fn add_trajectory(scores: &mut Scores, report: &TrajectoryReport) {
    let values = [
        ("ate", report.ate_se3_m.as_ref().map(|s| s.rmse)),
        ("ate-sim3", report.ate_sim3_m.as_ref().map(|s| s.rmse)),
        ("scale", report.scale_error),
    ];
    scores.extend(values.into_iter().filter_map(|(name, value)| Some((name.to_owned(), value?))));
}

fn add_surface(scores: &mut Scores, report: &SurfaceReport) {
    scores.extend(report.rigid.iter().map(|s| (format!("f@{:.2}", s.threshold_m), s.f)));
    scores.extend(report.rigid.iter().map(|s| (format!("p@{:.2}", s.threshold_m), s.precision)));
    scores.extend(report.rigid.iter().map(|s| (format!("r@{:.2}", s.threshold_m), s.recall)));
    scores.extend(report.native.iter().map(|s| (format!("f@{:.2}-refined", s.threshold_m), s.f)));
    scores.insert("chamfer".into(), report.chamfer.chamfer_m);
    scores.insert("delta-f".into(), report.delta_f_rigid);
}

/// Result of an evaluation of two files or of a run.
#[derive(Clone, Debug)]
pub struct EvalOutcome {
    /// `trajectory`, `surface` or `run`.
    pub kind: &'static str,
    /// Scores by name.
    pub scores: Scores,
    /// Label and text for people.
    pub lines: Vec<(String, String)>,
    /// The whole report.
    pub report: Value,
    /// Warnings.
    pub warnings: Vec<Warning>,
}

/// Compares one file with another: trajectories, or clouds and meshes (.ply).
///
/// `reading` applies to both trajectories.
pub fn evaluate_files(
    estimate: &Path,
    truth: &Path,
    config: &Config,
    reading: &TrajectoryReadOptions,
) -> Result<EvalOutcome, Error> {
    match (is_ply(estimate), is_ply(truth)) {
        (true, true) => surface(estimate, truth, config),
        (false, false) => trajectory(estimate, truth, config, reading),
        _ => Err(Error::Usage {
            what: format!("{} and {} are not of one kind", estimate.display(), truth.display()),
            hint: "compare a trajectory with a trajectory, or a .ply with a .ply".into(),
        }),
    }
}

fn is_ply(path: &Path) -> bool {
    path.extension().is_some_and(|e| e.eq_ignore_ascii_case("ply"))
}

fn trajectory(
    estimate: &Path,
    truth: &Path,
    config: &Config,
    reading: &TrajectoryReadOptions,
) -> Result<EvalOutcome, Error> {
    let read = |path: &Path| -> Result<(Trajectory, Vec<Warning>), Error> {
        Ok(vidar_dataset::read_trajectory(path, reading)?)
    };
    let ((estimate, mut warnings), (truth, more)) = (read(estimate)?, read(truth)?);
    warnings.extend(more);
    let mut outcome = evaluate_trajectories(&estimate, &truth, config)?;
    warnings.append(&mut outcome.warnings);
    Ok(EvalOutcome { warnings, ..outcome })
}

/// Compares two trajectories of one body.
///
/// # Errors
/// They are of two bodies, one is empty, or no stamps match.
pub fn evaluate_trajectories(
    estimate: &Trajectory,
    truth: &Trajectory,
    config: &Config,
) -> Result<EvalOutcome, Error> {
    let report = vidar_eval::evaluate_trajectory(estimate, truth, &config.eval.trajectory)?;
    let mut scores = Scores::new();
    add_trajectory(&mut scores, &report);
    Ok(EvalOutcome {
        kind: "trajectory",
        scores,
        lines: trajectory_lines(&report),
        report: json(&report),
        warnings: report.warnings,
    })
}

/// The trajectory report in words.
pub fn trajectory_lines(report: &TrajectoryReport) -> Vec<(String, String)> {
    let stats = |s: &Option<vidar_eval::ErrorStats>, unit: &str| {
        s.as_ref().map_or_else(
            || "not determined".to_owned(),
            |s| format!("{:.4} {unit} RMSE, median {:.4}, max {:.4}", s.rmse, s.median, s.max),
        )
    };
    let mut lines = vec![
        ("body".into(), report.body.clone()),
        (
            "matched".into(),
            format!(
                "{} of {} poses, {:.1} % of the true time",
                report.matched,
                report.estimate_poses,
                report.coverage.truth_time_ratio * 100.0
            ),
        ),
        ("ATE SE(3)".into(), stats(&report.ate_se3_m, "m")),
        ("ATE Sim(3)".into(), stats(&report.ate_sim3_m, "m")),
        (
            "scale".into(),
            report.scale.zip(report.scale_error).map_or_else(
                || "not determined".into(),
                |(scale, error)| format!("{scale:.5}, |ln s| {error:.5}"),
            ),
        ),
        ("orientation".into(), stats(&report.orientation_se3_deg, "deg")),
    ];
    for (label, rpe) in [("RPE per frame", &report.rpe_frames), ("RPE per metre", &report.rpe_metres)] {
        if let Some(rpe) = rpe {
            let text = format!(
                "{:.4} m, {:.3} deg RMSE ({} pairs)",
                rpe.translation_m.rmse, rpe.rotation_deg.rmse, rpe.pairs
            );
            lines.push((label.into(), text));
        }
    }
    lines
}

fn surface(estimate: &Path, truth: &Path, config: &Config) -> Result<EvalOutcome, Error> {
    evaluate_clouds(&read_surface(estimate, config)?, &read_surface(truth, config)?, config)
}

/// Compares two clouds in one world, metres.
///
/// # Errors
/// One of them has no finite point.
pub fn evaluate_clouds(
    estimate: &PointCloud,
    truth: &PointCloud,
    config: &Config,
) -> Result<EvalOutcome, Error> {
    let report = vidar_eval::evaluate_surface(estimate, truth, &Se3::IDENTITY, &config.eval.surface)?;
    let mut scores = Scores::new();
    add_surface(&mut scores, &report);
    Ok(EvalOutcome {
        kind: "surface",
        scores,
        lines: surface_lines(&report),
        report: json(&report),
        warnings: report.warnings,
    })
}

/// The evenly spread points by which a mesh is evaluated.
///
/// # Errors
/// The mesh has no area.
pub fn evaluated_points(mesh: &TriangleMesh, config: &Config) -> Result<PointCloud, Error> {
    let density = SampleDensity::SpacingM(config.fusion.voxel_size_m / 2.0);
    Ok(vidar_eval::sample_mesh(mesh, density)?)
}

/// A cloud as it is; a mesh as evenly spread points.
fn read_surface(path: &Path, config: &Config) -> Result<PointCloud, Error> {
    let bytes = crate::system::read_up_to(path, crate::system::MAX_CLOUD_BYTES)
        .map_err(|e| Error::io("read", path, e))?;
    let ply = vidar_export::read_ply(&bytes)?;
    if ply.triangles.is_empty() {
        return Ok(ply.cloud);
    }
    evaluated_points(&ply.into_mesh(), config)
}

/// The surface report in words: the rigid fit first, then what another scale would give.
pub fn surface_lines(report: &SurfaceReport) -> Vec<(String, String)> {
    let text =
        |s: &vidar_eval::Scores| format!("{:.3} (precision {:.3}, recall {:.3})", s.f, s.precision, s.recall);
    let rigid = report
        .rigid
        .iter()
        .map(|s| (format!("F@{:.2} m", s.threshold_m), format!("{}, rigid fit: scale as it is", text(s))));
    let refined = report.native.iter().map(|s| {
        let label = format!("F@{:.2} m refined", s.threshold_m);
        (label, format!("{}, {}", text(s), refinement(report)))
    });
    let mut lines: Vec<(String, String)> = rigid.chain(refined).collect();
    lines.push(("refinement".into(), report.placement.reason.clone()));
    lines.push((
        "free scale".into(),
        format!(
            "dF {:+.3} at {:.2} m with scale {:.4}, against the rigid fit",
            report.delta_f_rigid, report.delta_f_threshold_m, report.scale_free
        ),
    ));
    let c = &report.chamfer;
    lines.push((
        "distances".into(),
        format!(
            "accuracy {:.4} m (median {:.4}), completeness {:.4} m (median {:.4}), chamfer {:.4} m",
            c.accuracy_mean_m,
            c.accuracy_median_m,
            c.completeness_mean_m,
            c.completeness_median_m,
            c.chamfer_m
        ),
    ));
    lines
}

/// What the paper's bounded placement did with the scale.
pub fn refinement(report: &SurfaceReport) -> String {
    match report.placement.accepted {
        true => format!("scale refined to {:.4}", report.scale_native),
        false => "refinement rejected".to_owned(),
    }
}

/// The scores in the folder of a finished run.
pub fn evaluate_run(run: &Path) -> Result<EvalOutcome, Error> {
    let not_a_run = |reason: String| Error::NotARun { path: run.to_owned(), reason };
    let report: Value = crate::run_folder::read_json(run, "eval/metrics.json")?;
    let scores: Scores = serde_json::from_value(report["scores"].clone())
        .map_err(|e| not_a_run(format!("eval/metrics.json has no scores: {e}")))?;
    let mut lines: Vec<(String, String)> =
        scores.iter().map(|(k, v)| (k.clone(), format!("{v:.4}"))).collect();
    if lines.is_empty() {
        lines.push(("scores".into(), "none: there was no reference to compare the run with".into()));
    }
    Ok(EvalOutcome { kind: "run", scores, lines, report, warnings: Vec::new() })
}

fn json(value: &impl serde::Serialize) -> Value {
    serde_json::to_value(value).unwrap_or_default()
}

/// Bounds on scores: a scripted run fails when one is missed.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Thresholds {
    above: Vec<(String, f64)>,
    below: Vec<(String, f64)>,
}

impl Thresholds {
    /// Reads `name=value` pairs.
    pub fn parse(above: &[String], below: &[String]) -> Result<Self, Error> {
        let pairs = |list: &[String]| list.iter().map(|text| pair(text)).collect::<Result<Vec<_>, _>>();
        Ok(Self { above: pairs(above)?, below: pairs(below)? })
    }

    /// Fails on the first missed bound, and on a bound for a score that is not there.
    pub fn check(&self, scores: &Scores) -> Result<(), Error> {
        let known = || scores.keys().cloned().collect::<Vec<_>>().join(", ");
        for (bounds, word, missed) in [
            (&self.above, "above", (|v, b| v > b) as fn(f64, f64) -> bool),
            (&self.below, "below", |v, b| v < b),
        ] {
            for (name, bound) in bounds {
                let Some(&value) = scores.get(name) else {
                    return Err(Error::Threshold(format!(
                        "there is no score {name:?}; there are: {}",
                        known()
                    )));
                };
                if missed(value, *bound) {
                    return Err(Error::Threshold(format!("{name} is {value:.5}, {word} its bound {bound}")));
                }
            }
        }
        Ok(())
    }
}

fn pair(text: &str) -> Result<(String, f64), Error> {
    text.split_once('=')
        .and_then(|(name, value)| Some((name.trim().to_owned(), value.trim().parse::<f64>().ok()?)))
        .filter(|(_, value)| value.is_finite())
        .ok_or_else(|| Error::Usage {
            what: format!("bound {text:?} is not NAME=NUMBER"),
            hint: "write e.g. --fail-above ate=0.1 or --fail-below f@0.05=0.5".into(),
        })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bounds(above: &[&str], below: &[&str]) -> Result<Thresholds, Error> {
        let own = |list: &[&str]| list.iter().map(|s| (*s).to_owned()).collect::<Vec<_>>();
        Thresholds::parse(&own(above), &own(below))
    }

    #[test]
    fn bounds_are_kept_missed_or_refused() {
        let scores: Scores = [("ate".to_owned(), 0.05), ("f@0.10".to_owned(), 0.7)].into();
        assert!(bounds(&["ate=0.05"], &["f@0.10=0.7"]).unwrap().check(&scores).is_ok());
        let missed = bounds(&["ate=0.04"], &[]).unwrap().check(&scores).unwrap_err();
        assert_eq!(missed.exit_status() as i32, 5);
        assert!(bounds(&[], &["f@0.10=0.8"]).unwrap().check(&scores).is_err());
        let unknown = bounds(&["speed=1"], &[]).unwrap().check(&scores).unwrap_err().to_string();
        assert!(unknown.contains("ate, f@0.10"), "{unknown}");
        assert!(bounds(&["ate"], &[]).is_err());
        assert!(bounds(&["ate=nan"], &[]).is_err());
    }
}
