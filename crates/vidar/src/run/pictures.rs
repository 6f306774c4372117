//! Figures of a run and its one-file report.

use super::summary::area;
use super::{RunOutcome, RunRequest};
use crate::error::Error;
use crate::evaluate::{refinement, surface_lines, trajectory_lines};
use crate::events::{Event, Events};
use crate::input::truth_in_camera;
use crate::run_folder::{RunFolder, StoredView};
use vidar_core::Trajectory;
use vidar_dataset::Recording;
use vidar_view::{
    AxisSpec, Figure, FigureWidth, Histogram, MapCamera, MapSurface, Picture, PictureSize, PlotTrajectory,
    Report, Section, Shading, SummaryItem, Table, TrajectoryPlot, Viewpoint,
};

const MAP_SIZE: (usize, usize) = (960, 640);
/// Name of the trajectory by which chunks were placed.
const METRIC: &str = "metric trajectory";
const PLOT_SIZE: (usize, usize) = (960, 640);
/// Keyframes shown with image and depth, spread over the run.
const SHOWN_VIEWS: usize = 6;

/// Draws everything and writes `pictures/*.png` and `report.html`.
pub fn draw(
    outcome: &RunOutcome,
    dataset: &Recording,
    request: &RunRequest,
    folder: &RunFolder,
    events: &Events,
) -> Result<(), Error> {
    let mut album = Album { folder, events };
    let path = outcome.map.keyframe_trajectory();
    let up = outcome.map.up(outcome.plan.mode);
    let report = Report {
        title: format!("VIDAR: {}", dataset.name),
        subtitle: format!(
            "{}; metric poses: {}; coupling: {}",
            outcome.plan.input,
            outcome.map.poses(),
            outcome.plan.mode
        ),
        assessment: Some(outcome.verdict.assessment()),
        summary: summary(outcome),
        view: super::view::encoded(outcome, dataset, folder, &up)?,
        sections: vec![
            map_section(outcome, path.as_ref(), &up, &mut album)?,
            evaluation_section(outcome, path.as_ref(), &up, &mut album)?,
            trajectory_section(outcome, dataset, &up, &mut album)?,
            depth_section(outcome, folder, &mut album)?,
            plan_section(outcome),
        ],
        warnings: outcome.warnings.clone(),
        provenance: vec![
            ("command".into(), request.command.join(" ")),
            ("version".into(), crate::VERSION.into()),
            ("started".into(), outcome.plan.started.clone()),
            ("model".into(), format!("{} ({})", outcome.plan.model.name, outcome.plan.model.licence)),
        ],
    };
    let html = vidar_view::render_html(&report);
    let bytes = folder.write("report.html", html.as_bytes())?;
    events.emit(&Event::ArtifactWritten { path: "report.html".into(), bytes });
    Ok(())
}

struct Album<'a> {
    folder: &'a RunFolder,
    events: &'a Events,
}

impl Album<'_> {
    fn figure(
        &mut self,
        name: &str,
        picture: &Picture,
        caption: &str,
        width: FigureWidth,
    ) -> Result<Figure, Error> {
        let png = vidar_view::encode_png(picture)?;
        let path = format!("pictures/{name}.png");
        let bytes = self.folder.write(&path, &png)?;
        self.events.emit(&Event::ArtifactWritten { path, bytes });
        Ok(Figure { png, caption: caption.to_owned(), alt: caption.to_owned(), width })
    }
}

