//! `report.html` of `vidar odometry`: the path, and over time tracks, time per image, biases and standard deviations.

use super::OdometryOutcome;
use crate::error::Error;
use crate::run_folder::RunFolder;
use vidar_core::{StampedPose, Trajectory};
use vidar_eval::{TrajectoryReport, TransformRecord};
use vidar_odometry::Tracking;
use vidar_view::{
    AxisSpec, Figure, FigureWidth, LinePlot, PictureSize, PlotTrajectory, Report, Section, Series,
    SummaryItem, TrajectoryPlot,
};

/// Columns and rows of the pictures.
const PLOT_SIZE: (usize, usize) = (720, 320);
const PATH_SIZE: (usize, usize) = (1100, 560);

/// Writes the report and its pictures; names of the files made.
pub(super) fn write(
    outcome: &OdometryOutcome,
    truth: Option<&Trajectory>,
    title: &str,
    command: &[String],
    folder: &RunFolder,
) -> Result<Vec<String>, Error> {
    let mut made = Vec::new();
    let mut figure = |name: &str, picture: vidar_view::Picture, caption: &str, width| {
        let png = vidar_view::encode_png(&picture)?;
        let path = format!("pictures/{name}.png");
        folder.write(&path, &png)?;
        made.push(path);
        Ok::<_, Error>(Figure { png, caption: caption.to_owned(), alt: caption.to_owned(), width })
    };
    let mut path = Section { heading: "Path".into(), ..Section::default() };
    if let Some(trajectory) = &outcome.trajectory {
        let picture = path_picture(outcome, trajectory, truth);
        let caption = "Path of the body from above and from the side: as it was estimated live and as adjusted after the end, each aligned with ground truth where there is one";
        path.figures.push(figure("odometry_path", picture, caption, FigureWidth::Full)?);
    }
    path.paragraphs.extend(outcome.tracked.lost.iter().map(|l| {
        let at = vidar_core::Timestamp::from_nanos(l.from_ns);
        format!("Lost at {at} s: {}.", l.reason)
    }));
    let mut time = Section { heading: "Over time".into(), ..Section::default() };
    for (name, plot, caption) in plots(outcome) {
        let picture = vidar_view::plot_lines(&plot, PictureSize::new(PLOT_SIZE.0, PLOT_SIZE.1));
        time.figures.push(figure(name, picture, caption, FigureWidth::Half)?);
    }
    let summary = outcome.summary_lines().into_iter().map(|(label, value)| SummaryItem {
        label: label.into(),
        value,
        explanation: String::new(),
    });
    let report = Report {
        title: format!("VIDAR odometry: {title}"),
        subtitle: unit(outcome).into(),
        assessment: Some(outcome.verdict.assessment()),
        summary: summary.collect(),
        sections: vec![path, time],
        view: None,
        warnings: outcome.warnings.clone(),
        provenance: vec![("command".into(), command.join(" ")), ("version".into(), crate::VERSION.into())],
    };
    folder.write("report.html", vidar_view::render_html(&report).as_bytes())?;
    made.push("report.html".into());
    Ok(made)
}

fn unit(outcome: &OdometryOutcome) -> &'static str {
    if outcome.scale.is_metric { "lengths in metres" } else { "lengths are not metres" }
}

fn path_picture(
    outcome: &OdometryOutcome,
    trajectory: &Trajectory,
    truth: Option<&Trajectory>,
) -> vidar_view::Picture {
    let plot = TrajectoryPlot { up: nalgebra::Vector3::z(), ..TrajectoryPlot::default() };
    let size = PictureSize::new(PATH_SIZE.0, PATH_SIZE.1);
    let last = outcome.final_trajectory.as_ref();
    let estimates: Vec<_> =
        [("live", Some(trajectory), &outcome.report), ("final", last, &outcome.final_report)]
            .into_iter()
            .filter_map(|(label, trajectory, report)| {
                let trajectory = trajectory?;
                let aligned = alignment(report, outcome).and_then(|a| moved(trajectory, &a));
                Some((label, aligned.is_some(), aligned.unwrap_or_else(|| trajectory.clone())))
            })
            .collect();
    let mut shown: Vec<_> =
        estimates.iter().map(|(label, _, t)| PlotTrajectory::estimate(label, t)).collect();
    // What is not aligned is in another frame than ground truth.
    if let (Some(truth), true) = (truth, estimates.iter().all(|(_, is_aligned, _)| *is_aligned)) {
        shown.push(PlotTrajectory::ground_truth("ground truth", truth));
    }
    vidar_view::plot_trajectories(&shown, &plot, size)
}

