//! The page of a comparison.

use super::distance::{SurfaceDistance, summary};
use super::load::{StoredRun, differing_settings};
use super::placement::{Placed, keyframe_poses};
use crate::error::Error;
use crate::interactive::{self, Samples};
use serde_json::Value;
use std::collections::BTreeSet;
use vidar_core::Trajectory;
use vidar_view::{
    EncodedView, Field, FieldKind, FieldValues, InteractiveView, Pane, PanePath, PanesShown, PathRole,
    Report, Section, Table,
};

/// The largest end of the colour scale of distances, m: beyond it surfaces show different things, not the same one differently.
const MOST_DIFFERENCE: f32 = 0.5;
/// The smallest, m: below it the noise of any depth shows.
const LEAST_DIFFERENCE: f32 = 0.01;

pub(super) fn html(
    runs: &[StoredRun],
    placed: &[Placed],
    distances: &[SurfaceDistance],
) -> Result<String, Error> {
    let names: Vec<&str> = runs.iter().map(|r| r.name.as_str()).collect();
    let report = Report {
        title: format!("VIDAR: {}", names.join(" and ")),
        subtitle: format!("{} runs side by side; distances are those to {}", runs.len(), names[0]),
        view: Some(view(runs, placed, distances)?),
        sections: vec![numbers(runs), surfaces(runs, placed, distances), settings(runs)],
        provenance: runs
            .iter()
            .map(|r| (r.name.clone(), r.manifest.command.join(" ")))
            .chain([("version".into(), crate::VERSION.into())])
            .collect(),
        ..Report::default()
    };
    Ok(vidar_view::render_html(&report))
}

fn view(runs: &[StoredRun], placed: &[Placed], distances: &[SurfaceDistance]) -> Result<EncodedView, Error> {
    let mut paths: Vec<Trajectory> = Vec::new();
    let mut sigmas: Vec<Option<Samples>> = Vec::new();
    for (run, place) in runs.iter().zip(placed) {
        paths.push(keyframe_poses(run, &place.first_from_run)?);
        sigmas.push(interactive::depth_std(&run.folder, &run.views, run.depth_units, &place.first_from_run));
    }
    let range = difference_range(distances);
    let pane = |i: usize| -> Pane<'_> {
        let (run, scale) = (&runs[i], &runs[i].metrics.scale);
        let path = PanePath { name: "trajectory".into(), role: PathRole::Estimate, trajectory: &paths[i] };
        Pane {
            name: run.name.clone(),
            mesh: Some(&run.mesh),
            cloud: Some(&run.cloud),
            fields: vec![
                interactive::confidence_field(&run.mesh, &run.cloud),
                Field {
                    kind: FieldKind::Error,
                    label: "distance to the reference".into(),
                    values: FieldValues::Missing("the report of each run shows it".into()),
                },
                interactive::sigma_field(sigmas[i].as_ref(), interactive::unit_name(scale.is_metric)),
                difference(runs, distances, i, range),
            ],
            paths: if paths[i].is_empty() { Vec::new() } else { vec![path] },
            keyframes: interactive::thumbnails(
                &run.folder,
                &run.views,
                run.depth_units,
                &placed[i].first_from_run,
                interactive::MAX_THUMBNAILS / runs.len(),
            ),
            scale: interactive::pane_scale(scale.is_metric, scale.sigma),
        }
    };
    let view = InteractiveView {
        panes: (0..runs.len()).map(pane).collect(),
        up: match runs[0].manifest.result["metric_poses"]["source"].as_str() {
            // Levelled by gravity, however the camera was held.
            Some("odometry") => nalgebra::Vector3::z(),
            _ => paths.first().map_or_else(nalgebra::Vector3::z, vidar_view::up_of_world),
        },
        shown: PanesShown::All,
        coloring: (!distances.is_empty()).then_some(FieldKind::Difference),
    };
    Ok(vidar_view::encode_view(&view)?)
}

/// Distances of a pane: to the first run, and of the first run to the second.
fn difference<'a>(
    runs: &[StoredRun],
    distances: &'a [SurfaceDistance],
    i: usize,
    range: (f32, f32),
) -> Field<'a> {
    let found = match i {
        0 => distances.first().map(|d| (&d.from_first, d.run)),
        _ => distances.iter().find(|d| d.run == i).map(|d| (&d.to_first, 0)),
    };
    let unit = interactive::unit_name(runs[0].metrics.scale.is_metric);
    match found {
        Some((samples, other)) => Field {
            kind: FieldKind::Difference,
            label: format!("distance to {} [{unit}]", runs[other].name),
            values: FieldValues::Samples { positions: &samples.positions, values: &samples.values, range },
        },
        None => Field {
            kind: FieldKind::Difference,
            label: "distance to the other surface".into(),
            values: FieldValues::Missing("there is no other surface".into()),
        },
    }
}

