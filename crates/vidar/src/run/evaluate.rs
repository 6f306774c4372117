//! Scores of the result, where there is something to compare it with.

use super::by_source::{BySource, SourceScore, without_guesses};
use super::map::MetricMap;
use super::plan::Plan;
use super::reference;
use crate::config::Config;
use crate::error::Error;
use crate::events::Events;
use crate::input::{not_evaluated, truth_in_camera};
use rayon::prelude::*;
use serde::Serialize;
use std::collections::BTreeMap;
use vidar_core::{AlignedView, FrameId, MetricDepth, PointCloud, Se3, Trajectory, TriangleMesh};
use vidar_dataset::Recording;
use vidar_eval::{
    Coverage, DepthAccumulator, DepthSummary, EvalError, PlacementStart, SampleDensity, SurfaceEvalConfig,
    SurfaceReport, TrajectoryReport,
};

/// Scores of a run.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Evaluation {
    /// The map's camera poses against ground truth; absent when they are ground truth.
    pub trajectory: Option<TrajectoryReport>,
    /// The metric trajectory against ground truth, where the map's poses are others.
    pub metric_trajectory: Option<TrajectoryReport>,
    /// Surface against the reference.
    pub surface: Option<SurfaceReport>,
    /// Depth of keyframes against the depth sensor.
    pub depth: Option<DepthScore>,
    /// Points of the estimate with their distance (m) to the reference; for figures.
    #[serde(skip)]
    pub error_cloud: Option<(PointCloud, Vec<f32>)>,
    /// The reference that the surface was compared with, in the world of ground truth; for figures.
    #[serde(skip)]
    pub reference: Option<PointCloud>,
}

/// Depth scores over all keyframes.
#[derive(Clone, Debug, Serialize)]
pub struct DepthScore {
    /// Errors and completeness of what is measured: of all depth where a view has one source, else without guesses.
    #[serde(flatten)]
    pub summary: DepthSummary,
    /// The same pixels by where their depth comes from, guesses too; empty where views have one source.
    pub by_source: Vec<SourceScore>,
}

/// Evaluates trajectory, surface and depth. What has no reference is left out; an evaluation that failed is a degradation.
pub fn evaluate(
    dataset: &Recording,
    plan: &Plan,
    map: &MetricMap,
    config: &Config,
    events: &Events,
) -> Result<Evaluation, Error> {
    let mut evaluation = Evaluation::default();
    let warn = |what: &str, reason: &dyn std::fmt::Display| events.warn(&not_evaluated(what, reason));
    let mut start = PlacementStart::from(Se3::IDENTITY);
    let truth = truth_in_camera(dataset).unwrap_or_else(|e| {
        warn("ground truth", &e);
        None
    });
    if let Some(truth) = truth {
        let against_truth = |what: &str, estimate: &Trajectory| match vidar_eval::evaluate_trajectory(
            estimate,
            &truth,
            &config.eval.trajectory,
        ) {
            Ok(report) => Some(report),
            Err(e) => {
                warn(what, &e);
                None
            }
        };
        let metric = map.trajectory.as_ref().filter(|_| !map.uses_ground_truth());
        let metric = metric.and_then(|t| against_truth("trajectory", &t.camera_trajectory));
        let moved = plan.mode.chains().then(|| map.keyframe_trajectory()).flatten();
        match moved {
            Some(trajectory) => {
                evaluation.trajectory = against_truth("poses of the map", &trajectory);
                if let (Some(keyframes), Some(metric)) = (&mut evaluation.trajectory, &metric) {
                    covered_as(keyframes, metric);
                }
                evaluation.metric_trajectory = metric;
            }
            None => evaluation.trajectory = metric,
        }
        let reports = evaluation.metric_trajectory.iter().chain(&evaluation.trajectory);
        reports.flat_map(|r| &r.warnings).for_each(|w| events.warn(w));
        if let Some(report) = &evaluation.trajectory {
            start = placement_start(report);
        }
    }
    // The map is finished: a reference that cannot be read must not cost it.
    let reference = reference::cloud(&plan.reference, dataset, config, events).unwrap_or_else(|e| {
        warn("surface", &format!("{}: {e}", plan.reference));
        None
    });
    if let Some(reference) = reference {
        let surface = SurfaceEvalConfig { keep_point_errors: true, ..config.eval.surface.clone() };
        let report = sampled(&map.surface.mesh, config).map_err(Error::from).and_then(|estimate| {
            let report = vidar_eval::evaluate_surface_from(&estimate, &reference, &start, &surface)?;
            Ok((estimate, report))
        });
        match report {
            Ok((estimate, mut report)) => {
                report.warnings.iter().for_each(|w| events.warn(w));
                evaluation.error_cloud =
                    report.point_errors.take().map(|errors| (estimate, errors.estimate_m));
                evaluation.surface = Some(report);
            }
            Err(e) => warn("surface", &e),
        }
        evaluation.reference = Some(reference);
    }
    evaluation.depth = map.depth_scores.score();
    Ok(evaluation)
}

