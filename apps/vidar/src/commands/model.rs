//! `vidar model`.

use crate::build::usage;
use crate::model_args::{CheckArgs, ImportArgs, LicenceArgs, ModelCommand, PrecisionArg, PullArgs};
use crate::{Context, Outcome, print, progress};
use serde_json::json;
use std::cell::Cell;
use std::path::{Path, PathBuf};
use vidar::core::Warning;
use vidar::da3::{self, Da3Options, check};
use vidar::hub::{Ability, Checkpoint, InstalledCheckpoint, Progress, TransferCallbacks, catalogue};
use vidar::models::{self, LicenceAccepted, bundled};
use vidar::run::bytes;
use vidar::{Error, Event, Events, ExitStatus};

/// One of its verbs.
pub fn model(command: &ModelCommand, context: &Context) -> Outcome {
    match command {
        ModelCommand::List => list(context),
        ModelCommand::Pull(args) => pull(args, context),
        ModelCommand::Import(args) => import(args, context),
        ModelCommand::Verify { name } => verify(name.as_deref(), context),
        ModelCommand::Check(args) => check_files(args, context),
        ModelCommand::Where { name } => locate(name.as_deref(), context),
    }
}

fn list(context: &Context) -> Outcome {
    let store = models::store(context.cli.offline)?;
    let mut rows = Vec::new();
    if context.cli.json {
        rows.push(bundled_row()?);
    } else {
        let (name, size) = (bundled::NAME, bytes(bundled::bytes()));
        let words: Vec<&str> = BUNDLED_ABILITIES.iter().map(|a| a.words()).collect();
        print::data(format!("{name:<26} {:<5} {size:>9}  {}", "installed", bundled::LICENCE));
        print::data(format!("    {}; {} M parameters", words.join(", "), bundled::parameters()? / 1_000_000));
        print::data(format!("    {}", bundled::NOTE));
    }
    for (checkpoint, installed) in store.list()? {
        let abilities: Vec<&str> = checkpoint.abilities.iter().map(|a| a.words()).collect();
        if context.cli.json {
            rows.push(json!({
                "name": checkpoint.name, "repository": checkpoint.repo, "licence": checkpoint.licence,
                "commercial_use": checkpoint.licence.allows_commercial_use(), "parameters": checkpoint.parameters,
                "bytes": checkpoint.bytes(), "sha256": checkpoint.weights().sha256,
                "abilities": checkpoint.abilities.iter().map(ability).collect::<Vec<_>>(), "note": checkpoint.note,
                "installed": installed.as_ref().map(|i| i.folder.display().to_string()),
                "location": installed.as_ref().map(|i| i.location),
            }));
            continue;
        }
        let here = if installed.is_some() { "installed" } else { "-" };
        let size = bytes(checkpoint.bytes());
        let terms = if checkpoint.licence.allows_commercial_use() { "" } else { " (no commercial use)" };
        print::data(format!("{:<26} {here:<5} {size:>9}  {}{terms}", checkpoint.name, checkpoint.licence));
        print::data(format!(
            "    {}; {} M parameters",
            abilities.join(", "),
            checkpoint.parameters / 1_000_000
        ));
        print::data(format!("    {}", checkpoint.note));
    }
    if context.cli.json {
        print::json(&json!({ "schema": "vidar.models/1", "models": rows }));
    }
    Ok(ExitStatus::Done)
}

const BUNDLED_ABILITIES: [Ability; 2] = [Ability::MultiViewDepth, Ability::Cameras];

fn bundled_row() -> Result<serde_json::Value, Error> {
    Ok(json!({
        "name": bundled::NAME, "repository": null, "licence": bundled::LICENCE, "commercial_use": true,
        "parameters": bundled::parameters()?, "bytes": bundled::bytes(), "sha256": bundled::sha256(),
        "abilities": BUNDLED_ABILITIES, "note": bundled::NOTE, "installed": bundled::SOURCE, "location": "program",
    }))
}

/// If `name` is the built-in network, prints that nothing is to be done and returns true.
fn is_in_program(name: &str, schema: &str, context: &Context) -> bool {
    let is_it = name == bundled::NAME;
    if is_it && context.cli.json {
        let (name, location, sha256) = (bundled::NAME, "program", bundled::sha256());
        print::json(
            &json!({ "schema": schema, "name": name, "folder": null, "location": location, "sha256": sha256 }),
        );
    } else if is_it {
        print::data(format!("{name} is {}; sha256 {}", bundled::SOURCE, bundled::sha256()));
    }
    is_it
}

fn ability(ability: &Ability) -> serde_json::Value {
    json!(ability)
}

/// The acceptance given by flags.
pub fn accepted(args: &LicenceArgs) -> Option<LicenceAccepted> {
    let licence = args.accept_licence.clone()?;
    let of_system = || std::env::var("USER").or_else(|_| std::env::var("USERNAME")).ok();
    let by = args.accepted_by.clone().or_else(of_system).unwrap_or_else(|| "unknown".to_owned());
    Some(LicenceAccepted { licence, by })
}

