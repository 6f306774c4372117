//! `vidar run` and `vidar demo`.

use crate::args::DemoArgs;
use crate::run_args::{RunArgs, WholeRunArgs};
use crate::shared_args::BudgetArgs;
use crate::{Context, Outcome, build, print, progress, spool};
use serde_json::json;
use vidar::demo::DemoRequest;
use vidar::evaluate::Thresholds;
use vidar::run_folder::OutputLocation;
use vidar::synth::SynthConfig;
use vidar::{Error, ExitStatus, RunOutcome, RunRequest};

/// Everything, from recording to report.
pub fn run(args: &WholeRunArgs, context: &Context) -> Outcome {
    let (request, thresholds) = request(&args.run, Some(&args.budget), None, context)?;
    if args.run.dry_run {
        return dry_run(&request, context);
    }
    let outcome = vidar::run(&request, &progress::events(&context.cli), &context.cancel)?;
    conclude(&outcome, &thresholds, context)
}

/// What the flags ask for, over a preset that holds where none is given.
pub(super) fn request(
    args: &RunArgs,
    budget: Option<&BudgetArgs>,
    default_preset: Option<&str>,
    context: &Context,
) -> Result<(RunRequest, Thresholds), Error> {
    spool::refuse(&args.path)?;
    let mut layered = build::layered(&args.config, default_preset)?;
    build::apply_input_flags(&mut layered, &args.input)?;
    build::apply_map_flag(&mut layered, args.map.as_deref())?;
    build::apply_masks_flag(&mut layered, args.masks.as_deref())?;
    build::apply_model_flags(&mut layered, args)?;
    if let Some(budget) = budget {
        build::apply_budget_flags(&mut layered, budget)?;
    }
    accept_licence(&layered, args)?;
    let thresholds = Thresholds::parse(&args.fail_above, &args.fail_below)?;
    let request = RunRequest {
        path: args.path.clone(),
        open: build::open_options(&args.input)?,
        layered,
        reference: args.reference.clone(),
        place: match (&args.output.output, args.resume) {
            (Some(path), true) => OutputLocation::Resumed { path: path.clone() },
            _ => build::place(&args.output, &vidar::input::name_of(&args.path)),
        },
        mcap: args.mcap.clone(),
        command: context.command.clone(),
    };
    Ok((request, thresholds))
}

/// Records an acceptance of a licence given with this command, before the model is opened.
fn accept_licence(layered: &vidar::Layered, args: &RunArgs) -> Result<(), Error> {
    let Some(accepted) = super::model::accepted(&args.licence) else { return Ok(()) };
    let config = layered.build()?;
    if !config.remote.model.is_empty() && config.geometry.source.starts_with(vidar::models::geometry::REMOTE)
    {
        return vidar::models::accept(&config.remote.model, &accepted);
    }
    let Some(choice) = vidar::models::geometry::chosen(&config)? else { return Ok(()) };
    vidar::models::locate(&choice, Some(&accepted), &vidar::models::store(true)?).map(|_| ())
}

pub(super) fn dry_run(request: &RunRequest, context: &Context) -> Outcome {
    let plan = vidar::run::plan(request)?;
    if context.cli.json {
        let lines: serde_json::Map<String, serde_json::Value> =
            plan.lines().into_iter().map(|(k, v)| (k.replace(' ', "_"), v.into())).collect();
        print::json(&json!({ "schema": "vidar.plan/1", "plan": lines }));
    } else {
        print::pairs(plan.lines());
        print::warnings(&plan.warnings);
    }
    Ok(ExitStatus::Done)
}

/// A synthetic room, flown, mapped and evaluated.
pub fn demo(args: &DemoArgs, context: &Context) -> Outcome {
    let mut layered = build::layered(&args.config, Some("demo"))?;
    build::apply_source_flags(&mut layered, args.geometry.as_deref(), args.model_dir.as_deref())?;
    let request = DemoRequest {
        world: build::world(&args.world, SynthConfig::demo())?,
        layered,
        place: build::place(&args.output, "demo"),
        mcap: args.mcap.clone(),
        command: context.command.clone(),
    };
    let outcome = vidar::demo::demo(&request, &progress::events(&context.cli), &context.cancel)?;
    conclude(&outcome, &Thresholds::default(), context)
}

/// Prints the result with its warnings and scores; then applies thresholds.
pub(super) fn conclude(outcome: &RunOutcome, thresholds: &Thresholds, context: &Context) -> Outcome {
    let scores = vidar::evaluate::scores(&outcome.evaluation);
    print::warnings(&outcome.warnings);
    if context.cli.json {
        print::json(&json!({
            "schema": "vidar.run/1",
            "folder": outcome.folder.display().to_string(),
            "exit": outcome.status as i32,
            "result": outcome.result_json(),
            "scores": scores,
        }));
    } else {
        print::pairs(outcome.summary_lines());
    }
    if outcome.status == ExitStatus::Interrupted {
        return Err(Error::Interrupted { path: outcome.folder.clone() });
    }
    thresholds.check(&scores)?;
    Ok(outcome.status)
}
