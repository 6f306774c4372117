//! `vidar synth`.

use crate::args::SynthArgs;
use crate::build::{self, usage};
use crate::{Context, Outcome, print, progress};
use std::path::Path;
use vidar::dataset::TrajectoryReadOptions;
use vidar::synth::{CalibrationKind, PRESETS, SynthConfig};
use vidar::{Error, ExitStatus};

/// Renders a synthetic sequence in EuRoC layout.
pub fn synth(args: &SynthArgs, context: &Context) -> Outcome {
    let base = match (&args.world_config, &args.preset) {
        (Some(path), _) => world_file(path)?,
        (None, Some(name)) => SynthConfig::preset(name).ok_or_else(|| {
            usage(format!("--preset {name:?} is unknown"), format!("presets: {}", PRESETS.join(", ")))
        })?,
        (None, None) if args.euroc => SynthConfig::euroc(),
        (None, None) => SynthConfig::demo(),
    };
    let world = build::world(&args.world, recording(args, base)?)?;
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

/// Applies the options of the recording device.
fn recording(args: &SynthArgs, mut world: SynthConfig) -> Result<SynthConfig, Error> {
    if let Some(size) = &args.size {
        let parsed = size.split_once('x').and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
        let Some((width, height)) = parsed else {
            return Err(usage(format!("--size {size:?} is no size"), "for example --size 1280x720"));
        };
        world = world.resized(width, height);
    }
    if let Some(hz) = args.frame_rate {
        world.camera_rate_hz = hz;
    }
    if let Some(hz) = args.imu_rate {
        world.imu_rate_hz = hz;
    }
    if let Some(ms) = args.readout_ms {
        world.device.readout_secs = ms * 1e-3;
    }
    if let Some(ms) = args.stamp_delay_ms {
        world.device.stamp_delay_secs = ms * 1e-3;
    }
    if let Some(share) = args.bare_share {
        world.bare_share = share;
    }
    if let Some(kind) = &args.calibration {
        world.device.calibration = match kind.as_str() {
            "given" => CalibrationKind::Given,
            "partial" => CalibrationKind::Partial,
            "absent" => CalibrationKind::Absent,
            other => {
                return Err(usage(
                    format!("--calibration {other:?} is unknown"),
                    "calibrations: given, partial, absent",
                ));
            }
        };
    }
    Ok(world)
}

/// A file with every setting of the world.
pub fn world_file(path: &Path) -> Result<SynthConfig, Error> {
    let fail = |reason: String| Error::ConfigFile { path: path.to_owned(), reason };
    let text = vidar::system::read_text_up_to(path, vidar::system::MAX_CONFIG_BYTES)
        .map_err(|e| fail(e.to_string()))?;
    toml::from_str(&text).map_err(|e| fail(e.to_string()))
}
