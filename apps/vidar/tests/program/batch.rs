//! Batches: the maps of `vidar run` by many processes, of which some are killed, and a recording that is none.

use crate::odometry::flight;
use crate::support::{
    ProgramOutput, VIDAR, command, copy_of_sequence, copy_tree, files_under, run_command, shared,
};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

/// The tiny room is too short for the odometry and falls back to ground truth; the flight is tracked.
const SETTINGS: &[&str] =
    &["--set", "input.poses=auto", "--stride", "2", "--set", "geometry.chunk_keyframes=4"];

/// A folder with a store, and workers that only share it.
struct Batch {
    folder: tempfile::TempDir,
    plan: String,
}

impl Batch {
    fn plan(recordings: &[&Path], more: &[&str]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let planned = plan_command(folder.path(), recordings, more).output().unwrap();
        let plan = ProgramOutput::from(planned).ends_with(0).stdout.trim().to_owned();
        Self { folder, plan }
    }

    fn store(&self) -> PathBuf {
        self.folder.path().join("the store")
    }

    /// A worker that starts elsewhere than where the plan was made.
    fn command(&self, stage: &str, index: usize) -> Command {
        let mut command = command();
        command
            .current_dir(std::env::temp_dir())
            .args(["work", "--plan", &self.plan, "--stage", stage, "--index"]);
        command.arg(index.to_string()).args(["-q", "--json", "--scratch"]).arg(self.folder.path());
        command
    }

    fn work(&self, stage: &str, index: usize) -> ProgramOutput {
        self.command(stage, index).output().unwrap().into()
    }

    /// Does all tasks of a stage and returns their records.
    fn all(&self, stage: &str, tasks: usize) -> Vec<Value> {
        (0..tasks).map(|i| self.work(stage, i).ends_with(0).json()).collect()
    }

    fn report(&self) -> Value {
        self.work("report", 0).ends_with(0).json()
    }

    /// The files of the one folder that begins with `name`.
    fn folder_of(&self, stage: &str, name: &str) -> PathBuf {
        let entries = std::fs::read_dir(self.store().join(stage)).unwrap().flatten();
        let mut found =
            entries.map(|e| e.path()).filter(|p| p.file_name().unwrap().to_string_lossy().starts_with(name));
        found.next().unwrap()
    }
}

fn plan_command(folder: &Path, recordings: &[&Path], more: &[&str]) -> Command {
    let mut command = command();
    command.current_dir(folder).arg("plan").args(recordings).args(["-q", "--config"]);
    command.arg(&shared().settings).args(SETTINGS).args(more);
    if !more.contains(&"--store") {
        command.args(["--store", "the store"]);
    }
    command
}

/// Every result that is data, with its content.
fn results(run: &Path) -> Vec<(String, Vec<u8>)> {
    let is_data = |f: &String| {
        ["map/", "depth", "trajectory/", "images/", "views.json"].iter().any(|p| f.starts_with(p))
    };
    let files: Vec<String> = files_under(run).into_iter().filter(is_data).collect();
    files.into_iter().map(|f| (f.clone(), std::fs::read(run.join(f)).unwrap())).collect()
}

/// The same recording by `vidar run`.
fn require_the_same_as_run(recording: &Path, map: &Path, code: i32) {
    let out = tempfile::tempdir().unwrap();
    let out = out.path().join("run");
    let ran: ProgramOutput =
        run_command(recording, &out, &[SETTINGS, &["-q", "--set", "eval.mode=auto"]].concat())
            .output()
            .unwrap()
            .into();
    assert_eq!(ran.code, code, "{}", ran.stderr);
    let (mine, whole) = (results(map), results(&out));
    assert!(mine.iter().any(|(name, _)| name == "map/mesh.ply"));
    let names = |r: &[(String, Vec<u8>)]| r.iter().map(|(name, _)| name.clone()).collect::<Vec<_>>();
    assert_eq!(names(&mine), names(&whole));
    for ((name, a), (_, b)) in mine.iter().zip(&whole).filter(|((name, _), _)| name != "views.json") {
        assert!(a == b, "{name} of {} differs", recording.display());
    }
}

