//! How good the result is, where that can be known.

use super::plan::Plan;
use super::{MetricMap, anchored_by_truth, keyframe_trajectory, reference};
use crate::config::Config;
use crate::error::Error;
use crate::events::Events;
use crate::input::truth_in_camera;
use rayon::prelude::*;
use serde::Serialize;
use vidar_core::{AlignedView, PointCloud, Se3, Trajectory, TriangleMesh, Warning};
use vidar_dataset::Dataset;
use vidar_eval::{
    DepthAccumulator, DepthSummary, EvalError, PlacementStart, SampleDensity, SurfaceEvalConfig,
    SurfaceReport, TrajectoryReport,
};

/// Scores, each with what it was judged against.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Judgement {
    /// The map's camera poses against ground truth; absent when they are ground truth.
    pub trajectory: Option<TrajectoryReport>,
    /// Poses of the anchor against ground truth, where the map's are not the anchor's.
    pub anchor: Option<TrajectoryReport>,
    /// Surface against the reference.
    pub surface: Option<SurfaceReport>,
    /// Depth of keyframes against the depth sensor.
    pub depth: Option<DepthScore>,
    /// Points of the estimate with their distance (m) to the reference; for pictures.
    #[serde(skip)]
    pub error_cloud: Option<(PointCloud, Vec<f32>)>,
}

/// Depth scores over all keyframes.
#[derive(Clone, Debug, Serialize)]
pub struct DepthScore {
    /// Errors and completeness.
    #[serde(flatten)]
    pub summary: DepthSummary,
}

/// Judges trajectory, surface and depth. What cannot be judged is left out; a failed judgement is a warning.
pub fn judge(
    dataset: &Dataset,
    plan: &Plan,
    map: &MetricMap,
    config: &Config,
    events: &Events,
) -> Result<Judgement, Error> {
    let mut judgement = Judgement::default();
    let warn =
        |what: &str, reason: String| events.warn(&Warning::new("not-judged", format!("{what}: {reason}")));
    let mut start = PlacementStart::from(Se3::IDENTITY);
    if let Some(truth) = truth_in_camera(dataset) {
        let against_truth = |what: &str, estimate: &Trajectory| match vidar_eval::evaluate_trajectory(
            estimate,
            &truth,
            &config.eval.trajectory,
        ) {
            Ok(report) => {
                report.warnings.iter().for_each(|w| events.warn(w));
                Some(report)
            }
            Err(e) => {
                warn(what, e.to_string());
                None
            }
        };
        let anchor = plan.anchor.as_ref().filter(|_| !anchored_by_truth(plan));
        let anchor = anchor.and_then(|a| against_truth("trajectory", &a.camera_trajectory));
        let moved = plan.mode.chains().then(|| keyframe_trajectory(plan, map)).flatten();
        match moved {
            Some(trajectory) => {
                judgement.trajectory = against_truth("map's poses", &trajectory);
                judgement.anchor = anchor;
            }
            None => judgement.trajectory = anchor,
        }
        if let Some(report) = &judgement.trajectory {
            start = placement_start(report);
        }
    }
    // By now the map is made; a reference that cannot be read must not cost it.
    let reference = reference::cloud(&plan.reference, dataset, config, events).unwrap_or_else(|e| {
        warn("surface", format!("{}: {e}", plan.reference));
        None
    });
    if let Some(reference) = reference {
        let surface = SurfaceEvalConfig { keep_point_errors: true, ..config.eval.surface.clone() };
        let judged = sampled(&map.mesh, config).map_err(Error::from).and_then(|estimate| {
            let report = vidar_eval::evaluate_surface_from(&estimate, &reference, &start, &surface)?;
            Ok((estimate, report))
        });
        match judged {
            Ok((estimate, mut report)) => {
                judgement.error_cloud =
                    report.point_errors.take().map(|errors| (estimate, errors.estimate_m));
                judgement.surface = Some(report);
            }
            Err(e) => warn("surface", e.to_string()),
        }
    }
    judgement.depth = map.depth_scores.score();
    Ok(judgement)
}

/// Where the estimate lies in the world of ground truth, as its trajectory tells.
fn placement_start(report: &TrajectoryReport) -> PlacementStart {
    PlacementStart {
        truth_from_estimate: report.truth_from_estimate_se3.and_then(|t| t.to_se3()).unwrap_or(Se3::IDENTITY),
        truth_from_estimate_sim3: report.truth_from_estimate_sim3.and_then(|t| t.to_sim3()),
    }
}

/// The mesh as evenly spread points: what is judged must not depend on how finely a format splits triangles.
pub fn sampled(mesh: &TriangleMesh, config: &Config) -> Result<PointCloud, EvalError> {
    vidar_eval::sample_mesh(mesh, SampleDensity::SpacingM(config.fusion.voxel_size_m / 2.0))
}

/// Compares depth with the sensor's, view by view as the views are made.
#[derive(Debug, Default)]
pub struct DepthScorer(DepthAccumulator);

impl DepthScorer {
    /// Takes in the views for whose time there is a depth image.
    pub fn add(&mut self, dataset: &Dataset, views: &[AlignedView]) {
        let compared: Vec<_> = views
            .par_iter()
            .map(|view| match reference::sensor_depth_in_view(dataset, view.time(), view.intrinsics()) {
                Some(Ok(truth)) => Some((view.depth(), truth)),
                // An unreadable depth image is named when the reference is fused.
                Some(Err(_)) | None => None,
            })
            .collect();
        for (predicted, truth) in compared.into_iter().flatten() {
            // Both have the view's size, so this cannot fail; were it to, the frame would only be missing here.
            let _ = self.0.push(predicted, &truth);
        }
    }

    /// The scores, if anything could be compared.
    pub fn score(&self) -> Option<DepthScore> {
        let summary = self.0.summary();
        (summary.frames_judged > 0).then_some(DepthScore { summary })
    }
}
