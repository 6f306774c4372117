//! `vidar doctor`.

use crate::{Context, Outcome, print};
use std::path::Path;
use vidar::ExitStatus;
use vidar::doctor::{State, examine};

/// Checks of this machine.
pub fn doctor(context: &Context) -> Outcome {
    let findings = examine(Path::new("."));
    let problem = findings.iter().any(|f| f.state == State::Problem);
    if context.cli.json {
        print::json(&serde_json::json!({ "schema": "vidar.doctor/1", "findings": findings }));
    } else {
        for finding in &findings {
            let mark = match finding.state {
                State::Ok => "ok",
                State::Optional => "--",
                State::Problem => "!!",
            };
            print::data(format!("{mark} {:<12} {}", finding.what, finding.found));
            if let Some(advice) = &finding.advice {
                print::data(format!("   {:<12} hint: {advice}", ""));
            }
        }
        let summary =
            if problem { "there are problems, marked with !! above" } else { "ready: try `vidar demo`" };
        print::data(summary);
    }
    Ok(if problem { ExitStatus::ResourceMissing } else { ExitStatus::Done })
}
