//! `vidar receive`.

use crate::link_args::ReceiveArgs;
use crate::{Context, Outcome, build, print};
use serde_json::json;
use std::fs::File;
use std::io::{BufWriter, IsTerminal, stdout};
use std::time::Duration;
use vidar::receive::{ReceiveRequest, receive as take};
use vidar::{Error, ExitStatus};

/// A robot's messages as a stream or a file, until Ctrl-C.
pub fn receive(args: &ReceiveArgs, context: &Context) -> Outcome {
    let mut layered = build::layered(&args.config, None)?;
    build::apply_link_flags(&mut layered, &args.link)?;
    let request = ReceiveRequest {
        expressions: args.expressions.clone(),
        link: layered.build()?.link,
        duration: seconds("--duration", args.duration)?,
        idle: seconds("--idle", args.idle)?,
    };
    let told = || {
        if !context.cli.quiet {
            print::talk("waiting for messages; Ctrl-C ends the recording");
        }
    };
    let received = match &args.output {
        Some(path) => {
            let file = File::create_new(path).map_err(|e| match e.kind() {
                std::io::ErrorKind::AlreadyExists => Error::OutputExists { path: path.clone() },
                _ => Error::io("create", path, e),
            })?;
            take(&request, BufWriter::new(file), &told, &context.cancel)?
        }
        None if stdout().is_terminal() => {
            let what = "the stream is binary, and the standard output is a terminal".to_owned();
            return Err(build::usage(what, "give a file with -o, or send it into another program"));
        }
        None => take(&request, BufWriter::new(stdout().lock()), &told, &context.cancel)?,
    };
    if context.cli.json && args.output.is_some() {
        print::json(&json!({ "schema": "vidar.receive/1", "received": received }));
    } else if !context.cli.quiet {
        for (topic, count) in &received.topics {
            print::talk(format!("{count:>8} {}", vidar::core::printable(topic)));
        }
        print::talk(format!(
            "{} bytes; {} ignored, {} repeated, {} refused, {} dropped",
            received.bytes, received.ignored, received.repeated, received.refused, received.dropped
        ));
    }
    // A stream that lost messages is a recording with holes.
    Ok(if received.dropped > 0 { ExitStatus::Degraded } else { ExitStatus::Done })
}

fn seconds(flag: &str, given: Option<f64>) -> Result<Option<Duration>, Error> {
    let Some(secs) = given else { return Ok(None) };
    match secs.is_finite() && (0.0..1e7).contains(&secs) {
        true => Ok(Some(Duration::from_secs_f64(secs))),
        false => Err(build::usage(format!("{flag} {secs} is no time"), "give seconds")),
    }
}
