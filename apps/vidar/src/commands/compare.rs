//! `vidar compare`.

use crate::compare_args::CompareArgs;
use crate::{Context, Outcome, print};
use vidar::ExitStatus;
use vidar::compare::{CompareRequest, compare as compare_runs};

/// Finished runs on one page.
pub fn compare(args: &CompareArgs, context: &Context) -> Outcome {
    let request = CompareRequest { runs: args.runs.clone(), page: args.output.clone(), force: args.force };
    let made = compare_runs(&request)?;
    if context.cli.json {
        print::json(&made.json);
    } else {
        print::pairs(made.lines.iter().map(|(label, value)| (label.as_str(), value.clone())));
    }
    Ok(ExitStatus::Done)
}
