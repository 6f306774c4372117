//! `vidar plan` and `vidar work`.

use crate::batch_args::{PlanArgs, WorkArgs};
use crate::shared_args::InputArgs;
use crate::{Context, Outcome, build, print, progress, spool};
use serde_json::json;
use std::path::{Path, PathBuf};
use vidar::batch::{PlanRequest, Planned, TaskRecord, WorkOutcome, WorkRequest};
use vidar::config::Origin;
use vidar::{Error, ExitStatus, Layered};

/// Writes the plan of a batch.
pub fn plan(args: &PlanArgs, context: &Context) -> Outcome {
    args.recordings.iter().try_for_each(|p| spool::refuse(p))?;
    let input = absolute_paths(&args.input)?;
    let request = PlanRequest {
        recordings: args.recordings.clone(),
        open: build::open_options(&input)?,
        input: serde_json::to_value(&input).unwrap_or_default(),
        layered: settings(args)?,
        store: args.store.clone(),
        parts: args.parts,
    };
    let planned = vidar::batch::plan(&request, &progress::events(&context.cli), &context.cancel)?;
    show(&planned, context);
    Ok(ExitStatus::Done)
}

/// The address is the result; everything else is talk.
fn show(planned: &Planned, context: &Context) {
    let plan = &planned.plan;
    if context.cli.json {
        print::json(&json!({
            "schema": plan.schema, "plan": planned.uri, "parts": plan.parts, "recordings": plan.recordings,
            "stages": plan.stages,
        }));
        return;
    }
    if !context.cli.quiet {
        for recording in plan.recordings.iter() {
            let Some(problem) = &recording.problem else { continue };
            let message = vidar::core::printable(&problem.message).into_owned();
            print::talk(format!("warning: {} will fail: {}: {message}", recording.name, problem.code));
        }
        let stages: Vec<String> = plan.stages.iter().map(|s| format!("{} {}", s.stage, s.tasks)).collect();
        print::talk(format!("{} recordings; tasks: {}", plan.recordings.len(), stages.join(", ")));
    }
    print::line(&planned.uri);
}

/// Every setting of the plan, so that workers need neither files nor variables.
fn settings(args: &PlanArgs) -> Result<Layered, Error> {
    let mut layered = build::layered(&args.config, None)?;
    build::apply_input_flags(&mut layered, &args.input)?;
    if let Some(mode) = &args.mode {
        layered.value("coupling.mode", mode.clone().into(), Origin::Flag("--mode"))?;
    }
    if let Some(device) = args.device {
        layered.value("model.device", device.to_string().into(), Origin::Flag("--device"))?;
    }
    let model_dir = args.model_dir.as_deref().map(absolute).transpose()?;
    build::apply_source_flags(&mut layered, args.geometry.as_deref(), model_dir.as_deref())?;
    Ok(layered)
}

/// Workers start in other folders.
fn absolute_paths(input: &InputArgs) -> Result<InputArgs, Error> {
    let all = |paths: &[PathBuf]| paths.iter().map(|p| absolute(p)).collect::<Result<Vec<_>, Error>>();
    Ok(InputArgs {
        calibration: all(&input.calibration)?,
        trajectory: input.trajectory.as_deref().map(absolute).transpose()?,
        imu: all(&input.imu)?,
        timestamps: input.timestamps.as_deref().map(absolute).transpose()?,
        ..input.clone()
    })
}

fn absolute(path: &Path) -> Result<PathBuf, Error> {
    std::path::absolute(path).map_err(|e| Error::io("read", path, e))
}

/// Does one task of a plan.
pub fn work(args: &WorkArgs, context: &Context) -> Outcome {
    let (planned, store) = vidar::batch::read_plan(&args.plan)?;
    let input: InputArgs = serde_json::from_value(planned.plan.input.clone())
        .map_err(|e| Error::NotABatch { name: args.plan.clone(), reason: format!("input: {e}") })?;
    let request = WorkRequest {
        planned,
        store,
        stage: args.stage.into(),
        index: args.index,
        open: build::open_options(&input)?,
        scratch: args.scratch.clone(),
        command: context.command.clone(),
    };
    match vidar::batch::work(&request, &progress::events(&context.cli), &context.cancel)? {
        WorkOutcome::Report(table) if context.cli.json => print::json(&json!(table)),
        WorkOutcome::Report(table) => print::data(table.markdown().trim_end()),
        WorkOutcome::Made(record) => show_task(&record, false, context),
        WorkOutcome::WasThere(record) => show_task(&record, true, context),
    }
    Ok(ExitStatus::Done)
}

fn show_task(record: &TaskRecord, was_there: bool, context: &Context) {
    if context.cli.json {
        print::json(&json!({ "schema": record.schema, "was_there": was_there, "task": record }));
        return;
    }
    let part = record.part.map(|p| format!(", part {p}")).unwrap_or_default();
    let how = match (&record.problem, was_there) {
        (Some(problem), _) => format!("failed: {}: {}", problem.code, problem.message),
        (None, true) => "done before".to_owned(),
        (None, false) => format!("done in {}", print::seconds(record.cost.seconds)),
    };
    print::line(format!("{} of {}{part}: {how}", record.stage, record.recording));
}
