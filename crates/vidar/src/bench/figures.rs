//! The report of a bench: tables, trajectories from above, errors of the surface.

use super::{BenchOutcome, BenchRequest, Cells};
use crate::error::Error;
use std::path::Path;
use vidar_core::Trajectory;
use vidar_dataset::TrajectoryReadOptions;
use vidar_view::{Figure, FigureWidth, PictureSize, PlotTrajectory, Report, Section, Table, TrajectoryPlot};

const PLOT_SIZE: (usize, usize) = (960, 640);

/// One self-contained HTML file.
pub(super) fn report(request: &BenchRequest, outcome: &BenchOutcome, cells: &Cells) -> Result<String, Error> {
    let tables = cells
        .grids
        .iter()
        .map(|g| Table { caption: g.caption.clone(), columns: g.columns.clone(), rows: g.rows.clone() })
        .collect();
    let mut sections = vec![Section {
        heading: "Tables".into(),
        paragraphs: cells.notes.clone(),
        tables,
        ..Section::default()
    }];
    for sequence in &outcome.sequences {
        sections.push(sequence_section(request, outcome, sequence)?);
    }
    let title = format!("VIDAR: {:?} bench", request.kind);
    let report = Report {
        title,
        subtitle: format!("{} sequences, {} couplings", outcome.sequences.len(), request.modes.len()),
        sections,
        provenance: vec![
            ("command".into(), request.command.join(" ")),
            ("version".into(), crate::VERSION.into()),
        ],
        ..Report::default()
    };
    Ok(vidar_view::render_html(&report))
}

/// Paths from above, and the distance of each map to the scan.
fn sequence_section(
    request: &BenchRequest,
    outcome: &BenchOutcome,
    sequence: &str,
) -> Result<Section, Error> {
    let mut section = Section { heading: sequence.to_owned(), ..Section::default() };
    let rows = outcome.rows.iter().filter(|r| r.sequence == sequence && r.failure.is_none());
    for row in rows {
        let folder = request.out.join(&row.folder);
        let caption = match row.f10 {
            Some(f) => format!("{}: F@0.10 {f:.3}", row.mode),
            None => row.mode.to_string(),
        };
        for (name, what) in
            [("trajectory", "paths"), ("error-top", "distance of the map to the scan, from above")]
        {
            let Ok(png) = std::fs::read(folder.join(format!("pictures/{name}.png"))) else { continue };
            let caption = format!("{caption}; {what}");
            section.figures.push(Figure { png, alt: caption.clone(), caption, width: FigureWidth::Half });
        }
    }
    let odometry = outcome.odometry.iter().filter(|r| r.sequence == sequence && r.failure.is_none());
    for row in odometry {
        let file = request.out.join(&row.folder).join("trajectory/odometry_body.tum");
        if let Some(picture) = path_picture(&file, row.with_imu) {
            let name =
                if row.with_imu { "odometry, camera and IMU" } else { "odometry, camera only (up to scale)" };
            let png = vidar_view::encode_png(&picture)?;
            section.figures.push(Figure {
                png,
                alt: name.to_owned(),
                caption: name.to_owned(),
                width: FigureWidth::Half,
            });
        }
    }
    Ok(section)
}

/// A trajectory file from above; `None` if it cannot be read. With an IMU its world has z up.
fn path_picture(file: &Path, with_imu: bool) -> Option<vidar_view::Picture> {
    let (trajectory, _): (Trajectory, _) =
        vidar_dataset::read_trajectory(file, &TrajectoryReadOptions::default()).ok()?;
    let shown = [PlotTrajectory::estimate("odometry", &trajectory)];
    let up = if with_imu { nalgebra::Vector3::z() } else { vidar_view::up_of_world(&trajectory) };
    let plot = TrajectoryPlot { up, ..TrajectoryPlot::default() };
    Some(vidar_view::plot_trajectories(&shown, &plot, PictureSize::new(PLOT_SIZE.0, PLOT_SIZE.1)))
}
