//! `vidar convert`.

use crate::args::ConvertArgs;
use crate::{Context, Outcome, build, print, progress, spool};
use serde_json::json;
use vidar::ExitStatus;
use vidar::dataset::convert::ConvertFormat;

/// Writes a recording in another layout.
pub fn convert(args: &ConvertArgs, context: &Context) -> Outcome {
    let mut options = build::open_options(&args.input)?;
    options.stride = args.input.stride.unwrap_or(1);
    options.start = args.input.start.map(vidar::core::Duration::from_secs_f64);
    options.end = args.input.end.map(vidar::core::Duration::from_secs_f64);
    let format = match &args.to {
        Some(name) => name.parse()?,
        None => ConvertFormat::of_path(&args.out),
    };
    let events = progress::events(&context.cli);
    let recording = spool::recording(&args.path)?;
    let (dataset, done) =
        vidar::convert::convert(&recording.path, &options, &args.out, format, &events, &context.cancel)?;
    if context.cli.json {
        print::json(&json!({
            "schema": "vidar.convert/1", "out": args.out, "format": format.name(), "kind": dataset.kind.name(),
            "images": done.images, "imu_samples": done.imu_samples, "depths": done.depths,
            "truth_poses": done.truth_poses, "trajectory_poses": done.trajectory_poses,
            "warnings": dataset.warnings.iter().chain(&done.warnings).collect::<Vec<_>>(),
        }));
        return Ok(ExitStatus::Done);
    }
    let counts = [
        (done.images, "images"),
        (done.imu_samples, "IMU samples"),
        (done.depths, "depth images"),
        (done.truth_poses, "reference poses"),
        (done.trajectory_poses, "poses of its trajectory"),
    ];
    let words: Vec<String> =
        counts.iter().filter(|(n, _)| *n > 0).map(|(n, what)| format!("{n} {what}")).collect();
    print::line(format!("{} ({} as {format}): {}", args.out.display(), dataset.kind, words.join(", ")));
    let warnings: Vec<_> = dataset.warnings.iter().chain(&done.warnings).cloned().collect();
    print::warnings(&warnings);
    Ok(ExitStatus::Done)
}