/// Keyframes cover the time of the track that they were selected from: a camera that hardly moves has none for seconds.
fn covered_as(keyframes: &mut TrajectoryReport, track: &TrajectoryReport) {
    let estimate_ratio = keyframes.coverage.estimate_ratio;
    keyframes.coverage = Coverage { estimate_ratio, ..track.coverage };
    keyframes.warnings.retain(|w| w.kind != "low-coverage");
}

/// Pose of the estimate in the world of ground truth, by its trajectory.
fn placement_start(report: &TrajectoryReport) -> PlacementStart {
    PlacementStart {
        truth_from_estimate: report.truth_from_estimate_se3.and_then(|t| t.to_se3()).unwrap_or(Se3::IDENTITY),
        truth_from_estimate_sim3: report.truth_from_estimate_sim3.and_then(|t| t.to_sim3()),
    }
}

/// The mesh as evenly spread points: scores must not depend on how finely a format splits triangles.
pub fn sampled(mesh: &TriangleMesh, config: &Config) -> Result<PointCloud, EvalError> {
    vidar_eval::sample_mesh(mesh, SampleDensity::SpacingM(config.fusion.voxel_size_m / 2.0))
}

/// Compares depth with the depth sensor's, view by view as views are fused.
#[derive(Debug, Default)]
pub struct DepthScorer {
    measured: DepthAccumulator,
    by_source: BySource,
}

impl DepthScorer {
    /// Adds the views for whose time there is a depth image.
    pub fn add(&mut self, dataset: &Recording, views: &[AlignedView]) -> Result<(), Error> {
        let truth = |view: &AlignedView| {
            // An unreadable depth image is reported when the reference is fused.
            reference::sensor_depth_in_view(dataset, view.time(), view.intrinsics())?.ok()
        };
        if views.iter().all(|v| v.origin().is_none()) {
            return Ok(self.measured.push_views(views, truth)?);
        }
        let truths: BTreeMap<FrameId, Option<MetricDepth>> =
            views.par_iter().map(|v| (v.frame_id(), truth(v))).collect();
        let truth = |view: &AlignedView| truths.get(&view.frame_id()).cloned().flatten();
        for view in views {
            if let Some(Some(truth)) = truths.get(&view.frame_id()) {
                self.by_source.add(view, truth);
            }
        }
        let measured: Vec<_> = views.par_iter().map(without_guesses).collect();
        // The images of one view have one size.
        let measured: Vec<AlignedView> = measured.into_iter().filter_map(Result::ok).collect();
        Ok(self.measured.push_views(&measured, truth)?)
    }

    /// The scores, if anything could be compared.
    pub fn score(&self) -> Option<DepthScore> {
        let by_source = self.by_source.scores();
        self.measured.summary().map(|summary| DepthScore { summary, by_source })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::{BodyFrame, CameraId, LieGroup, StampedPose, Timestamp};

    #[test]
    fn keyframes_of_a_camera_that_rests_cover_what_its_track_covers() {
        let along = |step: usize| {
            let pose = |i: usize| {
                let (secs, turn) = (i as f64 * 0.05, 0.2 * (i as f64 * 0.05).sin());
                let rotation = vidar_core::So3::exp(&nalgebra::Vector3::new(0.0, 0.0, turn));
                let at = nalgebra::Vector3::new(secs.sin(), secs.cos(), 0.3 * secs);
                let time = Timestamp::from_nanos(i as i64 * 50_000_000);
                StampedPose { time, world_from_body: Se3::new(rotation, at) }
            };
            let poses = (0..=200).step_by(step).map(pose).collect();
            Trajectory::new(BodyFrame::Camera(CameraId(0)), poses).unwrap()
        };
        let truth = along(1);
        let report =
            |step| vidar_eval::evaluate_trajectory(&along(step), &truth, &Config::default().eval.trajectory);
        let (track, mut keyframes) = (report(2).unwrap(), report(40).unwrap());
        let is_low = |r: &TrajectoryReport| r.warnings.iter().any(|w| w.kind == "low-coverage");
        assert!(is_low(&keyframes) && keyframes.coverage.truth_time_ratio == 0.0);
        covered_as(&mut keyframes, &track);
        assert!(!is_low(&keyframes) && keyframes.coverage.truth_time_ratio > 0.999);
        assert_eq!((keyframes.coverage.estimate_ratio, keyframes.matched), (1.0, 6));
    }
}
