//! The three-dimensional view of a run's report: the map beside its reference.

use super::RunOutcome;
use crate::error::Error;
use crate::input::truth_in_camera;
use crate::interactive::{self, inverse, moved_trajectory};
use crate::run_folder::RunFolder;
use vidar_core::{PointCloud, Se3, Sim3, Trajectory};
use vidar_dataset::Recording;
use vidar_view::{
    EncodedView, Field, FieldKind, FieldValues, InteractiveView, Pane, PanePath, PaneScale, PanesShown,
    PathRole,
};

/// Distances to the reference at the ends of the colour scale, as in the pictures, m.
const ERROR_RANGE: (f32, f32) = (0.0, 0.1);

/// The view, in the world of the map; none where there is no surface to look at.
pub(super) fn encoded(
    outcome: &RunOutcome,
    dataset: &Recording,
    folder: &RunFolder,
    up: &nalgebra::Vector3<f64>,
) -> Result<Option<EncodedView>, Error> {
    let surface = &outcome.map.surface;
    if surface.mesh.triangles.is_empty() && surface.cloud.is_empty() {
        return Ok(None);
    }
    let units = Some(outcome.plan.depth_units_per_metre);
    let sigma = interactive::depth_std(folder.path(), &outcome.map.views, units, &Sim3::IDENTITY);
    let path = outcome.map.keyframe_trajectory();
    let metric = outcome.map.trajectory.as_ref().map(|t| &t.camera_trajectory);
    let truth = truth_of_map(outcome, dataset);
    let paths = paths(outcome, path.as_ref(), metric, truth.as_ref());
    let map = Pane {
        name: "map".into(),
        mesh: Some(&surface.mesh),
        cloud: Some(&surface.cloud),
        fields: vec![
            interactive::confidence_field(&surface.mesh, &surface.cloud),
            error_field(outcome),
            interactive::sigma_field(sigma.as_ref(), interactive::unit_name(outcome.is_metric())),
        ],
        paths,
        keyframes: interactive::thumbnails(
            folder.path(),
            &outcome.map.views,
            units,
            &Sim3::IDENTITY,
            interactive::MAX_THUMBNAILS,
        ),
        scale: interactive::pane_scale(outcome.is_metric(), outcome.scale.sigma),
    };
    let reference = reference_in_map(outcome);
    let beside = reference.as_ref().map(|cloud| Pane {
        name: "reference".into(),
        mesh: None,
        cloud: Some(cloud),
        fields: Vec::new(),
        paths: Vec::new(),
        keyframes: Vec::new(),
        scale: PaneScale::Reference,
    });
    let panes: Vec<Pane<'_>> = std::iter::once(map).chain(beside).collect();
    let view = InteractiveView { panes, up: *up, shown: PanesShown::First, coloring: None };
    Ok(Some(vidar_view::encode_view(&view)?))
}

/// The trajectory of all images where it is the map's own, else that of the keyframes; and ground truth.
fn paths<'a>(
    outcome: &RunOutcome,
    keyframes: Option<&'a Trajectory>,
    metric: Option<&'a Trajectory>,
    truth: Option<&'a Trajectory>,
) -> Vec<PanePath<'a>> {
    // Where chunks are chained, the metric trajectory lies elsewhere than the map.
    let own = if outcome.plan.mode.chains() { keyframes } else { metric.or(keyframes) };
    let own =
        own.map(|trajectory| PanePath { name: "trajectory".into(), role: PathRole::Estimate, trajectory });
    let truth =
        truth.map(|trajectory| PanePath { name: "ground truth".into(), role: PathRole::Truth, trajectory });
    own.into_iter().chain(truth).collect()
}

/// Ground truth in the world of the map, rigidly aligned; none where the map's poses are ground truth themselves.
fn truth_of_map(outcome: &RunOutcome, dataset: &Recording) -> Option<Trajectory> {
    let report = outcome.evaluation.trajectory.as_ref()?;
    let truth_from_map = report.truth_from_estimate_se3?.to_se3()?;
    moved_trajectory(&truth_in_camera(dataset).ok()??, &inverse(&truth_from_map))
}

/// The reference in the world of the map, by the rigid fit that its scores have.
fn reference_in_map(outcome: &RunOutcome) -> Option<PointCloud> {
    let evaluation = &outcome.evaluation;
    let truth_from_map: Se3 = evaluation.surface.as_ref()?.rigid_placement.to_se3()?;
    let mut cloud = evaluation.reference.clone()?;
    interactive::move_surface(&mut cloud.positions, &mut cloud.normals, &inverse(&truth_from_map));
    Some(cloud)
}

fn error_field(outcome: &RunOutcome) -> Field<'_> {
    let values = match &outcome.evaluation.error_cloud {
        Some((cloud, errors)) => {
            FieldValues::Samples { positions: &cloud.positions, values: errors, range: ERROR_RANGE }
        }
        None => FieldValues::Missing("there is no reference to compare with".into()),
    };
    Field { kind: FieldKind::Error, label: "distance to the reference [m]".into(), values }
}