fn summary(outcome: &RunOutcome) -> Vec<SummaryItem> {
    let item = |label: &str, value: String, why: &str| SummaryItem {
        label: label.into(),
        value,
        explanation: why.into(),
    };
    let mut items = Vec::new();
    if let Some(surface) = &outcome.evaluation.surface {
        for s in &surface.rigid {
            items.push(item(
                &format!("F@{:.2} m", s.threshold_m),
                format!("{:.3}", s.f),
                "harmonic mean of precision and recall at this distance, rigid fit: scale as it is",
            ));
        }
        if let Some(s) = surface.native.last() {
            items.push(item(
                &format!("F@{:.2} m refined", s.threshold_m),
                format!("{:.3}", s.f),
                &format!("the paper's bounded placement: {}", refinement(surface)),
            ));
        }
    }
    items.push(item("scale", scale_item(outcome), &outcome.scale.words));
    if let Some(t) = &outcome.evaluation.trajectory {
        if let Some(ate) = &t.ate_se3_m {
            items.push(item(
                "ATE SE(3)",
                format!("{:.3} m", ate.rmse),
                "RMSE of positions after a rigid fit",
            ));
        }
        if let Some(scale) = t.scale_error {
            items.push(item("|ln s|", format!("{scale:.4}"), "scale error: 0.01 is one percent"));
        }
    }
    if let Some(m) = outcome.evaluation.depth.as_ref().and_then(|d| d.summary.pixel_weighted.metric) {
        items.push(item(
            "depth AbsRel",
            format!("{:.4}", m.abs_rel),
            "mean relative depth error against the depth sensor",
        ));
    }
    items.push(item(
        "keyframes",
        format!("{}/{}", outcome.map.views.len(), outcome.map.keyframes.len()),
        "with depth, of all chosen",
    ));
    items.push(item(
        "surface",
        area(outcome.map.surface.coverage.surface_area_m2, outcome.is_metric(), 1),
        "area of the mesh",
    ));
    items
}

fn scale_item(outcome: &RunOutcome) -> String {
    let known = outcome.scale.sigma.map(|sigma| format!("σ {:.1} %", 100.0 * sigma));
    known.unwrap_or_else(|| "σ not known".into())
}

fn volume(value: f64, is_metric: bool) -> String {
    format!("{value:.2} {}", if is_metric { "m³" } else { "cubic units (not metres)" })
}

fn size(of: (usize, usize)) -> PictureSize {
    PictureSize::new(of.0, of.1)
}

fn map_section(
    outcome: &RunOutcome,
    path: Option<&Trajectory>,
    up: &nalgebra::Vector3<f64>,
    album: &mut Album<'_>,
) -> Result<Section, Error> {
    let mesh = &outcome.map.surface.mesh;
    let mut section = Section { heading: "Map".into(), ..Section::default() };
    if mesh.triangles.is_empty() {
        section.paragraphs.push("The map has no triangle.".into());
        return Ok(section);
    }
    let aspect = MAP_SIZE.0 as f64 / MAP_SIZE.1 as f64;
    for viewpoint in Viewpoint::ALL {
        let camera = MapCamera::fixed(viewpoint, &mesh.positions, path, up, aspect);
        let picture =
            vidar_view::render_map(MapSurface::Mesh(mesh), &camera, size(MAP_SIZE), Shading::Color)?;
        let name = format!("map-{}", viewpoint.name());
        section.figures.push(album.figure(&name, &picture, viewpoint.caption(), FigureWidth::Half)?);
    }
    let c = &outcome.map.surface.coverage;
    section.tables.push(Table {
        caption: "Coverage".into(),
        columns: vec!["What".into(), "Value".into()],
        rows: vec![
            vec!["triangles".into(), mesh.triangles.len().to_string()],
            vec!["points".into(), outcome.map.surface.cloud.len().to_string()],
            vec!["area".into(), area(c.surface_area_m2, outcome.is_metric(), 2)],
            vec!["observed volume".into(), volume(c.observed_volume_m3, outcome.is_metric())],
            vec!["views per surface voxel".into(), format!("{:.1}", c.mean_observations)],
            vec!["seen by three views or more".into(), format!("{:.1} %", c.share_seen_by_3_or_more * 100.0)],
            vec![
                "there twice (ghosts; real layers count too)".into(),
                outcome
                    .map
                    .surface
                    .double_walls
                    .map_or_else(|| "–".into(), |d| format!("{:.1} %", d.rate * 100.0)),
            ],
        ],
    });
    Ok(section)
}