/// What places an estimate on ground truth: with its own scale where that is metric.
fn alignment(report: &Option<TrajectoryReport>, outcome: &OdometryOutcome) -> Option<TransformRecord> {
    let report = report.as_ref()?;
    match outcome.scale.is_metric {
        true => report.truth_from_estimate_se3,
        false => report.truth_from_estimate_sim3,
    }
}

/// The trajectory as `record` places it.
fn moved(trajectory: &Trajectory, record: &TransformRecord) -> Option<Trajectory> {
    let rigid = TransformRecord { scale: 1.0, ..*record }.to_se3()?;
    let poses = trajectory.poses().iter().map(|p| {
        let mut world_from_body = p.world_from_body;
        world_from_body.translation *= record.scale;
        StampedPose { world_from_body: rigid * world_from_body, ..*p }
    });
    Trajectory::new(trajectory.body(), poses.collect()).ok()
}

/// Name, plot and caption of every picture over time.
fn plots(outcome: &OdometryOutcome) -> Vec<(&'static str, LinePlot, &'static str)> {
    let frames = &outcome.tracked.frames;
    let begin = frames.first().map_or(0, |f| f.output.time.nanos());
    let secs = |ns: i64| (ns - begin) as f64 * 1e-9;
    let over_time = |value: &dyn Fn(&Tracking) -> f64| -> Vec<[f64; 2]> {
        let state = |f: &super::TrackedFrame| f.output.tracking().map_or(f64::NAN, value);
        frames.iter().map(|f| [secs(f.output.time.nanos()), state(f)]).collect()
    };
    let line = |label: &str, value: &dyn Fn(&Tracking) -> f64| Series::line(label, over_time(value));
    let sigma =
        |t: &Tracking, at: usize| (0..3).map(|k| t.covariance[(at + k, at + k)]).sum::<f64>().max(0.0).sqrt();
    let plot = |y: AxisSpec, series: Vec<Series>| LinePlot {
        x: AxisSpec::new("time", "s"),
        y,
        series,
        ..LinePlot::default()
    };
    let tracks = vec![
        line("landmarks that fit", &|t| t.tracked as f64),
        line("landmarks looked for", &|t| t.tracks.landmarks_tried as f64),
        line("seeds", &|t| t.tracks.seeds_found as f64),
        line("contradicting", &|t| t.tracks.contradicting as f64),
    ];
    let millis = frames.iter().map(|f| [secs(f.output.time.nanos()), 1e3 * f.seconds]).collect();
    let axes = ["x", "y", "z"];
    let gyro = (0..3).map(|k| line(axes[k], &|t| t.state.gyro_bias[k])).collect();
    let accel = (0..3).map(|k| line(axes[k], &|t| t.state.accel_bias[k])).collect();
    let mut all = vec![
        ("odometry_tracks", plot(AxisSpec::new("tracks", "").from_zero(), tracks), "Tracks in every image"),
        (
            "odometry_time",
            plot(AxisSpec::new("time per image", "ms").from_zero(), vec![Series::dots("", millis)]),
            "Wall time per image, decoding left out",
        ),
    ];
    if outcome.tracked.with_imu {
        all.extend([
            ("odometry_gyro_bias", plot(AxisSpec::new("gyroscope bias", "rad/s"), gyro), "Gyroscope bias"),
            (
                "odometry_accel_bias",
                plot(AxisSpec::new("accelerometer bias", "m/s²"), accel),
                "Accelerometer bias",
            ),
            (
                "odometry_scale",
                plot(
                    AxisSpec::new("σ of ln(scale)", "").from_zero(),
                    vec![line("", &|t| if t.scale_std.is_finite() { t.scale_std } else { f64::NAN })],
                ),
                "Standard deviation of the logarithm of the scale",
            ),
            (
                "odometry_sigma",
                plot(AxisSpec::new("σ of position", "m").from_zero(), vec![line("", &|t| sigma(t, 3))]),
                "Standard deviation of the position, relative to the start",
            ),
        ]);
    }
    all
}
