//! A tiny recording, rendered once, and functions to run the program.

use serde_json::Value;
use std::ffi::OsStr;
use std::io::{BufRead, BufReader, Write};
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;
use tempfile::TempDir;

/// The program under test.
pub const VIDAR: &str = env!("CARGO_BIN_EXE_vidar");

/// Small images, two and a half seconds: a run takes about a second on one core.
const WORLD: &str = "duration_secs = 2.5\ncamera_rate_hz = 8.0\nwidth = 160\nheight = 104\nblur_samples = 1\n\
    exposure_secs = 0.0\nscan_spacing_m = 0.05\n";

/// Coarse voxels, no pictures, no evaluation by default: most tests need only the pipeline.
/// The recording is too short for the odometry to initialise, so ground truth is asked for.
const SETTINGS: &str = "[input]\nposes = \"ground-truth\"\n[fusion]\nvoxel_size_m = 0.04\n[eval]\nmode = \"off\"\n[output]\nreport = false\nmesh_glb = false\n";

/// Exit code and output of a call of the program.
pub struct ProgramOutput {
    pub code: i32,
    pub stdout: String,
    pub stderr: String,
}

impl ProgramOutput {
    /// The one JSON object on the standard output.
    pub fn json(&self) -> Value {
        serde_json::from_str(&self.stdout).unwrap_or_else(|e| panic!("{e}\n{}\n{}", self.stdout, self.stderr))
    }

    /// Fails with all output unless the exit code is `code`.
    #[track_caller]
    pub fn ends_with(self, code: i32) -> Self {
        assert_eq!(self.code, code, "stdout:\n{}\nstderr:\n{}", self.stdout, self.stderr);
        assert!(!self.stderr.contains("panicked"), "{}", self.stderr);
        self
    }

    /// Fails unless the error stream contains all `words`.
    #[track_caller]
    pub fn says(self, words: &[&str]) -> Self {
        for word in words {
            assert!(self.stderr.contains(word), "{word:?} is missing in:\n{}", self.stderr);
        }
        self
    }
}

impl From<Output> for ProgramOutput {
    fn from(output: Output) -> Self {
        Self {
            code: output.status.code().unwrap_or(-1),
            stdout: String::from_utf8_lossy(&output.stdout).into_owned(),
            stderr: String::from_utf8_lossy(&output.stderr).into_owned(),
        }
    }
}

/// The program, without `VIDAR_*` variables of the caller's environment.
pub fn command() -> Command {
    let mut command = Command::new(VIDAR);
    for (name, _) in std::env::vars_os().filter(|(n, _)| n.to_string_lossy().starts_with("VIDAR_")) {
        command.env_remove(name);
    }
    command
}

/// Runs the program in `folder`.
pub fn vidar_in<S: AsRef<OsStr>>(folder: &Path, args: &[S]) -> ProgramOutput {
    command().current_dir(folder).args(args).output().unwrap().into()
}

/// Runs the program in the temporary folder of the test process.
pub fn vidar<S: AsRef<OsStr>>(args: &[S]) -> ProgramOutput {
    vidar_in(&shared().root, args)
}

/// Files that tests may read but not change.
pub struct Shared {
    pub root: PathBuf,
    /// The recording in EuRoC layout.
    pub sequence: PathBuf,
    /// Settings that keep a run short.
    pub settings: PathBuf,
    /// Description of the world.
    pub world: PathBuf,
    _folder: TempDir,
}

/// The shared recording.
pub fn shared() -> &'static Shared {
    static SHARED: OnceLock<Shared> = OnceLock::new();
    SHARED.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        // A path with a space and non-ASCII letters everywhere, so that nothing works only without them.
        let root = folder.path().join("Räume 測試 one");
        std::fs::create_dir_all(&root).unwrap();
        let (world, settings) = (root.join("world.toml"), root.join("settings.toml"));
        std::fs::write(&world, WORLD).unwrap();
        std::fs::write(&settings, SETTINGS).unwrap();
        let sequence = root.join("tiny room");
        let made = command()
            .args(["synth".as_ref(), sequence.as_os_str(), "--world-config".as_ref(), world.as_os_str()])
            .output();
        ProgramOutput::from(made.unwrap()).ends_with(0);
        Shared { root, sequence, settings, world, _folder: folder }
    })
}

