//! Events as a bar, as lines, or as JSON.

use crate::args::{CommonArgs, ProgressMode};
use crate::print;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use std::io::IsTerminal;
use std::sync::Mutex;
use std::time::{Duration, Instant};
use vidar::{Event, Events};

/// A stream of events with the reader that the flags ask for.
pub fn events(common: &CommonArgs) -> Events {
    let terminal = std::io::stderr().is_terminal();
    let mode = match (common.quiet, common.progress) {
        (true, _) => ProgressMode::Off,
        (false, ProgressMode::Auto) if terminal => ProgressMode::Bar,
        (false, ProgressMode::Auto) => ProgressMode::Plain,
        (false, mode) => mode,
    };
    match mode {
        ProgressMode::Off | ProgressMode::Auto => Events::none(),
        ProgressMode::Json => Events::none().with(|event| {
            print::talk(vidar::run_folder::event_line(event).to_string());
        }),
        ProgressMode::Plain => plain(),
        ProgressMode::Bar => bar(),
    }
}

/// Time between two lines of a stage that takes long.
const HEARTBEAT: Duration = Duration::from_secs(5);

fn plain() -> Events {
    let last = Mutex::new(Instant::now());
    Events::none().with(move |event| match event {
        Event::StageStarted { stage, total: 0 } => print::talk(format!("{stage} …")),
        Event::StageStarted { stage, total } => print::talk(format!("{stage}: {total} …")),
        Event::StageFinished { stage: name, seconds } | Event::StepFinished { step: name, seconds } => {
            print::talk(format!("{name} done in {}", print::seconds(*seconds)));
        }
        Event::Progress { stage, done, total } => {
            let Ok(mut last) = last.lock() else { return };
            if last.elapsed() >= HEARTBEAT {
                *last = Instant::now();
                match total {
                    0 => print::talk(format!("{stage}: {done}")),
                    _ => print::talk(format!("{stage}: {done} of {total}")),
                }
            }
        }
        Event::ChunkProgress { percent } => {
            let Ok(mut last) = last.lock() else { return };
            if last.elapsed() >= HEARTBEAT {
                *last = Instant::now();
                print::talk(format!("chunk: {percent} % predicted"));
            }
        }
        _ => {}
    })
}

fn bar() -> Events {
    let bar = ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr());
    let style = |with_length: bool| {
        let template = match with_length {
            true => "{msg:>10} [{bar:32}] {pos}/{len} {elapsed_precise} (left {eta_precise})",
            false => "{msg:>10} {spinner} {elapsed_precise}",
        };
        ProgressStyle::with_template(template)
            .unwrap_or_else(|_| ProgressStyle::default_bar())
            .progress_chars("=> ")
    };
    Events::none().with(move |event| match event {
        Event::StageStarted { stage, total } => {
            bar.reset();
            bar.set_style(style(*total > 0));
            bar.set_length(*total as u64);
            bar.set_message(*stage);
            bar.enable_steady_tick(Duration::from_millis(200));
        }
        Event::ChunkProgress { percent } => bar.set_message(format!("chunk {percent:>3} %")),
        Event::ChunkPredicted { .. } => bar.set_message("map"),
        Event::Progress { done, total, .. } => {
            bar.set_style(style(true));
            bar.set_length(*total as u64);
            bar.set_position(*done as u64);
        }
        Event::StageFinished { stage: name, seconds } | Event::StepFinished { step: name, seconds } => {
            bar.println(format!("{name:>10} done in {}", print::seconds(*seconds)));
        }
        Event::Finished { .. } => bar.finish_and_clear(),
        _ => {}
    })
}
