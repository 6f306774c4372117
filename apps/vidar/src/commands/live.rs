//! `vidar live`.

use super::run::{conclude, dry_run, request};
use crate::build::usage;
use crate::live_args::LiveArgs;
use crate::run_args::RunArgs;
use crate::{Context, Outcome, print, progress, spool};
use std::sync::mpsc::sync_channel;
use std::time::Duration;
use vidar::config::Origin;
use vidar::receive::{ReceiveRequest, receive};
use vidar::run::{LiveInput, LiveOptions};
use vidar::{CancelToken, Error, Layered};

/// How the name of a robot's messages begins.
const ROBOT: &str = "zenoh:";

/// What is mapped.
enum Source {
    /// A recording that is there.
    Recording(RunArgs),
    /// A stream: MCAP on standard input.
    Stream(RunArgs, LiveInput),
    /// Messages of a robot under these key expressions.
    Robot(RunArgs, Vec<String>),
}

/// What the command names. What an earlier attempt kept of a stream is a recording like others.
fn source(args: &LiveArgs) -> Result<Source, Error> {
    let mut run = args.run.clone();
    let robot = run.path.to_str().and_then(|path| path.strip_prefix(ROBOT));
    let expressions = robot.map(|list| list.split(',').map(str::to_owned).collect::<Vec<_>>());
    if expressions.is_none() && !spool::is_standard_input(&run.path) {
        return Ok(Source::Recording(run));
    }
    if let (true, Some(folder)) = (run.resume, &run.output.output) {
        let kept = folder.join(vidar::run::RECORDING);
        if !kept.is_file() {
            let what =
                format!("{} holds no {} of an earlier attempt", folder.display(), vidar::run::RECORDING);
            return Err(usage(what, "the same command without --resume starts with the stream"));
        }
        run.path = kept;
        return Ok(Source::Recording(run));
    }
    if args.realtime || run.dry_run {
        let flag = if args.realtime { "--realtime" } else { "--dry-run" };
        let what = format!("{flag} needs a recording, and a stream comes at its own rate");
        return Err(usage(what, "leave the flag out"));
    }
    // The name of the run's folder, where none is given.
    run.path = "live".into();
    match expressions {
        Some(expressions) => Ok(Source::Robot(run, expressions)),
        None => Ok(Source::Stream(run, Box::new(spool::standard_input()?))),
    }
}

/// The messages of a robot as a stream, received by a thread of its own. Ctrl-C ends the stream, and the map is finished.
fn robot(
    expressions: Vec<String>,
    args: &LiveArgs,
    layered: &Layered,
    context: &Context,
) -> Result<LiveInput, Error> {
    let seconds = |given: Option<f64>| given.map(|s| Duration::from_secs_f64(s.clamp(0.0, 1e7)));
    let request = ReceiveRequest {
        expressions,
        link: layered.build()?.link,
        duration: seconds(args.duration),
        idle: seconds(args.idle),
    };
    let (reader, writer) = std::io::pipe().map_err(|e| Error::io("make", "a pipe".as_ref(), e))?;
    // That it listens, and an error: no more than two messages.
    let (sender, ready) = sync_channel(2);
    let (cancel, is_quiet) = (context.cancel.clone(), context.cli.quiet);
    let work = move || {
        let told = || drop(sender.send(Ok(())));
        match receive(&request, writer, &told, &cancel) {
            Err(error) => drop(sender.send(Err(error))),
            Ok(received) if received.dropped > 0 || !is_quiet => print::talk(format!(
                "the stream has ended: {} bytes, {} messages repeated, {} refused, {} dropped",
                received.bytes, received.repeated, received.refused, received.dropped
            )),
            Ok(_) => {}
        }
    };
    let thread = std::thread::Builder::new().name("receive".into()).spawn(work);
    thread.map_err(|e| Error::io("start", "the receiving thread".as_ref(), e))?;
    match ready.recv() {
        Ok(Err(error)) => Err(error),
        _ => Ok(Box::new(reader)),
    }
}

/// The preset of what is live, where none is given.
const PRESET: &str = "live";

/// The map while images come.
pub fn live(args: &LiveArgs, context: &Context) -> Outcome {
    let (run, stream, expressions) = match source(args)? {
        Source::Recording(run) => (run, None, None),
        Source::Stream(run, input) => (run, Some(input), None),
        Source::Robot(run, expressions) => (run, None, Some(expressions)),
    };
    let (mut request, thresholds) = request(&run, None, Some(PRESET), context)?;
    if let Some(place) = &args.publish {
        let place = toml::Value::String(place.clone());
        request.layered.value("link.publish", place, Origin::Flag("--publish"))?;
    }
    if args.run.dry_run {
        return dry_run(&request, context);
    }
    let threads = rayon::current_num_threads();
    // A robot does not wait, and what Ctrl-C ends is its stream: the map of what came is finished.
    let (is_robot, of_recording) = (expressions.is_some(), CancelToken::new());
    let cancel = if is_robot { &of_recording } else { &context.cancel };
    let input = match expressions {
        Some(expressions) => Some(robot(expressions, args, &request.layered, context)?),
        None => stream,
    };
    let options = LiveOptions {
        is_realtime: args.realtime || is_robot,
        odometry_threads: threads,
        // The pool in which commands run is the map's until the program ends.
        is_map_low_priority: true,
    };
    let events = progress::events(&context.cli);
    let outcome = match input {
        Some(input) => vidar::run::live_stream(&request, &options, input, &events, cancel),
        None => vidar::run::live(&request, &options, &events, cancel),
    }?;
    conclude(&outcome, &thresholds, context)
}
