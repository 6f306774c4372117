//! `vidar odometry`.

use crate::args::OdometryArgs;
use crate::{Context, Outcome, build, print, progress, spool};
use vidar::config::Origin;
use vidar::odometry::OdometryRequest;

/// The metric trajectory of a recording from its own camera and IMU.
pub fn odometry(args: &OdometryArgs, context: &Context) -> Outcome {
    let mut layered = build::layered(&args.config, None)?;
    build::apply_input_flags(&mut layered, &args.input)?;
    build::apply_map_flag(&mut layered, args.map.as_deref())?;
    if args.mono {
        layered.value("odometry.imu", toml::Value::String("off".into()), Origin::Flag("--mono"))?;
    }
    let recording = spool::recording(&args.path)?;
    let request = OdometryRequest {
        path: recording.path.clone(),
        open: build::open_options(&args.input)?,
        layered,
        place: build::place(&args.output, &vidar::input::name_of(&recording.path)),
        command: context.command.clone(),
        debug_dump: args.debug_dump,
    };
    let outcome = vidar::odometry::odometry(&request, &progress::events(&context.cli), &context.cancel)?;
    print::warnings(&outcome.warnings);
    if context.cli.json {
        let mut value = serde_json::json!({
            "schema": "vidar.odometry/1", "folder": outcome.folder.display().to_string(),
        });
        if let (Some(object), serde_json::Value::Object(fields)) =
            (value.as_object_mut(), outcome.result_json())
        {
            object.extend(fields);
        }
        print::json(&value);
    } else {
        print::pairs(outcome.summary_lines());
    }
    Ok(outcome.status)
}
