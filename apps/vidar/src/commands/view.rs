//! `vidar view`.

use crate::args::ViewArgs;
use crate::{Context, Outcome, print};
use vidar::ExitStatus;
use vidar::viewer::Viewer;

/// Serves a run until Ctrl-C, which is how it is meant to end.
pub fn view(args: &ViewArgs, context: &Context) -> Outcome {
    let viewer = Viewer::open(&args.path, args.port)?;
    let (file, address, app) = (viewer.file.display().to_string(), viewer.address(), viewer.app_url());
    if context.cli.json {
        print::json(
            &serde_json::json!({ "schema": "vidar.view/1", "file": file, "address": address, "app": app }),
        );
    } else {
        let steps = "Open connection, Foxglove WebSocket, the address; or ";
        print::pairs([
            ("file", file),
            ("address", address),
            ("in Foxglove", format!("{steps}{app}")),
            ("end", "Ctrl-C".to_owned()),
        ]);
    }
    viewer.play(|| context.cancel.is_cancelled())?;
    Ok(ExitStatus::Done)
}
