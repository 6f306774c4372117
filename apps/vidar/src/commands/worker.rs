//! `vidar worker`.

use crate::link_args::WorkerArgs;
use crate::{Context, Outcome, build, print};
use serde_json::json;
use vidar::ExitStatus;
use vidar::link::Serving;
use vidar::models::geometry::{CUSTOM, chosen};
use vidar::worker::Worker;

/// Answers predictions until Ctrl-C.
pub fn worker(args: &WorkerArgs, context: &Context) -> Outcome {
    let mut layered = build::layered(&args.config, None)?;
    let model = if args.model_dir.is_some() { CUSTOM } else { &args.model };
    build::apply_source_flags(&mut layered, Some(model), args.model_dir.as_deref())?;
    build::apply_device_flag(&mut layered, args.device)?;
    build::apply_link_flags(&mut layered, &args.link)?;
    let config = layered.build()?;
    if let (Some(accepted), Some(choice)) = (super::model::accepted(&args.licence), chosen(&config)?) {
        vidar::models::locate(&choice, Some(&accepted), &vidar::models::store(true)?)?;
    }
    let worker = Worker::open(&config)?;
    let (words, is_json) = (worker.words(), context.cli.json);
    let told = |serving: Serving| match serving {
        Serving::Ready { worker, endpoints } if is_json => print::json(&json!({
            "schema": "vidar.worker/1", "worker": worker, "key": args.key, "endpoints": endpoints, "model": words,
        })),
        Serving::Ready { worker, endpoints } => print::data(format!(
            "worker {worker} answers under {} at {}: {words}; Ctrl-C ends it",
            args.key,
            if endpoints.is_empty() { "what it is connected to".to_owned() } else { endpoints.join(", ") }
        )),
        Serving::Answered { keyframes, took, received, sent, problem } if !context.cli.quiet => {
            let (took, kb) = (print::seconds(took.as_secs_f64()), |bytes: usize| bytes / 1000);
            let outcome = problem.map_or_else(
                || format!("{keyframes} keyframes"),
                |why| vidar::core::printable(&why).to_string(),
            );
            print::talk(format!("{outcome} in {took}, {} kB in, {} kB out", kb(received), kb(sent)));
        }
        Serving::TooLate if !context.cli.quiet => print::talk("a request waited longer than its sender"),
        Serving::Answered { .. } | Serving::TooLate => {}
    };
    worker.serve(&args.key, &config, &told, &context.cancel)?;
    Ok(ExitStatus::Done)
}
