//! `vidar eval`.

use crate::args::EvalArgs;
use crate::{Context, Outcome, build, print};
use serde_json::json;
use vidar::ExitStatus;
use vidar::evaluate::{Thresholds, evaluate_files, evaluate_run};

/// Evaluates a trajectory or a cloud, or shows the scores of a run.
pub fn eval(args: &EvalArgs, context: &Context) -> Outcome {
    let thresholds = Thresholds::parse(&args.fail_above, &args.fail_below)?;
    let config = build::layered(&args.config, None)?.build()?;
    let evaluation = match &args.truth {
        Some(truth) => evaluate_files(&args.estimate, truth, &config, &build::trajectory_options(args)?)?,
        None => evaluate_run(&args.estimate)?,
    };
    if context.cli.json {
        print::json(&json!({
            "schema": "vidar.eval/1", "kind": evaluation.kind, "scores": evaluation.scores, "report": evaluation.report,
        }));
    } else {
        print::pairs(evaluation.lines.iter().map(|(label, value)| (label.as_str(), value.clone())));
        print::warnings(&evaluation.warnings);
    }
    thresholds.check(&evaluation.scores)?;
    Ok(ExitStatus::Done)
}
