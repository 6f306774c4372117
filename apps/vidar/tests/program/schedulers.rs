//! The scripts of `examples/batches`, with programs in place of a cluster's that run each task here: what is checked is what the scripts
//! ask for, in which order, and that it makes the maps; not a cluster.
#![cfg(unix)]

use crate::support::{ProgramOutput, VIDAR, shared};
use serde_json::Value;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Tells its options to `told`, and runs the tasks of an array one after the other.
const SBATCH: &str = r#"#!/bin/sh
first=0 last=0
echo "sbatch $*" >> "$TOLD"
while [ $# -gt 0 ]; do
    case $1 in
        --array) first=${2%-*} last=${2#*-} ;;
        --wrap) line=$2 ;;
    esac
    shift
done
for index in $(seq "$first" "$last"); do
    SLURM_ARRAY_TASK_ID=$index sh -c "$line" >> "$TOLD.out" 2>&1
done
wc -l < "$TOLD" | tr -d ' '
"#;

/// Runs the containers of an indexed job one after the other, as the pods would.
const KUBECTL: &str = r#"#!/bin/sh
echo "kubectl $*" >> "$TOLD"
case $1 in
    apply)
        manifest=$(cat)
        printf '%s\n' "$manifest" >> "$TOLD"
        count=$(printf '%s\n' "$manifest" | sed -n 's/^  completions: //p')
        # ["work", "--plan", ...] as words of a shell.
        words=$(printf '%s\n' "$manifest" | sed -n 's/^ *args: \[\(.*\)\]$/\1/p' | sed "s/\", \"/' '/g; s/^\"/'/; s/\"\$/'/; s|'/scratch'|'$SCRATCH'|")
        for index in $(seq 0 $((count - 1))); do
            line=$(printf '%s' "$words" | sed "s/\$(JOB_COMPLETION_INDEX)/$index/")
            eval "vidar $line" >> "$TOLD.out" 2>&1
        done ;;
    get) echo Complete ;;
esac
"#;

struct Cluster {
    folder: tempfile::TempDir,
}

impl Cluster {
    /// A folder with a recording that is one, one that is none, and programs `name` and `vidar` on the path.
    fn new(name: &str, text: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let programs = folder.path().join("programs");
        std::fs::create_dir(&programs).unwrap();
        std::os::unix::fs::symlink(VIDAR, programs.join("vidar")).unwrap();
        std::fs::write(programs.join(name), text).unwrap();
        std::fs::set_permissions(programs.join(name), std::fs::Permissions::from_mode(0o755)).unwrap();
        std::fs::write(folder.path().join("garbage.bag"), vec![7; 5000]).unwrap();
        Self { folder }
    }

    fn told(&self) -> PathBuf {
        self.folder.path().join("told")
    }

    /// Runs a script; what it asked the cluster for, line by line, and the report of the batch.
    fn run(&self, script: &str) -> (Vec<String>, Value) {
        let scripts = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/batches");
        let path = format!(
            "{}:{}",
            self.folder.path().join("programs").display(),
            std::env::var("PATH").unwrap_or_default()
        );
        let _ = std::fs::remove_file(self.told());
        let mut command = Command::new("sh");
        command.arg(scripts.join(script)).arg(&shared().sequence).arg(self.folder.path().join("garbage.bag"));
        command.arg("--store").arg(self.folder.path().join("the store")).args(["--parts", "2", "-q"]);
        command.arg("--config").arg(&shared().settings);
        command.args(["--set", "input.poses=auto", "--stride", "2", "--set", "geometry.chunk_keyframes=4"]);
        command.env("PATH", path).env("TOLD", self.told()).env("CPUS", "1");
        command.env("CLAIM", "recordings").env("SCRATCH", self.folder.path());
        ProgramOutput::from(command.output().unwrap()).ends_with(0);
        let told = std::fs::read_to_string(self.told()).unwrap();
        let reports = std::fs::read_dir(self.folder.path().join("the store/reports")).unwrap();
        let report = reports.flatten().next().unwrap().path().join("report.json");
        let report = serde_json::from_slice(&std::fs::read(report).unwrap()).unwrap();
        (told.lines().map(str::to_owned).collect(), report)
    }

    /// One map, one failure that is told, and nothing that is done again.
    fn maps(&self, script: &str) -> Vec<String> {
        let (told, report) = self.run(script);
        let output = || std::fs::read_to_string(self.folder.path().join("told.out")).unwrap_or_default();
        let rows = report["recordings"].as_array().unwrap();
        assert!(rows[0]["result"]["scores"].is_object(), "{report}: {}", output());
        assert_eq!(rows[1]["problem"]["code"], "E0201", "{report}: {}", output());
        assert_eq!(report["counts"]["failed"], 1, "{report}");
        let maps = || {
            let map = std::fs::read_dir(self.folder.path().join("the store/maps")).unwrap().flatten();
            map.map(|m| m.path().join("map/mesh.ply").metadata().unwrap().modified().unwrap()).collect()
        };
        let before: Vec<std::time::SystemTime> = maps();
        assert_eq!(before.len(), 1);
        let (_, again) = self.run(script);
        assert_eq!(again["counts"], report["counts"]);
        assert_eq!(maps(), before, "the map is there and is not made again");
        told
    }
}

#[test]
fn arrays_of_slurm_wait_for_one_another_and_make_the_maps() {
    let told = Cluster::new("sbatch", SBATCH).maps("slurm.sh");
    let options = |line: &str, name: &str| {
        let words: Vec<&str> = line.split_whitespace().collect();
        words.iter().position(|w| *w == name).map(|at| words[at + 1].to_owned())
    };
    let of = |name: &str| told.iter().map(|line| options(line, name)).collect::<Vec<_>>();
    let some = |words: [&str; 3]| words.map(|w| Some(w.to_owned()));
    assert_eq!(of("--array")[..3], some(["0-1", "0-3", "0-1"]));
    // The stand-in numbers its jobs.
    assert_eq!(of("--dependency")[1..], some(["afterany:1", "afterany:2", "afterany:3"]));
    assert_eq!(of("--dependency")[0], None);
}

#[test]
fn indexed_jobs_of_kubernetes_follow_one_another_and_make_the_maps() {
    let told = Cluster::new("kubectl", KUBECTL).maps("kubernetes.sh");
    let completions: Vec<&str> = told.iter().filter_map(|l| l.strip_prefix("  completions: ")).collect();
    assert_eq!(completions, ["2", "4", "2", "1"]);
    let is_filled_in = |line: &&String| line.starts_with("kubectl ") || !line.contains('@');
    assert!(told.iter().all(|line| is_filled_in(&line)), "{told:?}");
}
