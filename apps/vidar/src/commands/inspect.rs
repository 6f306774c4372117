//! `vidar inspect`.

use crate::args::InspectArgs;
use crate::{Context, Outcome, build, print, progress, spool};
use vidar::ExitStatus;

/// Contents and health of a recording.
pub fn inspect(args: &InspectArgs, context: &Context) -> Outcome {
    let mut options = build::open_options(&args.input)?;
    options.stride = args.input.stride.unwrap_or(1);
    options.start = args.input.start.map(vidar::core::Duration::from_secs_f64);
    options.end = args.input.end.map(vidar::core::Duration::from_secs_f64);
    let recording = spool::recording(&args.path)?;
    let found =
        vidar::inspect::inspect(&recording.path, &options, &progress::events(&context.cli), &context.cancel)?;
    if context.cli.json {
        let mut value = serde_json::json!({ "schema": "vidar.inspect/1" });
        if let (Some(object), Ok(serde_json::Value::Object(fields))) =
            (value.as_object_mut(), serde_json::to_value(&found))
        {
            object.extend(fields);
        }
        print::json(&value);
        return Ok(ExitStatus::Done);
    }
    print::line(format!("{}: {} ({})", found.name, found.kind, found.reason));
    for s in &found.streams {
        let times = match s.rate_hz {
            Some(hz) => format!(
                "{hz:.1} Hz over {}, longest gap {:.3} s",
                print::seconds(s.length_secs),
                s.longest_gap_secs
            ),
            None => "without times".to_owned(),
        };
        print::data(format!("  {:<20} {:>6}   {times}", s.what, s.count));
    }
    for (label, words) in [("camera", &found.camera), ("imu", &found.imu), ("poses", &found.poses)] {
        words.iter().for_each(|line| print::line(format!("  {label:<8} {line}")));
    }
    if let Some(i) = &found.images {
        print::data(format!(
            "  images   brightness {:.0} of 255, {:.1} % clipped, sharpness {:.0} (blurred below 20), {} of {} sampled unreadable",
            i.brightness,
            i.clipped * 100.0,
            i.sharpness,
            i.unreadable,
            i.sampled
        ));
    }
    for (label, words) in [("missing", &found.missing), ("found", &found.found), ("next time", &found.advice)]
    {
        words.iter().for_each(|line| print::line(format!("  {label:<9} {line}")));
    }
    found.possible.iter().for_each(|line| print::data(format!("  -> {line}")));
    print::warnings(&found.warnings);
    Ok(ExitStatus::Done)
}