fn evaluation_section(
    outcome: &RunOutcome,
    path: Option<&Trajectory>,
    up: &nalgebra::Vector3<f64>,
    album: &mut Album<'_>,
) -> Result<Section, Error> {
    let mut section = Section { heading: "Evaluation".into(), ..Section::default() };
    section.paragraphs.push(format!("Compared with {}.", outcome.plan.reference));
    if outcome.map.uses_ground_truth() {
        section.paragraphs.push("Poses are ground truth: dense scores are an upper bound, and trajectory scores are left out because they would compare ground truth with itself.".into());
    }
    if let Some(surface) = &outcome.evaluation.surface {
        section.tables.push(table(
            "Surface: rigid fit, and with the scale refined (the paper's bounded placement, section IV-B)",
            surface_lines(surface),
        ));
    }
    if let Some(depth) = &outcome.evaluation.depth {
        let p = &depth.summary.pixel_weighted;
        let mut rows = vec![vec!["completeness".into(), format!("{:.1} %", p.completeness * 100.0)]];
        if let Some(m) = &p.metric {
            rows.push(vec!["AbsRel".into(), format!("{:.4}", m.abs_rel)]);
            rows.push(vec!["RMSE".into(), format!("{:.4} m", m.rmse_m)]);
            rows.push(vec!["δ < 1.25".into(), format!("{:.4}", m.delta_1)]);
        }
        let columns = vec!["Score".into(), "Value".into()];
        section.tables.push(Table {
            caption: format!("Depth of {} keyframes against the sensor", depth.summary.frames),
            columns,
            rows,
        });
    }
    if let Some((cloud, errors)) = &outcome.evaluation.error_cloud {
        let camera = MapCamera::fixed(
            Viewpoint::Top,
            &cloud.positions,
            path,
            up,
            MAP_SIZE.0 as f64 / MAP_SIZE.1 as f64,
        );
        let shading =
            Shading::Error { values: errors, range: (0.0, 0.1), label: "distance to reference [m]" };
        let picture = vidar_view::render_map(MapSurface::Cloud(cloud), &camera, size(MAP_SIZE), shading)?;
        section.figures.push(album.figure(
            "error-top",
            &picture,
            "Distance of the map to the reference, from above",
            FigureWidth::Half,
        )?);
        let values: Vec<f64> = errors.iter().map(|&e| f64::from(e)).collect();
        let histogram = Histogram {
            title: "Distance of the map's points to the reference".into(),
            x: AxisSpec::new("distance", "m").between(0.0, 0.2),
            values,
            markers: Vec::new(),
        };
        let picture = vidar_view::plot_histogram(&histogram, size(PLOT_SIZE));
        section.figures.push(album.figure(
            "error-histogram",
            &picture,
            "How many points lie how far from the reference",
            FigureWidth::Half,
        )?);
    }
    Ok(section)
}

