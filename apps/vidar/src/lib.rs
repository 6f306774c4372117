//! The `vidar` program as a library, so that its parts can be tested.
//!
//! Data goes to the standard output, messages to the error stream. Exit codes are set here only.

pub mod args;
pub mod batch_args;
mod bench_args;
mod build;
mod commands;
pub mod compare_args;
pub mod link_args;
pub mod live_args;
pub mod model_args;
mod print;
mod progress;
pub mod reference;
pub mod run_args;
pub mod shared_args;
mod spool;
mod synth_args;

use args::{Cli, Command, ConfigCommand};
use clap::Parser;
use std::ffi::OsString;
use std::process::ExitCode;
use vidar::{CancelToken, Error, ExitStatus};

/// Result of a command.
pub type Outcome = Result<ExitStatus, Error>;

/// Parses, runs, prints, and returns the exit code.
pub fn main_with(args: impl Iterator<Item = OsString>) -> ExitCode {
    let typed: Vec<OsString> = args.collect();
    let cli = match Cli::try_parse_from(&typed) {
        Ok(cli) => cli,
        Err(error) => {
            // Help and version go to the standard output; clap selects the stream.
            let _ = error.print();
            return ExitCode::from(if error.use_stderr() { ExitStatus::Usage as u8 } else { 0 });
        }
    };
    let command = typed.iter().map(|a| quoted(&a.to_string_lossy())).collect();
    let context = Context { cli: cli.common, command, cancel: CancelToken::new() };
    install_cancel(&context.cancel);
    silence_decoders();
    let work = || match context.thread_pool() {
        Ok(pool) => pool.install(|| dispatch(cli.command, &context)),
        Err(error) => Err(error),
    };
    let Some(outcome) = without_bug(work) else {
        return ExitCode::from(ExitStatus::Bug as u8);
    };
    match outcome.and_then(|status| print::all_delivered().map(|()| status)) {
        Ok(status) => ExitCode::from(status as u8),
        Err(error) => {
            print::error(&error, context.cli.json);
            ExitCode::from(error.exit_status() as u8)
        }
    }
}

/// A panic in a decoder is an error of one image, and is said as that error; what Rust prints of it would look like a bug.
fn silence_decoders() {
    let before = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |panic| {
        if !vidar::dataset::is_decoding() {
            before(panic);
        }
    }));
}

/// Runs `work`; a panic is reported as a bug, with a hint.
fn without_bug<T>(work: impl FnOnce() -> T) -> Option<T> {
    // The process ends, so state left inconsistent by the panic is not used.
    let result = std::panic::catch_unwind(std::panic::AssertUnwindSafe(work));
    if result.is_err() {
        print::talk("error[E7001]: this is a bug in VIDAR; what was finished is on disk");
        print::talk(
            "  hint: please report the lines above with the command and its manifest.json or log.jsonl",
        );
    }
    result.ok()
}

/// Context of every command.
pub(crate) struct Context {
    pub cli: args::CommonArgs,
    pub command: Vec<String>,
    pub cancel: CancelToken,
}

impl Context {
    fn thread_pool(&self) -> Result<rayon::ThreadPool, Error> {
        let builder = rayon::ThreadPoolBuilder::new().num_threads(self.cli.threads);
        builder.build().map_err(|e| Error::Usage {
            what: format!("cannot start {} threads: {e}", self.cli.threads),
            hint: "give a smaller --threads".into(),
        })
    }
}

