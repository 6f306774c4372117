//! `vidar export`.

use crate::args::ExportArgs;
use crate::build::usage;
use crate::{Context, Outcome, print};
use vidar::ExitStatus;
use vidar::export::{ExportOptions, ExportTarget, export_run};

/// Exports a finished run to formats of other programs.
pub fn export(args: &ExportArgs, context: &Context) -> Outcome {
    let target: ExportTarget =
        args.to.parse().map_err(|e: String| usage(format!("--to: {e}"), "see `vidar export --help`"))?;
    let out = args.output.clone().unwrap_or_else(|| args.run.join("export").join(&args.to));
    let options =
        ExportOptions { tracks: args.tracks, input_size: args.input_size, texture_px: args.texture_px };
    let made = export_run(&args.run, target, options, &out)?;
    if context.cli.json {
        let files: Vec<String> = made.iter().map(|p| p.display().to_string()).collect();
        print::json(&serde_json::json!({ "schema": "vidar.export/1", "made": files }));
    } else {
        made.iter().for_each(|path| print::data(path.display().to_string()));
    }
    Ok(ExitStatus::Done)
}
