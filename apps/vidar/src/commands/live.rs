//! `vidar live`.

use super::run::{conclude, dry_run, request};
use crate::args::RunArgs;
use crate::build::usage;
use crate::live_args::LiveArgs;
use crate::{Context, Outcome, progress, spool};
use vidar::Error;
use vidar::run::{LiveInput, LiveOptions};

/// What is mapped, and the stream where it is one: MCAP on standard input for `-`. What an earlier attempt kept of a stream is a recording
/// like others.
fn source(args: &LiveArgs) -> Result<(RunArgs, Option<LiveInput>), Error> {
    let mut run = args.run.clone();
    if !spool::is_standard_input(&run.path) {
        return Ok((run, None));
    }
    if let (true, Some(folder)) = (run.resume, &run.output.output) {
        let kept = folder.join(vidar::run::RECORDING);
        if !kept.is_file() {
            let what =
                format!("{} holds no {} of an earlier attempt", folder.display(), vidar::run::RECORDING);
            return Err(usage(what, "the same command without --resume starts with the stream"));
        }
        run.path = kept;
        return Ok((run, None));
    }
    if args.realtime || run.dry_run {
        let flag = if args.realtime { "--realtime" } else { "--dry-run" };
        let what = format!("{flag} needs a recording, and standard input comes at its own rate");
        return Err(usage(what, "leave the flag out"));
    }
    let input = spool::standard_input()?;
    // The name of the run's folder, where none is given.
    run.path = "live".into();
    Ok((run, Some(Box::new(input))))
}

/// The preset of what is live, where none is given.
const PRESET: &str = "live";

/// The map while images come.
pub fn live(args: &LiveArgs, context: &Context) -> Outcome {
    let (run, input) = source(args)?;
    let (request, thresholds) = request(&run, None, Some(PRESET), context)?;
    if args.run.dry_run && input.is_none() {
        return dry_run(&request, context);
    }
    let threads = rayon::current_num_threads();
    let options = LiveOptions { is_realtime: args.realtime, odometry_threads: threads };
    let events = progress::events(&context.cli);
    // The map leaves one processor to the odometry, where there are several.
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads.saturating_sub(1).max(1)).build();
    let pool = pool.map_err(|e| usage(format!("cannot start threads: {e}"), "give a smaller --threads"))?;
    let outcome = pool.install(|| match input {
        Some(input) => vidar::run::live_stream(&request, &options, input, &events, &context.cancel),
        None => vidar::run::live(&request, &options, &events, &context.cancel),
    })?;
    conclude(&outcome, &thresholds, context)
}
