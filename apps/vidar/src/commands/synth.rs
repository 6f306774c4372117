//! `vidar synth`.

use crate::args::SynthArgs;
use crate::build::{self, usage};
use crate::{Context, Outcome, print, progress};
use std::path::Path;
use vidar::dataset::TrajectoryReadOptions;
use vidar::synth::SynthConfig;
use vidar::{Error, ExitStatus};

/// Renders a synthetic sequence in EuRoC layout.
pub fn synth(args: &SynthArgs, context: &Context) -> Outcome {
    let base = match &args.world_config {
        Some(path) => world_file(path)?,
        None if args.euroc => SynthConfig::euroc(),
        None => SynthConfig::demo(),
    };
    let world = build::world(&args.world, base)?;
    if args.out.exists() {
        return Err(usage(
            format!("{} exists", args.out.display()),
            "choose a new folder; nothing is overwritten",
        ));
    }
    let flight = match &args.trajectory {
        Some(path) => Some(vidar::dataset::read_trajectory(path, &TrajectoryReadOptions::default())?.0),
        None => None,
    };
    let events = progress::events(&context.cli);
    let summary = vidar::demo::synthesise(&args.out, &world, flight.as_ref(), &events, &context.cancel)?;
    if context.cli.json {
        print::json(&serde_json::json!({ "schema": "vidar.synth/1", "out": args.out, "summary": summary }));
    } else {
        print::data(format!(
            "{}: {} frames, {} IMU samples, {:.1} s, path {:.1} m, {} scan points",
            args.out.display(),
            summary.frames,
            summary.imu_samples,
            summary.duration_secs,
            summary.path_length_m,
            summary.scan_points
        ));
        print::talk(format!("next: vidar run {}", args.out.display()));
    }
    Ok(ExitStatus::Done)
}

/// A file with every setting of the world.
pub fn world_file(path: &Path) -> Result<SynthConfig, Error> {
    let fail = |reason: String| Error::ConfigFile { path: path.to_owned(), reason };
    let text = std::fs::read_to_string(path).map_err(|e| fail(e.to_string()))?;
    toml::from_str(&text).map_err(|e| fail(e.to_string()))
}