/// Runs `work` with progress in steps of a mebibyte.
fn with_progress<T>(
    stage: &'static str,
    context: &Context,
    work: impl FnOnce(&TransferCallbacks<'_>) -> Result<T, vidar::hub::HubError>,
) -> Result<T, Error> {
    let events: Events = progress::events(&context.cli);
    let last = Cell::new(u64::MAX);
    let tell = |p: Progress<'_>| {
        let (done, total) = (p.done >> 20, p.total >> 20);
        if last.replace(done) != done {
            events.emit(&Event::Progress { stage, done: done as usize, total: total as usize });
        }
    };
    let cancel = || context.cancel.is_cancelled();
    let callbacks = TransferCallbacks { progress: &tell, cancel: &cancel };
    events.stage(stage, 0, || work(&callbacks).map_err(Error::from))
}

fn pull(args: &PullArgs, context: &Context) -> Outcome {
    if is_in_program(&args.name, "vidar.model/1", context) {
        return Ok(ExitStatus::Done);
    }
    let checkpoint = catalogue::find(&args.name)?;
    let store = models::store(context.cli.offline)?;
    let acceptance = models::acceptance_of(checkpoint, accepted(&args.licence).as_ref())?;
    let options = vidar::hub::PullOptions {
        revision: args.revision.clone(),
        again: args.again,
        ..models::pull_options(acceptance)
    };
    let installed =
        with_progress("pull (MiB)", context, |callbacks| store.pull(checkpoint, &options, callbacks))?;
    print_installed(&installed, context)
}

fn import(args: &ImportArgs, context: &Context) -> Outcome {
    let store = models::store(true)?;
    let named: Option<&'static Checkpoint> = args.model.as_deref().map(catalogue::find).transpose()?;
    let accepted = accepted(&args.licence);
    // The file may identify the checkpoint; its licence is then required.
    let target = match (named, &accepted) {
        (None, Some(_)) => identified(&args.path, context)?,
        (named, _) => named,
    };
    let acceptance = match target {
        Some(checkpoint) => models::acceptance_of(checkpoint, accepted.as_ref())?,
        None => None,
    };
    let options = models::pull_options(acceptance);
    let installed = with_progress("import (MiB)", context, |callbacks| {
        store.import(&args.path, named, &options, callbacks)
    })?;
    print_installed(&installed, context)
}

/// The checkpoint that a file is by its hash.
fn identified(path: &Path, context: &Context) -> Result<Option<&'static Checkpoint>, Error> {
    let weights = if path.is_dir() { path.join(catalogue::WEIGHTS) } else { path.to_owned() };
    let (_, sha256) =
        with_progress("hash (MiB)", context, |callbacks| vidar::hub::sha256_of(&weights, callbacks))?;
    Ok(catalogue::of_hash(&sha256))
}

fn print_installed(installed: &InstalledCheckpoint, context: &Context) -> Outcome {
    let c = installed.checkpoint;
    if context.cli.json {
        print::json(&json!({
            "schema": "vidar.model/1", "name": c.name, "folder": installed.folder.display().to_string(),
            "location": installed.location, "record": installed.record, "acceptance": installed.acceptance,
        }));
    } else {
        print::pairs([
            ("model", c.name.to_owned()),
            ("folder", installed.folder.display().to_string()),
            ("licence", c.licence.to_string()),
            ("sha256", installed.recorded_sha256().unwrap_or("not recorded").to_owned()),
            ("use it", format!("vidar depth IMAGES --model {}", c.name)),
        ]);
    }
    Ok(ExitStatus::Done)
}

fn verify(name: Option<&str>, context: &Context) -> Outcome {
    if name.is_some_and(|name| is_in_program(name, "vidar.verify/1", context)) {
        return Ok(ExitStatus::Done);
    }
    let store = models::store(true)?;
    let wanted: Vec<&'static Checkpoint> = match name {
        Some(name) => vec![catalogue::find(name)?],
        None => store.list()?.into_iter().filter(|(_, i)| i.is_some()).map(|(c, _)| c).collect(),
    };
    let mut rows = Vec::new();
    for checkpoint in wanted {
        let files = with_progress("verify (MiB)", context, |callbacks| store.verify(checkpoint, callbacks))?;
        if !context.cli.json {
            for file in &files {
                let words = format!("{} {} ({:?})", file.name, &file.sha256[..12], file.identified_by);
                print::pairs([(checkpoint.name, words)]);
            }
        }
        rows.push(json!({ "name": checkpoint.name, "files": files }));
    }
    if context.cli.json {
        print::json(&json!({ "schema": "vidar.verify/1", "models": rows }));
    } else if rows.is_empty() {
        print::data("no checkpoint is installed; `vidar model list` shows all");
    }
    Ok(ExitStatus::Done)
}