fn dispatch(command: Command, context: &Context) -> Outcome {
    match command {
        Command::Run(args) => commands::run::run(&args, context),
        Command::Live(args) => commands::live::live(&args, context),
        Command::Demo(args) => commands::run::demo(&args, context),
        Command::Inspect(args) => commands::inspect::inspect(&args, context),
        Command::Convert(args) => commands::convert::convert(&args, context),
        Command::Calibrate(args) => commands::calibrate::calibrate(&args, context),
        Command::Eval(args) => commands::eval::eval(&args, context),
        Command::Export(args) => commands::export::export(&args, context),
        Command::Compare(args) => commands::compare::compare(&args, context),
        Command::View(args) => commands::view::view(&args, context),
        Command::Depth(args) => commands::depth::depth(&args, context),
        Command::Model(command) => commands::model::model(&command, context),
        Command::Odometry(args) => commands::odometry::odometry(&args, context),
        Command::Synth(args) => commands::synth::synth(&args, context),
        Command::Bench(args) => commands::bench::bench(&args, context),
        Command::Plan(args) => commands::batch::plan(&args, context),
        Command::Work(args) => commands::batch::work(&args, context),
        Command::Worker(args) => commands::worker::worker(&args, context),
        Command::Receive(args) => commands::receive::receive(&args, context),
        Command::Doctor => commands::doctor::doctor(context),
        Command::Config(ConfigCommand::Show { config, origin }) => {
            commands::config::show(&config, origin, context)
        }
        Command::Config(ConfigCommand::Explain { key }) => commands::config::explain(&key, context),
        Command::Config(ConfigCommand::Presets) => commands::config::presets(context),
        Command::Config(ConfigCommand::Schema) => commands::config::schema(),
        Command::Explain { code } => commands::explain::explain(&code),
        Command::Completions { shell } => commands::completions(shell),
    }
}

/// The first signal asks the run to finish its files; the second ends the process at once.
fn install_cancel(cancel: &CancelToken) {
    let cancel = cancel.clone();
    // Without a handler the system's default applies, which ends the process.
    let _ = ctrlc::set_handler(move || {
        if cancel.is_cancelled() {
            end_now();
        }
        cancel.cancel();
        print::talk("stopping: finishing files; press Ctrl-C again to stop immediately");
    });
}

#[allow(clippy::disallowed_methods, clippy::exit)] // a signal handler cannot return an error
fn end_now() {
    std::process::exit(ExitStatus::Interrupted as i32);
}

fn quoted(argument: &str) -> String {
    let plain = |c: char| c.is_alphanumeric() || "-_./=:,@%+".contains(c);
    if !argument.is_empty() && argument.chars().all(plain) {
        argument.to_owned()
    } else {
        format!("'{}'", argument.replace('\'', r"'\''"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_panics_of_decoders_are_silent() {
        use std::sync::atomic::{AtomicUsize, Ordering};
        static PRINTED: AtomicUsize = AtomicUsize::new(0);
        let panics_on = |name: &str| {
            let thread = std::thread::Builder::new().name(name.to_owned());
            assert!(thread.spawn(|| panic!("as a test")).unwrap().join().is_err());
        };
        let other = "not a decoder";
        std::panic::set_hook(Box::new(move |_| {
            let thread = std::thread::current();
            let is_ours = [Some(other), Some(vidar::dataset::DECODER_THREAD)].contains(&thread.name());
            PRINTED.fetch_add(usize::from(is_ours), Ordering::SeqCst);
        }));
        silence_decoders();
        panics_on(vidar::dataset::DECODER_THREAD);
        assert_eq!(PRINTED.load(Ordering::SeqCst), 0);
        panics_on(other);
        assert_eq!(PRINTED.load(Ordering::SeqCst), 1);
        let _ = std::panic::take_hook();
    }

    #[test]
    fn a_panic_is_reported_as_a_bug_and_other_results_pass_through() {
        assert_eq!(without_bug(|| 7), Some(7));
        assert_eq!(without_bug(|| -> i32 { panic!("on purpose") }), None);
    }

    #[test]
    fn a_command_is_quoted_for_the_shell() {
        assert_eq!(quoted("plain/path.tum"), "plain/path.tum");
        assert_eq!(quoted("two words"), "'two words'");
        assert_eq!(quoted("it's"), r"'it'\''s'");
        assert_eq!(quoted(""), "''");
    }
}
