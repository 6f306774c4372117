//! Project checks, run by CI, and parts of a release.
//!
//! ```text
//! cargo xtask check             all checks; or one of layers, circles, names, size, licences, third-party-is-current
//! cargo xtask third-party       writes THIRD-PARTY-LICENSES.txt
//! cargo xtask package           packages every crate and checks sizes, contents and order; builds nothing
//! cargo xtask package --build   then builds the program from the packages alone
//! ```

mod circles;
mod layers;
mod licences;
mod package;
mod text;
mod third_party;

use anyhow::{Result, bail};
use std::path::Path;

type Check = fn(&Path) -> Result<Vec<String>>;

const CHECKS: [(&str, Check); 6] = [
    ("layers", layers::check),
    ("circles", circles::check),
    ("names", text::check_names),
    ("size", text::check_size),
    ("licences", licences::check),
    ("third-party-is-current", third_party::check),
];

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["third-party"] => third_party::write(&root),
        ["package"] => report(&root, &[("package", package::check)]),
        ["package", "--build"] => {
            report(&root, &[("package", package::check)])?;
            package::build(&root)
        }
        [] | ["check"] => report(&root, &CHECKS),
        [name] => {
            let wanted = name.strip_prefix("check-").unwrap_or(name);
            let Some(check) = CHECKS.iter().find(|(known, _)| *known == wanted) else {
                let known: Vec<&str> = CHECKS.iter().map(|(name, _)| *name).collect();
                bail!("unknown task {name:?}; known: check, third-party, package, {}", known.join(", "));
            };
            report(&root, &[*check])
        }
        _ => bail!("unknown arguments {arguments:?}; one task at a time, see xtask/src/main.rs"),
    }
}

/// Runs checks and prints their problems; an error if there are any.
fn report(root: &Path, checks: &[(&str, Check)]) -> Result<()> {
    let mut failures = 0;
    for (name, check) in checks {
        let problems = check(root)?;
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
