//! Output that cannot be written, readers that go away, and signals.

use super::{SHORT, text};
use crate::support::{ProgramOutput, VIDAR, files_under, manifest, run_command, run_on, shared, vidar};
use std::fs;
use std::path::Path;
use std::process::{Command, Stdio};

#[test]
#[cfg(unix)]
fn an_output_that_cannot_be_made_ends_with_4() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("a file");
    fs::write(&file, "mine").unwrap();
    let ran =
        run_on(&shared().sequence, &file.join("below"), SHORT).ends_with(4).says(&["error[E0401]", "a file"]);
    assert!(ran.stderr.contains("hint:"));
    run_on(&shared().sequence, &file, SHORT).ends_with(4).says(&["error[E0401]"]);
    assert_eq!(fs::read_to_string(&file).unwrap(), "mine");
    run_on(&shared().sequence, Path::new("/proc/vidar-out"), SHORT).ends_with(4).says(&["error[E0401]"]);
    vidar(&["synth", text(&file.join("below"))]).ends_with(4).says(&["error[E0401]"]);
}

#[test]
#[cfg(unix)]
fn a_full_disk_ends_with_4_keeps_what_is_finished_and_leaves_no_half_file() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    // No file may grow beyond 1600 blocks of 512 or 1024 bytes: images, depth and chunks of four views fit, the mesh does not.
    let script = "trap '' XFSZ; ulimit -f 1600; exec \"$0\" \"$@\"";
    let ran: ProgramOutput = Command::new("sh")
        .args(["-c", script, VIDAR, "run"])
        .arg(&shared().sequence)
        .args(["-q", "-o", text(&out), "--set", "fusion.voxel_size_m=0.012", "--set", "output.report=false"])
        .args(["--set", "geometry.chunk_keyframes=4", "--set", "eval.mode=off"])
        .output()
        .unwrap()
        .into();
    let ran = ran.ends_with(4).says(&["error[E0402]", "hint:", "finished files are kept"]);
    assert!(ran.stderr.contains("mesh") || ran.stderr.contains("points"), "{}", ran.stderr);
    let files = files_under(&out);
    assert!(files.iter().filter(|f| f.starts_with("depth/")).count() > 10, "{files:?}");
    for file in &files {
        assert!(!file.ends_with(".part") && !file.contains("tmp"), "half a file: {file}");
    }
    assert!(!files.contains(&"map/mesh.ply".to_owned()), "{files:?}");
    // What happened is written down where the finished files are.
    let manifest = manifest(&out);
    assert_eq!(manifest["exit"], 4);
    assert_eq!(manifest["result"]["error"]["code"], "E0402");
    assert!(manifest["seconds"]["read"].as_f64().unwrap() > 0.0);
}

#[test]
#[cfg(target_os = "linux")]
fn data_that_a_full_standard_output_swallows_is_an_error() {
    let full = fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let child =
        Command::new(VIDAR).args(["config", "show"]).stdout(full).stderr(Stdio::piped()).spawn().unwrap();
    ProgramOutput::from(child.wait_with_output().unwrap())
        .ends_with(4)
        .says(&["error[E0402]", "standard output"]);
}

#[test]
#[cfg(unix)]
fn readers_that_go_away_are_no_error_and_no_panic() {
    for line in [
        "\"$0\" config show | head -1",
        "\"$0\" completions zsh | head -1",
        "\"$0\" explain all | true",
        "\"$0\" --help | true",
        "\"$0\" config schema >&-",
        "\"$0\" doctor 2>&-",
        "\"$0\" config show --set a.b=1 2>&- >&-; test $? -eq 2",
    ] {
        let ran: ProgramOutput =
            Command::new("bash").args(["-o", "pipefail", "-c", line, VIDAR]).output().unwrap().into();
        assert!(ran.code == 0, "{line}: {} {}", ran.code, ran.stderr);
        assert!(!ran.stderr.contains("panicked"), "{line}: {}", ran.stderr);
    }
    // A terminal closed while a run goes on.
    let out = shared().root.join("closed terminal");
    let mut child = run_command(&shared().sequence, &out, &["--stride", "2"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    drop((child.stdout.take(), child.stderr.take()));
    assert_eq!(child.wait().unwrap().code(), Some(0));
    assert!(out.join("manifest.json").is_file());
}

/// Starts a run that takes several seconds, sends `signal` once depth is there, and returns how it ended.
#[cfg(unix)]
fn interrupted_by(signal: &str, out: &Path) -> ProgramOutput {
    let slow = ["--set", "geometry.chunk_keyframes=2", "--set", "geometry.context_keyframes=4"];
    let child = run_command(&shared().sequence, out, &slow)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let started = std::time::Instant::now();
    while !out.join("chunks/000001.json").exists() {
        assert!(started.elapsed().as_secs() < 60, "no depth after a minute");
        std::thread::sleep(std::time::Duration::from_millis(2));
    }
    let id = child.id().to_string();
    assert!(Command::new("kill").args([&format!("-{signal}"), &id]).status().unwrap().success());
    child.wait_with_output().unwrap().into()
}

#[test]
#[cfg(unix)]
fn a_signal_finishes_the_files_and_ends_with_130() {
    for signal in ["INT", "TERM", "HUP"] {
        let folder = tempfile::tempdir().unwrap();
        let out = folder.path().join("out");
        let ran = interrupted_by(signal, &out).ends_with(130).says(&["stopping", "error[E1301]"]);
        assert!(ran.stderr.contains(text(&out)), "{}", ran.stderr);
        let manifest = manifest(&out);
        assert_eq!(manifest["exit"], 130);
        let done = manifest["result"]["keyframes_with_depth"].as_u64().unwrap();
        assert!(done >= 1 && done < manifest["result"]["keyframes"].as_u64().unwrap(), "{done}");
        let files = files_under(&out);
        assert_eq!(
            files.iter().filter(|f| f.starts_with("depth/") && f.ends_with(".png")).count() as u64,
            done
        );
        assert!(files.contains(&"map/mesh.ply".to_owned()) && files.iter().all(|f| !f.ends_with(".part")));
    }
}