/// One colour scale for all panes, else colours could not be compared.
fn difference_range(distances: &[SurfaceDistance]) -> (f32, f32) {
    let ends = distances.iter().flat_map(|d| [&d.to_first, &d.from_first]);
    let high = ends
        .map(|s| interactive::scale_range(&s.values, LEAST_DIFFERENCE).1)
        .fold(LEAST_DIFFERENCE, f32::max);
    (0.0, high.min(MOST_DIFFERENCE))
}

fn numbers(runs: &[StoredRun]) -> Section {
    let mut rows: Vec<Vec<String>> = Vec::new();
    let mut row = |name: &str, value: &dyn Fn(&StoredRun) -> String| {
        rows.push(std::iter::once(name.to_owned()).chain(runs.iter().map(value)).collect());
    };
    let text = |value: &Value| value.as_str().map_or_else(|| value.to_string(), str::to_owned);
    let count = |run: &StoredRun, key: &str| {
        run.manifest.result[key].as_u64().map_or("–".into(), |n| n.to_string())
    };
    row("verdict", &|r| r.metrics.verdict["level"].as_str().unwrap_or("–").to_owned());
    row("scale", &|r| r.metrics.scale.words.clone());
    let scores: BTreeSet<&String> = runs.iter().flat_map(|r| r.metrics.scores.keys()).collect();
    for score in scores {
        row(score, &|r| r.metrics.scores.get(score).map_or("–".into(), |v| format!("{v:.4}")));
    }
    row("area of the surface", &|r| {
        let area = r.manifest.result["coverage"]["surface_area_m2"].as_f64();
        let unit = if r.metrics.scale.is_metric { "m²" } else { "square units" };
        area.map_or("–".into(), |a| format!("{a:.1} {unit}"))
    });
    row("triangles", &|r| r.mesh.triangles.len().to_string());
    row("points", &|r| r.cloud.len().to_string());
    row("keyframes with depth", &|r| count(r, "keyframes_with_depth"));
    row("seconds", &|r| r.manifest.result["seconds"].as_f64().map_or("–".into(), |s| format!("{s:.1}")));
    row("peak memory", &|r| r.manifest.peak_memory_bytes.map_or("–".into(), crate::run::bytes));
    row("recording", &|r| text(&r.manifest.dataset["name"]));
    row("geometry", &|r| text(&r.manifest.model["name"]));
    row("coupling", &|r| text(&r.metrics.coupling));
    row("compared with", &|r| r.metrics.reference.clone());
    row("version", &|r| r.manifest.version.clone());
    row("started", &|r| r.manifest.started.clone());
    Section {
        heading: "Numbers".into(),
        tables: vec![Table {
            caption: "Scores and figures of each run".into(),
            columns: columns("What", runs),
            rows,
        }],
        ..Section::default()
    }
}

fn columns(first: &str, runs: &[StoredRun]) -> Vec<String> {
    std::iter::once(first.to_owned()).chain(runs.iter().map(|r| r.name.clone())).collect()
}

fn surfaces(runs: &[StoredRun], placed: &[Placed], distances: &[SurfaceDistance]) -> Section {
    let mut section = Section { heading: "Surfaces".into(), ..Section::default() };
    for (run, place) in runs.iter().zip(placed).skip(1) {
        section.paragraphs.push(format!("{}: {}.", run.name, place.words()));
    }
    let first = &runs[0].name;
    let row = |what: String, samples: &Samples| {
        let s = summary(samples);
        let length = |v: f64| format!("{v:.4}");
        vec![what, length(s.median), length(s.mean), length(s.p90), format!("{:.1} %", 100.0 * s.same)]
    };
    let rows: Vec<Vec<String>> = distances
        .iter()
        .flat_map(|d| {
            let name = &runs[d.run].name;
            [row(format!("{name} to {first}"), &d.to_first), row(format!("{first} to {name}"), &d.from_first)]
        })
        .collect();
    if rows.is_empty() {
        section.paragraphs.push("There are no two surfaces to measure between.".into());
        return section;
    }
    let unit = interactive::unit_name(runs[0].metrics.scale.is_metric);
    section.tables.push(Table {
        caption: "Distance of points of one surface to the nearest of the other".into(),
        columns: vec![
            "From, to".into(),
            format!("median [{unit}]"),
            format!("mean [{unit}]"),
            format!("90 % below [{unit}]"),
            "within 5 cm".into(),
        ],
        rows,
    });
    section
}

fn settings(runs: &[StoredRun]) -> Section {
    let mut section = Section { heading: "Settings that differ".into(), ..Section::default() };
    let cell = |value: &Value| match value {
        Value::Null => "–".to_owned(),
        Value::String(text) => text.clone(),
        other => other.to_string(),
    };
    let rows: Vec<Vec<String>> = differing_settings(runs)
        .into_iter()
        .map(|(key, values)| {
            std::iter::once(key).chain(values.as_array().into_iter().flatten().map(cell)).collect()
        })
        .collect();
    match rows.is_empty() {
        true => section.paragraphs.push("None.".into()),
        false => section.tables.push(Table { caption: String::new(), columns: columns("Key", runs), rows }),
    }
    section
}