#[test]
fn maps_are_those_of_run_though_a_worker_is_killed_and_a_recording_is_garbage() {
    let base = tempfile::tempdir().unwrap();
    let garbage = base.path().join("garbage.bag");
    std::fs::write(&garbage, vec![7; 5000]).unwrap();
    let recordings = [flight(), &shared().sequence, &garbage];
    let batch = Batch::plan(&recordings, &["--parts", "2", "--set", "eval.mode=auto"]);
    let tracked = batch.all("track", 3);
    assert_eq!(tracked[2]["task"]["problem"]["code"], "E0201");
    assert_eq!(batch.work("map", 0).ends_with(4).json()["code"], "E0407", "a map before its chunks");
    assert_eq!(batch.report()["recordings"][0]["missing"], "predict, part 0");

    // SIGKILL as soon as the first chunk is there.
    let mut child = batch.command("predict", 0).spawn().unwrap();
    let first = || {
        let folder =
            std::fs::read_dir(batch.store().join("predict")).ok()?.flatten().next()?.path().join("chunks");
        std::fs::read_dir(folder)
            .ok()?
            .flatten()
            .map(|e| e.path())
            .find(|p| p.extension().is_some_and(|e| e == "json"))
    };
    let clock = Instant::now();
    while first().is_none()
        && child.try_wait().unwrap().is_none()
        && clock.elapsed() < Duration::from_secs(120)
    {
        std::thread::sleep(Duration::from_millis(1));
    }
    child.kill().unwrap();
    child.wait().unwrap();
    let kept = first().expect("a chunk was predicted before the worker was killed").with_extension("npz");
    let made = std::fs::metadata(&kept).unwrap().modified().unwrap();
    assert_eq!(batch.report()["recordings"][0]["missing"], "predict, part 0", "no record, so not done");

    let predicted = batch.all("predict", 6);
    assert_eq!(
        std::fs::metadata(&kept).unwrap().modified().unwrap(),
        made,
        "its chunk was not predicted again"
    );
    assert!(
        predicted[..2].iter().all(|p| p["task"]["result"]["chunks"].as_u64().unwrap() > 1),
        "{predicted:?}"
    );
    let maps = batch.all("map", 3);
    require_the_same_as_run(flight(), &batch.folder_of("maps", "flight_to_track"), 0);
    require_the_same_as_run(&shared().sequence, &batch.folder_of("maps", "tiny_room"), 3);

    let table = batch.report();
    assert_eq!(table["counts"]["failed"], 1);
    let rows = table["recordings"].as_array().unwrap();
    assert!(rows[0]["result"]["scores"]["ate"].as_f64().unwrap() < 0.1, "{}", rows[0]);
    assert!(rows[0]["cost"]["processor_seconds"].as_f64().unwrap_or(1.0) > 0.1);
    assert_eq!(rows[2]["problem"]["code"], "E0201");
    let text =
        std::fs::read_to_string(batch.store().join(table["folder"].as_str().unwrap()).join("report.md"))
            .unwrap();
    assert!(text.contains("tiny_room") && text.contains("E0201"), "{text}");

    // Again: everything is there, nothing is written but the table.
    let before = files_under(&batch.store());
    for (stage, tasks) in [("track", 3), ("predict", 6), ("map", 3)] {
        assert!(batch.all(stage, tasks).iter().all(|t| t["was_there"] == true), "{stage}");
    }
    assert_eq!(files_under(&batch.store()), before);
    assert_eq!(batch.report()["counts"], table["counts"]);
    let left =
        std::fs::read_dir(batch.folder.path()).unwrap().flatten().filter(|e| e.path() != batch.store());
    assert_eq!(left.count(), 1, "only the worker that was killed left its scratch folder");

    // The same recordings in other parts are another plan, whose maps are there.
    let again = plan_command(batch.folder.path(), &recordings, &["--parts", "3", "--set", "eval.mode=auto"]);
    let plan = ProgramOutput::from({ again }.output().unwrap()).ends_with(0).stdout.trim().to_owned();
    assert_ne!(plan, batch.plan);
    let other = Batch { plan, ..batch };
    assert!(
        other.all("predict", 9).iter().all(|t| t["was_there"] == true || t["task"]["status"] == "failed")
    );
    assert_eq!(other.all("map", 3)[0]["task"]["result"], maps[0]["task"]["result"]);
}