fn trajectory_section(
    outcome: &RunOutcome,
    dataset: &Recording,
    up: &nalgebra::Vector3<f64>,
    album: &mut Album<'_>,
) -> Result<Section, Error> {
    let mut section = Section { heading: "Trajectory".into(), ..Section::default() };
    section.paragraphs.push(format!("Scale: {}.", outcome.scale.words));
    if let Some(quality) = &outcome.map.quality {
        section.paragraphs.push(format!("Odometry: {}.", quality.words()));
    }
    // Where it cannot be compared, the evaluation has said so.
    let truth = truth_in_camera(dataset).ok().flatten();
    let evaluation = &outcome.evaluation;
    let moved = outcome.plan.mode.chains().then(|| outcome.map.keyframe_trajectory()).flatten();
    let metric = outcome.map.trajectory.as_ref().map(|t| t.camera_trajectory.clone());
    let (map, metric) = match moved {
        Some(map) => {
            let metric = metric.map(|t| (t, METRIC, &evaluation.metric_trajectory));
            (Some((map, "map", &evaluation.trajectory)), metric)
        }
        None => (metric.map(|t| (t, METRIC, &evaluation.trajectory)), None),
    };
    let mut placed = Vec::new();
    for (trajectory, name, report) in [map, metric].into_iter().flatten() {
        let truth_from = report.as_ref().and_then(|t| {
            section
                .tables
                .push(table(&format!("Poses of the {name} against ground truth"), trajectory_lines(t)));
            t.truth_from_estimate_se3?.to_se3()
        });
        let is_truth = name == METRIC && outcome.map.uses_ground_truth();
        let shown = truth_from.and_then(|t| aligned(&trajectory, t)).unwrap_or(trajectory);
        placed.push((shown, name, is_truth));
    }
    let mut shown = Vec::new();
    if let (Some(truth), false) = (&truth, placed.iter().any(|(_, _, is_truth)| *is_truth)) {
        shown.push(PlotTrajectory::ground_truth("ground truth", truth));
    }
    let labels: Vec<String> = placed.iter().map(|(_, name, _)| format!("{name}, rigidly aligned")).collect();
    for ((trajectory, _, is_truth), label) in placed.iter().zip(&labels) {
        shown.push(match is_truth {
            true => PlotTrajectory::ground_truth("ground truth (the metric trajectory)", trajectory),
            false => PlotTrajectory::estimate(label, trajectory),
        });
    }
    let plot = TrajectoryPlot { up: *up, ..TrajectoryPlot::default() };
    let picture = vidar_view::plot_trajectories(&shown, &plot, size(PLOT_SIZE));
    section.figures.push(album.figure(
        "trajectory",
        &picture,
        "Path of the camera from above and from the side",
        FigureWidth::Full,
    )?);
    Ok(section)
}

fn aligned(trajectory: &Trajectory, truth_from_estimate: vidar_core::Se3) -> Option<Trajectory> {
    let poses = trajectory
        .poses()
        .iter()
        .map(|p| vidar_core::StampedPose {
            time: p.time,
            world_from_body: truth_from_estimate * p.world_from_body,
        })
        .collect();
    Trajectory::new(trajectory.body(), poses).ok()
}

fn depth_section(outcome: &RunOutcome, folder: &RunFolder, album: &mut Album<'_>) -> Result<Section, Error> {
    let mut section = Section { heading: "Depth".into(), ..Section::default() };
    let views = &outcome.map.views;
    let n = views.len();
    let shown: Vec<&StoredView> =
        (0..SHOWN_VIEWS.min(n)).map(|i| &views[i * n / SHOWN_VIEWS.min(n)]).collect();
    for view in shown {
        if let Some(picture) = view_picture(view, outcome, folder) {
            let caption = format!("Frame {}: image and depth", view.frame);
            section.figures.push(album.figure(
                &format!("depth-{:06}", view.frame),
                &picture,
                &caption,
                FigureWidth::Half,
            )?);
        }
    }
    if section.figures.is_empty() {
        section.paragraphs.push("No depth image was written.".into());
    }
    Ok(section)
}

/// Image and depth of a view, read back from what was written.
fn view_picture(view: &StoredView, outcome: &RunOutcome, folder: &RunFolder) -> Option<Picture> {
    let read = |path: &Option<String>| std::fs::read(folder.path().join(path.as_ref()?)).ok();
    let depth = vidar_export::read_depth_png(&read(&view.depth)?, outcome.plan.depth_units_per_metre).ok()?;
    let depth = vidar_view::depth_picture(depth.image(), None);
    let image = view
        .image
        .as_ref()
        .and_then(|path| vidar_dataset::decode::read_image(&folder.path().join(path)).ok());
    match image {
        Some(image) => Some(vidar_view::side_by_side(&[("image", &image.to_rgb8()), ("depth", &depth)])),
        None => Some(depth),
    }
}

fn plan_section(outcome: &RunOutcome) -> Section {
    let rows = outcome.plan.lines().into_iter().map(|(k, v)| (k.to_owned(), v)).collect();
    Section { heading: "How it was made".into(), tables: vec![table("Plan", rows)], ..Section::default() }
}

fn table(caption: &str, lines: Vec<(String, String)>) -> Table {
    Table {
        caption: caption.into(),
        columns: vec!["What".into(), "Value".into()],
        rows: lines.into_iter().map(|(k, v)| vec![k, v]).collect(),
    }
}
