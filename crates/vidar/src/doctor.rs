//! `vidar doctor`: checks of this machine. Missing optional parts are not failures.

use crate::models::{self, bundled};
use crate::system::{Hardware, hardware};
use serde::Serialize;
use std::path::Path;
use vidar_da3::Device;

/// One finding.
#[derive(Clone, Debug, Serialize)]
pub struct Finding {
    /// The subject.
    pub what: &'static str,
    /// Fine, absent but optional, or a problem.
    pub state: State,
    /// What was found.
    pub found: String,
    /// What to do, if anything.
    pub advice: Option<String>,
}

/// Consequence of a finding for a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum State {
    /// Fine.
    Ok,
    /// Absent, and nothing needs it.
    Optional,
    /// Prevents a run.
    Problem,
}

/// Checks machine, disk and environment.
pub fn examine(folder: &Path) -> Vec<Finding> {
    let machine = hardware();
    vec![
        finding("program", State::Ok, format!("vidar {}", crate::VERSION)),
        cpu(&machine),
        memory(&machine),
        writable(folder),
        finding(
            "geometry",
            State::Ok,
            "stereo: built in, needs metric poses, no weights (MIT OR Apache-2.0)".into(),
        ),
        finding(
            "network",
            State::Ok,
            format!(
                "{}: built in, {} MiB, trained on rendered rooms ({})",
                bundled::NAME,
                bundled::bytes() >> 20,
                bundled::LICENCE
            ),
        ),
        checkpoints(),
    ]
    .into_iter()
    .chain(graphics_processors())
    .chain([links(), environment()])
    .collect()
}

/// Official checkpoints on this machine.
fn checkpoints() -> Finding {
    // Only the disk is searched.
    let listed = models::store(true).and_then(|store| Ok(store.list()?));
    let (state, found, advice) = match listed {
        Ok(listed) => {
            let names: Vec<&str> =
                listed.iter().filter(|(_, installed)| installed.is_some()).map(|(c, _)| c.name).collect();
            match names.is_empty() {
                false => (State::Ok, names.join(", "), None),
                true => {
                    let advice = "for real recordings: `vidar model pull da3-small` (131 MiB, Apache-2.0)";
                    (
                        State::Optional,
                        "no official checkpoint is installed".to_owned(),
                        Some(advice.to_owned()),
                    )
                }
            }
        }
        Err(error) => (State::Problem, error.to_string(), error.hint()),
    };
    Finding { what: "checkpoints", state, found, advice }
}

/// Graphics processors that can run networks.
fn graphics_processors() -> Vec<Finding> {
    let absent = |found: &str, advice: &str| {
        let (found, advice) = (found.to_owned(), Some(advice.to_owned()));
        vec![Finding { what: "gpu", state: State::Optional, found, advice }]
    };
    match Device::list() {
        None => absent(
            "this program was built without GPU support; everything runs on the CPU",
            "build it with `--features gpu` to run networks on one",
        ),
        Some(all) if all.is_empty() => absent(
            "no Vulkan, Metal or DirectX 12 device; everything runs on the CPU",
            "install the graphics driver with its Vulkan part",
        ),
        Some(all) => all
            .into_iter()
            .map(|(word, name)| finding("gpu", State::Ok, format!("{name}: --device {word}")))
            .collect(),
    }
}

/// Robots and geometry servers. Nobody is asked: an answer would need the network.
fn links() -> Finding {
    let at = vidar_link::DEFAULT_ENDPOINT;
    match vidar_link::is_built() {
        true => finding(
            "link",
            State::Ok,
            format!("Zenoh is built in: `vidar worker`, --geometry remote:KEY; {at} unless told otherwise"),
        ),
        false => Finding {
            what: "link",
            state: State::Optional,
            found: "this program was built without links to other machines".into(),
            advice: Some("build it with `--features link` for robots and geometry servers".into()),
        },
    }
}

fn finding(what: &'static str, state: State, found: String) -> Finding {
    Finding { what, state, found, advice: None }
}

fn cpu(machine: &Hardware) -> Finding {
    let name = machine.cpu.clone().unwrap_or_else(|| "unknown CPU".into());
    let features = machine.cpu_features.join(", ");
    finding(
        "cpu",
        State::Ok,
        format!("{name}, {} threads, {} [{features}]", machine.threads, machine.platform),
    )
}

fn memory(machine: &Hardware) -> Finding {
    const COMFORTABLE: u64 = 4 << 30;
    match machine.memory_bytes {
        None => finding("memory", State::Ok, "not reported by the system".into()),
        Some(bytes) if bytes >= COMFORTABLE => finding("memory", State::Ok, crate::run::bytes(bytes)),
        Some(bytes) => Finding {
            what: "memory",
            state: State::Ok,
            found: crate::run::bytes(bytes),
            advice: Some("bound the map with --set fusion.memory_budget_bytes=500000000".into()),
        },
    }
}

fn writable(folder: &Path) -> Finding {
    let probe = folder.join(format!(".vidar-doctor-{}", std::process::id()));
    let tried = std::fs::write(&probe, b"probe");
    // If the test file cannot be removed, it is left there.
    let _ = std::fs::remove_file(&probe);
    match tried {
        Ok(()) => finding("output", State::Ok, format!("{} can be written", folder.display())),
        Err(e) => Finding {
            what: "output",
            state: State::Problem,
            found: format!("{} cannot be written: {e}", folder.display()),
            advice: Some("change to another folder, or give -o".into()),
        },
    }
}

fn environment() -> Finding {
    let names = std::env::vars_os().filter_map(|(k, _)| k.into_string().ok());
    let set: Vec<String> = names.filter(|k| k.starts_with("VIDAR_")).collect();
    let found = if set.is_empty() { "no VIDAR_* variable is set".into() } else { set.join(", ") };
    finding("environment", State::Ok, found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_healthy_folder_has_no_problem_and_a_missing_one_has() {
        let folder = tempfile::tempdir().unwrap();
        let findings = examine(folder.path());
        assert!(findings.iter().all(|f| f.state != State::Problem));
        let missing = examine(&folder.path().join("not/there"));
        assert_eq!(missing.iter().filter(|f| f.state == State::Problem).count(), 1);
        assert!(findings.iter().any(|f| f.state == State::Ok && f.found.contains("da3-nano: built in")));
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "the test file is removed");
    }
}