/// A scheduler gives a task that hangs to another node, and the first one goes on later.
#[cfg(unix)]
#[test]
fn a_node_that_stands_still_and_goes_on_after_another_did_its_task_changes_nothing() {
    let batch = Batch::plan(&[&shared().sequence], &["--parts", "1"]);
    batch.all("track", 1);
    let slow = batch.command("predict", 0).stdout(std::process::Stdio::piped()).spawn().unwrap();
    let signal = |name: &str| {
        let sent = Command::new("kill").args([name, &slow.id().to_string()]).status().unwrap();
        assert!(sent.success(), "{name}");
    };
    let clock = Instant::now();
    // Its folder is there from the beginning of its task on.
    let is_scratch = |e: std::io::Result<std::fs::DirEntry>| {
        e.is_ok_and(|e| e.file_name().to_string_lossy().starts_with("vidar-work-"))
    };
    let begun = || batch.folder.path().read_dir().unwrap().any(is_scratch);
    while !begun() && clock.elapsed() < Duration::from_secs(120) {
        std::thread::sleep(Duration::from_millis(1));
    }
    signal("-STOP");
    let chunks = |of: &Value| of["task"]["result"]["chunks"].as_u64();
    let quick = batch.all("predict", 1).remove(0);
    assert_eq!(quick["was_there"], false, "the slow one had not ended");
    let map = batch.all("map", 1).remove(0);
    let before = results(&batch.folder_of("maps", "tiny_room"));
    signal("-CONT");
    let ended: ProgramOutput = slow.wait_with_output().unwrap().into();
    assert_eq!(chunks(&ended.ends_with(0).json()), chunks(&quick));
    assert!(results(&batch.folder_of("maps", "tiny_room")) == before);
    let again = batch.all("map", 1).remove(0);
    assert_eq!((&again["was_there"], &again["task"]["result"]), (&true.into(), &map["task"]["result"]));
    assert_eq!(batch.report()["counts"], serde_json::json!({ "degraded": 1 }));
}

/// Needs a server that speaks S3: `VIDAR_TEST_S3=s3://bucket/prefix`, with its endpoint and keys in `AWS_…` (`.ci/s3`).
#[cfg(feature = "s3")]
#[test]
fn a_batch_in_an_object_store_makes_the_files_of_one_in_a_folder() {
    let Ok(bucket) = std::env::var("VIDAR_TEST_S3") else {
        return vidar_core::testing::skipped(&"VIDAR_TEST_S3 names no bucket");
    };
    let recordings = [shared().sequence.as_path()];
    let in_folder = Batch::plan(&recordings, &["--parts", "2"]);
    let in_bucket = Batch::plan(&recordings, &["--parts", "2", "--store", &format!("{bucket}/batch")]);
    assert!(in_bucket.plan.starts_with("s3://") && !in_bucket.store().exists(), "{}", in_bucket.plan);
    for (stage, tasks) in [("track", 1), ("predict", 2), ("map", 1)] {
        let made = |batch: &Batch| -> Vec<(String, Option<Value>)> {
            let tasks = batch.all(stage, tasks);
            let files = tasks.iter().flat_map(|t| t["task"]["files"].as_array().unwrap());
            let of = |file: &Value| {
                let path = file["path"].as_str().unwrap().to_owned();
                // Others, as the record of what was tracked, hold times of this machine.
                let is_data = ["map/", "depth", "trajectory/", "images/", "chunks/"]
                    .iter()
                    .any(|p| path.starts_with(p));
                (path, is_data.then(|| file["sha256"].clone()))
            };
            files.map(of).collect()
        };
        let found = made(&in_bucket);
        assert!(found.len() >= tasks, "{stage}: {found:?}");
        assert!(stage != "map" || found.iter().any(|(path, hash)| path == "map/mesh.ply" && hash.is_some()));
        assert_eq!(found, made(&in_folder), "{stage}");
        assert!(in_bucket.all(stage, tasks).iter().all(|t| t["was_there"] == true), "{stage} again");
    }
    assert_eq!(in_bucket.report()["counts"], in_folder.report()["counts"]);
}

#[test]
fn chunks_of_a_network_that_overlap_are_placed_as_in_one_run() {
    const NETWORK: &[&str] =
        &["--geometry", "simulated", "--mode", "coupled", "--set", "geometry.overlap_keyframes=2"];
    let batch = Batch::plan(&[&shared().sequence], &[NETWORK, &["--parts", "3"]].concat());
    for (stage, tasks) in [("track", 1), ("predict", 3), ("map", 1)] {
        batch.all(stage, tasks);
    }
    let out = batch.folder.path().join("run");
    let ran: ProgramOutput = run_command(&shared().sequence, &out, &[SETTINGS, NETWORK, &["-q"]].concat())
        .output()
        .unwrap()
        .into();
    assert_eq!(ran.code, 3, "{}", ran.stderr);
    let mesh = |run: &Path| std::fs::read(run.join("map/mesh.ply")).unwrap();
    assert!(mesh(&out) == mesh(&batch.folder_of("maps", "tiny_room")));
}

