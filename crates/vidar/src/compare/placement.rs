//! Runs in the world of the first one: by the poses of keyframes of the same times, where there are such.

use super::load::StoredRun;
use crate::error::Error;
use crate::interactive::move_surface;
use crate::run::pose_of;
use serde_json::{Value, json};
use vidar_core::{BodyFrame, CameraId, Se3, Sim3, StampedPose, Timestamp, Trajectory};
use vidar_eval::{TrajectoryEvalConfig, TrajectoryReport};

/// Where a run was placed, and how.
#[derive(Clone, Debug)]
pub(super) struct Placed {
    /// The first run's world from the run's own.
    pub first_from_run: Sim3,
    how: How,
}

#[derive(Clone, Debug)]
enum How {
    /// It is the first.
    First,
    /// By poses of the same times: how many, RMS of their distances afterwards (m), whether the scale was free.
    Poses { matched: usize, rms_m: f64, is_scaled: bool },
    /// Its world is taken as it is, for this reason.
    AsItIs(String),
}

impl Placed {
    pub(super) fn words(&self) -> String {
        match &self.how {
            How::First => "the world of this page".into(),
            How::Poses { matched, rms_m, is_scaled } => {
                let kind = match is_scaled {
                    true => format!("similarity with scale {:.4}", self.first_from_run.scale),
                    false => "rigid fit".to_owned(),
                };
                format!("{kind} of {matched} keyframes of the same times, {rms_m:.4} m RMS")
            }
            How::AsItIs(reason) => format!("in its own world as it is: {reason}"),
        }
    }

    pub(super) fn json(&self) -> Value {
        match &self.how {
            How::First => json!({ "by": "first" }),
            How::Poses { matched, rms_m, .. } => {
                json!({ "by": "poses", "matched": matched, "rms_m": rms_m, "scale": self.first_from_run.scale })
            }
            How::AsItIs(reason) => json!({ "by": "as-it-is", "reason": reason }),
        }
    }
}

/// Moves the surfaces of all runs but the first into its world; views keep their own poses.
pub(super) fn place(runs: &mut [StoredRun]) -> Result<Vec<Placed>, Error> {
    let mut placed = vec![Placed { first_from_run: Sim3::IDENTITY, how: How::First }];
    for i in 1..runs.len() {
        let found = placement(&runs[0], &runs[i])?;
        let run = &mut runs[i];
        move_surface(&mut run.mesh.positions, &mut run.mesh.normals, &found.first_from_run);
        move_surface(&mut run.cloud.positions, &mut run.cloud.normals, &found.first_from_run);
        placed.push(found);
    }
    Ok(placed)
}

fn placement(first: &StoredRun, run: &StoredRun) -> Result<Placed, Error> {
    let as_it_is = |reason: String| Placed { first_from_run: Sim3::IDENTITY, how: How::AsItIs(reason) };
    let truth = keyframe_poses(first, &Sim3::IDENTITY)?;
    let estimate = keyframe_poses(run, &Sim3::IDENTITY)?;
    let report = match vidar_eval::evaluate_trajectory(&estimate, &truth, &TrajectoryEvalConfig::default()) {
        Ok(report) => report,
        Err(error) => return Ok(as_it_is(error.to_string())),
    };
    // A rigid fit shows a difference of scale; where one of the scales is arbitrary there is nothing to show.
    let is_scaled = !(first.metrics.scale.is_metric && run.metrics.scale.is_metric);
    Ok(of_report(&report, is_scaled)
        .unwrap_or_else(|| as_it_is("the motion does not determine a fit".into())))
}

fn of_report(report: &TrajectoryReport, is_scaled: bool) -> Option<Placed> {
    let (first_from_run, errors) = match is_scaled {
        true => (report.truth_from_estimate_sim3?.to_sim3()?, report.ate_sim3_m.as_ref()?),
        false => (Sim3::from_se3(&report.truth_from_estimate_se3?.to_se3()?), report.ate_se3_m.as_ref()?),
    };
    let how = How::Poses { matched: report.matched, rms_m: errors.rmse, is_scaled };
    Some(Placed { first_from_run, how })
}

/// Poses of the keyframes of a run, in a frame `a` of the caller's.
pub(super) fn keyframe_poses(run: &StoredRun, a_from_world: &Sim3) -> Result<Trajectory, Error> {
    let mut poses: Vec<StampedPose> = run
        .views
        .iter()
        .filter_map(|view| {
            let world_from_camera: Se3 = pose_of(view)?;
            let time = Timestamp::from_nanos(view.time_ns);
            Some(StampedPose { time, world_from_body: a_from_world.transform_pose(&world_from_camera) })
        })
        .collect();
    poses.sort_by_key(|p| p.time);
    // The file may be anyone's.
    poses.dedup_by_key(|p| p.time);
    Ok(Trajectory::new(BodyFrame::Camera(CameraId(0)), poses)?)
}