/// A finished run on the shared recording that tests read together.
pub fn finished() -> &'static (PathBuf, Value) {
    static RUN: OnceLock<(PathBuf, Value)> = OnceLock::new();
    RUN.get_or_init(|| {
        let out = shared().root.join("finished run");
        let ran =
            run_on(&shared().sequence, &out, &["--json", "--progress", "off", "--set", "eval.mode=auto"])
                .ends_with(0);
        let json = ran.json();
        (out, json)
    })
}

/// `vidar run SEQUENCE -o OUT --config <short> …`.
pub fn run_on(sequence: &Path, out: &Path, more: &[&str]) -> ProgramOutput {
    run_command(sequence, out, more).output().unwrap().into()
}

/// The same, not yet started.
pub fn run_command(sequence: &Path, out: &Path, more: &[&str]) -> Command {
    let mut command = command();
    command.arg("run").arg(sequence).arg("-o").arg(out).arg("--config").arg(&shared().settings);
    if more.iter().any(|m| m.starts_with("--trajectory")) {
        command.args(["--set", "input.poses=external"]);
    }
    command.args(more);
    command
}

/// A copy of the shared recording that a test may spoil.
pub fn copy_of_sequence(into: &Path) -> PathBuf {
    let target = into.join("copy");
    copy_tree(&shared().sequence, &target);
    target
}

/// Copies a folder with everything in it.
pub fn copy_tree(from: &Path, to: &Path) {
    std::fs::create_dir_all(to).unwrap();
    for entry in std::fs::read_dir(from).unwrap().flatten() {
        let target = to.join(entry.file_name());
        if entry.path().is_dir() {
            copy_tree(&entry.path(), &target);
        } else {
            std::fs::copy(entry.path(), target).unwrap();
        }
    }
}

/// Every file under a folder, relative, sorted.
pub fn files_under(folder: &Path) -> Vec<String> {
    fn walk(root: &Path, folder: &Path, found: &mut Vec<String>) {
        for entry in std::fs::read_dir(folder).unwrap().flatten() {
            if entry.path().is_dir() {
                walk(root, &entry.path(), found);
            } else {
                found.push(entry.path().strip_prefix(root).unwrap().to_string_lossy().replace('\\', "/"));
            }
        }
    }
    let mut found = Vec::new();
    walk(folder, folder, &mut found);
    found.sort();
    found
}

/// The images of a recording in order.
pub fn images_of(sequence: &Path) -> Vec<PathBuf> {
    let folder = sequence.join("mav0/cam0/data");
    files_under(&folder).iter().map(|name| folder.join(name)).collect()
}

/// The keys of a JSON object, in order, nested ones as `a.b`.
pub fn keys(value: &Value, depth: usize) -> Vec<String> {
    let mut found = Vec::new();
    for (name, inner) in value.as_object().into_iter().flatten() {
        found.push(name.clone());
        if depth > 1 {
            found.extend(keys(inner, depth - 1).into_iter().map(|k| format!("{name}.{k}")));
        }
    }
    found
}

/// The manifest of a run.
pub fn manifest(run: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(run.join("manifest.json")).unwrap()).unwrap()
}

/// A server on this machine that answers every request by `answer` of its first line, and its address.
pub fn http_server(answer: fn(&str) -> String) -> String {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = format!("http://{}", listener.local_addr().unwrap());
    std::thread::spawn(move || {
        for stream in listener.incoming().flatten() {
            let mut first = String::new();
            let mut lines = BufReader::new(&stream);
            let _ = lines.read_line(&mut first);
            let mut line = String::new();
            while lines.read_line(&mut line).is_ok_and(|n| n > 2) {
                line.clear();
            }
            let _ = (&stream).write_all(answer(&first).as_bytes());
        }
    });
    address
}
