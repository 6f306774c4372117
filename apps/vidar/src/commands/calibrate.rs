//! `vidar calibrate`.

use crate::args::CalibrateArgs;
use crate::{Context, Outcome, build, print, progress, spool};
use vidar::ExitStatus;
use vidar::calibrate::CalibrateRequest;

/// Calibration of a recording from the recording itself. A given calibration that it contradicts ends with status 3.
pub fn calibrate(args: &CalibrateArgs, context: &Context) -> Outcome {
    let mut open = build::open_options(&args.input)?;
    open.stride = args.input.stride.unwrap_or(1);
    open.start = args.input.start.map(vidar::core::Duration::from_secs_f64);
    open.end = args.input.end.map(vidar::core::Duration::from_secs_f64);
    let recording = spool::recording(&args.path)?;
    let request = CalibrateRequest { path: recording.path.clone(), open, output: args.output.clone() };
    let outcome = vidar::calibrate::calibrate(&request, &progress::events(&context.cli), &context.cancel)?;
    if context.cli.json {
        let mut value = serde_json::json!({ "schema": "vidar.calibrate/1" });
        if let (Some(object), serde_json::Value::Object(fields)) = (value.as_object_mut(), outcome.to_json())
        {
            object.extend(fields);
        }
        print::json(&value);
    } else {
        print::pairs(outcome.summary_lines());
        print::warnings(&outcome.warnings);
    }
    Ok(if outcome.contradicts() { ExitStatus::Degraded } else { ExitStatus::Done })
}