fn locate(name: Option<&str>, context: &Context) -> Outcome {
    if name.is_some_and(|name| is_in_program(name, "vidar.where/1", context)) {
        return Ok(ExitStatus::Done);
    }
    let store = models::store(true)?;
    let folder = match name {
        Some(name) => {
            let checkpoint = catalogue::find(name)?;
            match store.find(checkpoint)? {
                Some(installed) => installed.folder,
                None => {
                    let (name, looked) = (checkpoint.name.to_owned(), store.folder(checkpoint));
                    return Err(vidar::hub::HubError::NotInstalled { name, looked }.into());
                }
            }
        }
        None => store.settings().root.clone(),
    };
    if context.cli.json {
        print::json(&json!({ "schema": "vidar.where/1", "folder": folder.display().to_string() }));
    } else {
        print::data(folder.display().to_string());
    }
    Ok(ExitStatus::Done)
}

/// How the network computes.
pub fn precision(arg: PrecisionArg) -> da3::Precision {
    match arg {
        PrecisionArg::Auto => da3::Precision::Auto,
        PrecisionArg::F32 => da3::Precision::F32,
        PrecisionArg::Bf16 => da3::Precision::Bf16,
        PrecisionArg::F16 => da3::Precision::F16,
    }
}

fn check_files(args: &CheckArgs, context: &Context) -> Outcome {
    let files = references(&args.path)?;
    let (precision, device) = (precision(args.precision), args.device);
    let options = Da3Options { precision, device, ..Da3Options::default() };
    let events = progress::events(&context.cli);
    let (mut reports, mut left_out) = (Vec::new(), 0usize);
    events.stage("check", files.len(), || {
        for (i, file) in files.iter().enumerate() {
            if context.cancel.is_cancelled() {
                return Err(Error::Interrupted { path: PathBuf::from(".") });
            }
            match check::check_file(file, args.model_dir.as_deref(), &options) {
                Ok(report) => {
                    if !context.cli.json {
                        print_report(&report, args.all);
                    }
                    reports.push(report);
                }
                // One invalid file of a folder must not hide the others.
                Err(error @ da3::Da3Error::BadGolden { .. }) if files.len() > 1 => {
                    events.warn(&Warning::new("reference-skipped", error.to_string()));
                    left_out += 1;
                }
                Err(error) => return Err(error.into()),
            }
            events.emit(&Event::Progress { stage: "check", done: i + 1, total: files.len() });
        }
        Ok(())
    })?;
    let failed = reports.iter().filter(|r| !r.passed()).count();
    if context.cli.json {
        print::json(&json!({ "schema": "vidar.check/1", "holds": failed == 0, "reports": reports }));
    }
    if failed > 0 {
        return Err(Error::Threshold(format!("{failed} of {} reference files differ", reports.len())));
    }
    Ok(if left_out > 0 { ExitStatus::Degraded } else { ExitStatus::Done })
}

fn print_report(report: &check::CheckReport, all: bool) {
    if all || !report.passed() {
        print::data(report.to_string().trim_end());
        return;
    }
    let worst = report
        .worst()
        .map(|row| format!("worst {} {:.1e} of {:.1e} allowed", row.tensor, row.ratio(), row.tolerance));
    let worst = worst.map(|words| format!("{words}, by {}", report.measure));
    let name = report.file.file_stem().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    let (model, rows) = (&report.model, report.rows.len());
    print::data(format!("{name:<32} {model:<22} {rows:>4} tensors match {}", worst.unwrap_or_default()));
}

/// A reference file, or those of a folder that its manifest describes.
fn references(path: &Path) -> Result<Vec<PathBuf>, Error> {
    if !path.is_dir() {
        return Ok(vec![path.to_owned()]);
    }
    let manifest = path.join("manifest.json");
    let text = vidar::system::read_text_up_to(&manifest, vidar::system::MAX_JSON_BYTES)
        .map_err(|e| Error::io("read", &manifest, e))?;
    let document: serde_json::Value = serde_json::from_str(&text)
        .map_err(|e| usage(format!("{}: {e}", manifest.display()), "it describes each reference file"))?;
    let described = document["files"].as_object().into_iter().flatten();
    let is_net = |entry: &serde_json::Value| entry.get("model").is_some() || entry.get("config").is_some();
    let mut files: Vec<PathBuf> = described
        .filter(|(_, entry)| is_net(entry))
        .map(|(name, _)| path.join(name))
        .filter(|file| file.is_file())
        .collect();
    files.sort();
    match files.is_empty() {
        true => Err(usage(
            format!("{} describes no existing reference file", manifest.display()),
            "give a .safetensors file, or a folder with files and manifest.json",
        )),
        false => Ok(files),
    }
}
