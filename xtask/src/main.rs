//! Project checks, run by CI: `cargo xtask check` runs all, or name one of `layers`, `circles`, `names`, `size`, `licences`.

mod circles;
mod layers;
mod licences;
mod text;

use anyhow::{Result, bail};
use std::path::Path;

fn main() -> Result<()> {
    let which = std::env::args().nth(1).unwrap_or_else(|| "check".into());
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    type Check = fn(&Path) -> Result<Vec<String>>;
    let all: [(&str, Check); 5] = [
        ("layers", layers::check),
        ("circles", circles::check),
        ("names", text::check_names),
        ("size", text::check_size),
        ("licences", licences::check),
    ];
    let wanted = which.strip_prefix("check-").unwrap_or(&which);
    let chosen: Vec<_> = all.iter().filter(|(name, _)| wanted == "check" || wanted == *name).collect();
    if chosen.is_empty() {
        bail!("unknown check {which:?}; known: check, layers, circles, names, size, licences");
    }
    let mut failures = 0;
    for (name, check) in chosen {
        let problems = check(&root)?;
        failures += problems.len();
        say(&format!("xtask {name}: {}", if problems.is_empty() { "ok" } else { "FAILED" }));
        for problem in problems {
            say(&format!("  {problem}"));
        }
    }
    if failures > 0 { bail!("{failures} problems") } else { Ok(()) }
}

fn say(line: &str) {
    use std::io::Write;
    // A closed pipe is no reason to fail a check.
    let _ = writeln!(std::io::stdout(), "{line}");
}