#[test]
fn what_is_no_plan_or_was_changed_is_refused_and_leaves_no_record() {
    let base = tempfile::tempdir().unwrap();
    let sequence = copy_of_sequence(base.path());
    let batch = Batch::plan(&[&sequence], &["--parts", "1"]);
    let code =
        |ran: ProgramOutput, code: i32| ran.ends_with(code).json()["code"].as_str().unwrap().to_owned();
    assert_eq!(code(batch.work("track", 1), 2), "E0105");
    for (plan, found) in [
        (batch.plan.replace("/plans/", "/plan/"), "E0212"),
        (batch.plan.replace(".json", "0.json"), "E0212"),
        (batch.plan.replace("the store", "no store"), "E0406"),
        (batch.plan.replace("/plans/", "/plans/../"), "E0212"),
        (format!("s4://bucket{}", batch.plan), "E0105"),
    ] {
        let ran = command().args(["work", "--plan", &plan, "--stage", "track", "--json"]).output().unwrap();
        assert_eq!(ProgramOutput::from(ran).json()["code"], found, "{plan}");
    }
    assert!(!batch.folder.path().join("no store").exists());
    let text = std::fs::read_to_string(&batch.plan).unwrap();
    std::fs::write(&batch.plan, text.replace("\"parts\": 1", "\"parts\": 2")).unwrap();
    assert_eq!(code(batch.work("track", 0), 1), "E0212", "a plan is what its name says");
    std::fs::write(&batch.plan, &text).unwrap();

    // A worker on which the recording's disk is not mounted says so, and another one may do it.
    let away = base.path().join("away");
    std::fs::rename(&sequence, &away).unwrap();
    assert_ne!(batch.work("track", 0).code, 0);
    std::fs::rename(&away, &sequence).unwrap();
    // So may it after a disk was full, in any stage.
    let records = || files_under(&batch.store()).iter().filter(|f| f.starts_with("records/")).count();
    for (done, stage) in ["track", "predict", "map"].into_iter().enumerate() {
        if cfg!(target_os = "linux") {
            let mut limited = Command::new("sh");
            limited.args(["-c", "trap '' XFSZ; ulimit -f 2; exec \"$0\" \"$@\"", VIDAR]);
            limited.args(batch.command(stage, 0).get_args());
            assert_eq!(code(limited.output().unwrap().into(), 4), "E0402", "{stage}");
        }
        assert_eq!(records(), done, "{stage}: what failed has no record");
        // Ground truth in place of the odometry is told with the depth that it places.
        if stage != "map" {
            let status = &batch.all(stage, 1)[0]["task"]["status"];
            assert_eq!(status, if stage == "track" { "done" } else { "degraded" });
        }
    }

    // A chunk that was damaged on its way is not mapped.
    let chunk = batch.folder_of("predict", "copy").join("chunks/000000.npz");
    let bytes = std::fs::read(&chunk).unwrap();
    std::fs::write(&chunk, &bytes[..bytes.len() - 9]).unwrap();
    assert_eq!(code(batch.work("map", 0), 1), "E0212");
    std::fs::write(&chunk, &bytes).unwrap();
    // Nor is a recording that is another one by now.
    copy_tree(&sequence, &away);
    let yaml = sequence.join("mav0/cam0/sensor.yaml");
    let calibration = std::fs::read_to_string(&yaml).unwrap();
    std::fs::write(&yaml, calibration.replace("rate_hz: 8", "rate_hz: 9")).unwrap();
    assert_eq!(code(batch.work("map", 0), 2), "E0107");
    std::fs::write(&yaml, calibration).unwrap();
    assert_eq!(batch.all("map", 1)[0]["was_there"], false);
}

#[test]
fn a_plan_names_what_is_wrong_before_anything_is_worked_on() {
    let base = tempfile::tempdir().unwrap();
    let sequence = shared().sequence.as_path();
    let planned = |recordings: &[&Path], more: &[&str]| -> ProgramOutput {
        plan_command(base.path(), recordings, &[more, &["--json"]].concat()).output().unwrap().into()
    };
    planned(&[Path::new("/no/such.bag")], &[]).ends_with(4).says(&["error[E0401]", "/no/such.bag"]);
    planned(&[sequence, sequence], &[]).ends_with(2).says(&["the same recording"]);
    planned(&[sequence], &["--parts", "0"]).ends_with(2).says(&["--parts 0"]);
    planned(&[sequence], &["--set", "fusion.voxel_size=1"]).ends_with(2).says(&["error[E0101]"]);
    let store = base.path().join("the store");
    assert!(!store.join("plans").exists());
    let plan = planned(&[sequence], &["--parts", "5"]).ends_with(0).json();
    assert_eq!(plan["stages"][1], serde_json::json!({ "stage": "predict", "tasks": 5, "per_recording": 5 }));
    // The same plan has the same address.
    assert_eq!(planned(&[sequence], &["--parts", "5"]).ends_with(0).json()["plan"], plan["plan"]);
}
