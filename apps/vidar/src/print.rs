//! What people read. Writing to a closed terminal or pipe is not an error.

use std::io::{ErrorKind, Write};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicBool, Ordering};
use vidar::Error;
use vidar::core::{Warning, printable, printable_json, printable_lines};

/// Why data did not reach the standard output, once that happened. A reader that went away is no reason.
static LOST: OnceLock<std::io::Error> = OnceLock::new();
/// Whether the one JSON object of this process was printed.
static JSON_PRINTED: AtomicBool = AtomicBool::new(false);

/// A line of data on the standard output.
pub fn data(line: impl AsRef<str>) {
    match writeln!(std::io::stdout().lock(), "{}", printable_lines(line.as_ref())) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            // Only the first reason is told.
            let _ = LOST.set(error);
        }
        _ => {}
    }
}

/// A line of data with names in it, which may hold line breaks.
pub fn line(text: impl AsRef<str>) {
    data(printable(text.as_ref()));
}

/// An error if data was lost on its way to the standard output, say to a full disk.
pub fn all_delivered() -> Result<(), Error> {
    match LOST.get() {
        Some(error) => Err(Error::io("write", "standard output".as_ref(), error.kind().into())),
        None => Ok(()),
    }
}

/// A line of talk on the error stream.
pub fn talk(line: impl AsRef<str>) {
    let _ = writeln!(std::io::stderr().lock(), "{}", printable_lines(line.as_ref()));
}

/// JSON on the standard output.
pub fn json(value: &serde_json::Value) {
    JSON_PRINTED.store(true, Ordering::Relaxed);
    data(printable_json(&serde_json::to_string_pretty(value).unwrap_or_default()));
}

/// An error: what, where, why, next step, code.
pub fn error(error: &Error, as_json: bool) {
    let hint = error.hint();
    // A script gets one object: after a result, the exit code says that a bound was missed.
    if as_json && !JSON_PRINTED.load(Ordering::Relaxed) {
        json(&serde_json::json!({
            "schema": "vidar.error/1", "code": error.code(), "message": error.to_string(), "hint": hint,
            "exit": error.exit_status() as i32,
        }));
    }
    talk(format!("error[{}]: {}", error.code(), laid_out(&error.to_string())));
    let mut source = std::error::Error::source(error);
    while let Some(cause) = source {
        // Transparent wrappers repeat their cause.
        if !error.to_string().contains(&cause.to_string()) {
            talk(format!("  because: {}", printable(&cause.to_string())));
        }
        source = cause.source();
    }
    if let Some(hint) = hint {
        talk(format!("  hint: {}", printable(&hint)));
    }
}

/// An error as printed: the lines of a list, which begin with two blanks, stay lines; no text of a file can begin a line that looks like one of
/// the program's own.
fn laid_out(text: &str) -> String {
    text.split("\n  ").map(printable).collect::<Vec<_>>().join("\n  ")
}

/// Warnings, each kind once with its count and its first example.
pub fn warnings(warnings: &[Warning]) {
    let mut kinds: Vec<(&Warning, usize)> = Vec::new();
    for warning in warnings {
        match kinds.iter_mut().find(|(first, _)| first.kind == warning.kind) {
            Some((_, count)) => *count += 1,
            None => kinds.push((warning, 1)),
        }
    }
    for (first, count) in &kinds {
        let more = if *count > 1 { format!(" (and {} more)", count - 1) } else { String::new() };
        talk(format!("warning: {first}{more}"));
        if let Some(hint) = &first.hint {
            talk(format!("  hint: {hint}"));
        }
    }
}

/// Label and value in two columns.
pub fn pairs<'a>(rows: impl IntoIterator<Item = (&'a str, String)>) {
    for (label, value) in rows {
        data(format!("{label:<20} {}", printable(&value)));
    }
}

/// Seconds as m:ss or s.
pub fn seconds(secs: f64) -> String {
    if secs < 60.0 {
        format!("{secs:.1} s")
    } else {
        format!("{}:{:02} min", secs as u64 / 60, secs as u64 % 60)
    }
}
