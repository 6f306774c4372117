//! Every verb, its help, its exit codes and its machine-readable form.

mod eval;
mod export;

use crate::support::{command, files_under, finished, keys, manifest, run_on, shared, vidar, vidar_in};
use serde_json::Value;
use std::path::Path;

const VERBS: &[&[&str]] = &[
    &["run"],
    &["demo"],
    &["inspect"],
    &["convert"],
    &["eval"],
    &["export"],
    &["compare"],
    &["view"],
    &["depth"],
    &["model"],
    &["model", "list"],
    &["model", "pull"],
    &["model", "import"],
    &["model", "verify"],
    &["model", "check"],
    &["model", "where"],
    &["synth"],
    &["doctor"],
    &["config"],
    &["config", "show"],
    &["config", "explain"],
    &["config", "presets"],
    &["config", "schema"],
    &["explain"],
    &["completions"],
];

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

#[test]
fn every_verb_has_help_on_the_standard_output_that_fits_a_terminal() {
    for verb in VERBS {
        for flag in ["--help", "-h"] {
            let args: Vec<&str> = verb.iter().copied().chain([flag]).collect();
            let ran = vidar(&args).ends_with(0);
            assert!(ran.stdout.contains("Usage: vidar"), "{verb:?}");
            assert!(ran.stderr.is_empty(), "{verb:?}: {}", ran.stderr);
            let widest = ran.stdout.lines().map(|l| l.chars().count()).max().unwrap();
            assert!(widest <= 140, "{verb:?} {flag} has a line of {widest} columns");
        }
    }
    assert!(vidar(&["--version"]).ends_with(0).stdout.starts_with("vidar 0."));
}

#[test]
fn a_wrong_command_line_ends_with_2() {
    for args in [
        &["fly"][..],
        &["run"],
        &["run", ".", "--no-such-flag"],
        &["export", ".", "--to", "dwg"],
        &["synth", "x", "--scene", "moon"],
        &["synth", "x", "--duration", "nan"],
        &["run", ".", "--trajectory-body", "wing"],
        &["run", ".", "--depth-intrinsics", "1,2,3"],
        &["run", ".", "--set", "fusion.voxel_size_m"],
        &["run", ".", "--fail-above", "ate"],
        &["completions", "tcsh"],
        &["explain", "E9999"],
        &["eval", "a.ply", "b.tum"],
    ] {
        let ran = vidar(args);
        assert!(ran.stdout.is_empty(), "{args:?} printed an error on the standard output");
        // A world out of range is bad input to `synth`; everything else is a wrong command line.
        let code = if args.contains(&"nan") { 1 } else { 2 };
        let ran = ran.ends_with(code);
        assert!(ran.stderr.starts_with("error"), "{args:?}: {}", ran.stderr);
    }
}

#[test]
fn inspect_prints_the_same_as_text_and_json() {
    let sequence = text(&shared().sequence);
    let ran = vidar(&["inspect", sequence]).ends_with(0);
    for word in ["euroc", "20", "8.0 Hz", "200", "ground truth", "-> vidar run"] {
        assert!(ran.stdout.contains(word), "{word:?} is missing in\n{}", ran.stdout);
    }
    let json = vidar(&["inspect", sequence, "--json"]).ends_with(0).json();
    assert_eq!(json["schema"], "vidar.inspect/1");
    assert_eq!(
        keys(&json, 1),
        [
            "schema", "name", "kind", "reason", "streams", "camera", "imu", "poses", "images", "motion",
            "missing", "found", "advice", "possible", "warnings"
        ]
    );
    assert_eq!(
        keys(&json["streams"][0], 1),
        ["what", "count", "start_secs", "length_secs", "rate_hz", "longest_gap_secs"]
    );
}

#[test]
fn a_run_as_json_has_stable_keys() {
    let (folder, json) = finished();
    assert_eq!(keys(json, 1), ["schema", "folder", "exit", "result", "scores"]);
    assert_eq!(json["schema"], "vidar.run/1");
    assert_eq!(json["folder"], text(folder));
    assert_eq!(json["exit"], 0);
    assert_eq!(
        keys(&json["result"], 1),
        [
            "keyframes",
            "keyframes_with_depth",
            "mesh_triangles",
            "points",
            "coverage",
            "volume_bytes",
            "double_walls",
            "metric_poses",
            "coupling",
            "place_recognition",
            "is_metric",
            "verdict",
            "scale",
            "odometry",
            "placement",
            "pose_correction",
            "evaluation",
            "seconds",
            "budget"
        ]
    );
    assert_eq!(
        keys(&json["result"]["pose_correction"], 1),
        ["center_rms_m", "center_share", "log_scale_std", "rotation_rms_deg", "std_m", "std_deg"]
    );
    assert_eq!(
        keys(&json["result"]["evaluation"], 1),
        ["trajectory", "metric_trajectory", "surface", "depth"]
    );
    let scores: Vec<&str> = json["scores"].as_object().unwrap().keys().map(String::as_str).collect();
    for name in ["abs-rel", "chamfer", "delta-f", "f@0.05", "f@0.10"] {
        assert!(scores.contains(&name), "{name} in {scores:?}");
    }
}

#[test]
fn the_run_folder_matches_its_readme_and_its_manifest() {
    let (folder, _) = finished();
    let files = files_under(folder);
    for file in [
        "README.txt",
        "config.resolved.toml",
        "depth/depth.json",
        "eval/metrics.json",
        "log.jsonl",
        "manifest.json",
        "map/coverage.json",
        "map/mesh.ply",
        "map/points.ply",
        "trajectory/metric_camera.tum",
        "trajectory/keyframes_camera.euroc.csv",
        "views.json",
    ] {
        assert!(files.iter().any(|f| f == file), "{file} is missing in {files:?}");
    }
    assert!(files.iter().all(|f| !f.ends_with(".part") && !f.contains(".tmp")), "unfinished: {files:?}");
    let manifest = manifest(folder);
    assert_eq!(
        keys(&manifest, 1),
        [
            "schema",
            "version",
            "command",
            "started",
            "dataset",
            "dataset_sha256",
            "config_sha256",
            "model",
            "poses",
            "hardware",
            "seconds",
            "peak_memory_bytes",
            "result",
            "warnings",
            "artifacts",
            "exit"
        ]
    );
    for artifact in manifest["artifacts"].as_array().unwrap() {
        assert!(folder.join(artifact.as_str().unwrap()).is_file(), "{artifact} is listed but not there");
    }
}

#[test]
fn progress_as_json_is_one_event_a_line_and_the_log_has_the_same_shape() {
    let out = shared().root.join("json progress");
    let ran = run_on(&shared().sequence, &out, &["--progress", "json", "--stride", "2"]).ends_with(0);
    let events: Vec<Value> = ran
        .stderr
        .lines()
        .filter(|l| l.starts_with('{'))
        .map(|l| serde_json::from_str(l).unwrap_or_else(|e| panic!("{e}: {l}")))
        .collect();
    assert!(events.iter().all(|e| e["schema"] == "vidar.event/1"));
    let expected = |kind: &str| -> &[&str] {
        match kind {
            "stage-started" => &["schema", "event", "stage", "total"],
            "progress" => &["schema", "event", "stage", "done", "total"],
            "chunk-progress" => &["schema", "event", "percent"],
            "stage-finished" => &["schema", "event", "stage", "seconds"],
            "world" => &["schema", "event", "poses", "segment"],
            "state" => &["schema", "event", "frame", "time_ns", "segment", "position_m"],
            "revised-states" => &["schema", "event", "keyframes"],
            "keyframe" => &["schema", "event", "frame", "time_ns"],
            "chunk-predicted" => &["schema", "event", "chunk", "keyframes", "with_depth", "is_reused"],
            "chunk-placed" => &["schema", "event", "chunk", "scale", "center_rms_m", "status"],
            "loop-measured" => &["schema", "event", "later", "earlier", "inlier_ratio", "rejection"],
            "placements-revised" => &["schema", "event", "chunks", "keyframes", "is_final"],
            "surface-changed" => &["schema", "event", "triangles", "is_final"],
            "step-finished" => &["schema", "event", "step", "seconds"],
            "artifact-written" => &["schema", "event", "path", "bytes"],
            "warning" => &["schema", "event", "severity", "kind", "message", "place", "hint"],
            "finished" => &["schema", "event", "exit", "seconds"],
            other => panic!("unknown event {other}"),
        }
    };
    let log = std::fs::read_to_string(out.join("log.jsonl")).unwrap();
    let logged: Vec<Value> = log.lines().map(|l| serde_json::from_str(l).unwrap()).collect();
    for event in events.iter().chain(&logged) {
        assert_eq!(keys(event, 1), expected(event["event"].as_str().unwrap()));
    }
    assert_eq!(events.last().unwrap()["event"], "finished");
    for kind in [
        "stage-started",
        "progress",
        "chunk-progress",
        "stage-finished",
        "state",
        "keyframe",
        "chunk-placed",
        "surface-changed",
        "artifact-written",
    ] {
        assert!(events.iter().any(|e| e["event"] == kind), "no {kind}");
    }
}

#[test]
fn quiet_prints_only_the_result_in_at_most_twelve_lines() {
    let out = shared().root.join("quiet");
    let ran = run_on(&shared().sequence, &out, &["--quiet", "--stride", "2", "--set", "eval.mode=auto"])
        .ends_with(0);
    assert!(!ran.stderr.contains("done in"), "{}", ran.stderr);
    assert!(ran.stdout.lines().count() <= 12, "{}", ran.stdout);
    for word in ["mesh.ply", "metric poses", "ground truth (upper bound)", "F@0.10", "took", "look at it"] {
        assert!(ran.stdout.contains(word), "{word:?} is missing in\n{}", ran.stdout);
    }
    let shown = ran.stdout.lines().find_map(|l| l.strip_prefix("look at it")).unwrap().trim();
    assert!(Path::new(shown).is_file(), "{shown} is printed but does not exist");
}

#[test]
fn a_dry_run_writes_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let sequence = text(&shared().sequence);
    let ran = vidar_in(folder.path(), &["run", sequence, "--dry-run"]).ends_with(0);
    // Nothing is tracked: what the odometry decides is not known.
    for word in ["keyframes", "when the odometry has tracked", "metric poses", "disk", "memory of the map"] {
        assert!(ran.stdout.contains(word), "{word:?} is missing in\n{}", ran.stdout);
    }
    let given = ["run", sequence, "--dry-run", "--set", "input.poses=ground-truth"];
    let ran = vidar_in(folder.path(), &given).ends_with(0);
    for word in ["20 in 2 chunks", "ground truth (upper bound)"] {
        assert!(ran.stdout.contains(word), "{word:?} is missing in\n{}", ran.stdout);
    }
    let ran = vidar_in(folder.path(), &["run", sequence, "--dry-run", "-o", "there", "--json"]).ends_with(0);
    assert_eq!(keys(&ran.json(), 1), ["schema", "plan"]);
    assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0, "a dry run left something behind");
}

#[test]
fn an_output_folder_in_use_is_refused_and_force_moves_it_aside() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    std::fs::create_dir(&out).unwrap();
    std::fs::write(out.join("mine.txt"), "precious").unwrap();
    let flags = ["--stride", "2", "--quiet"];
    let ran =
        run_on(&shared().sequence, &out, &flags).ends_with(2).says(&["error[E0106]", "hint:", "--force"]);
    assert!(ran.stdout.is_empty());
    assert_eq!(files_under(&out), ["mine.txt"]);
    run_on(&shared().sequence, &out, &["--stride", "2", "--quiet", "--force"]).ends_with(0);
    let files = files_under(folder.path());
    let aside = files.iter().find(|f| f.ends_with("mine.txt")).unwrap();
    assert!(aside.starts_with("out.before-"), "{aside}");
    assert!(files.contains(&"out/manifest.json".to_owned()));
}

#[test]
fn without_an_output_folder_runs_are_dated_and_latest_points_at_the_newest() {
    let folder = tempfile::tempdir().unwrap();
    let (sequence, settings) = (text(&shared().sequence), text(&shared().settings));
    for _ in 0..2 {
        vidar_in(folder.path(), &["run", sequence, "--config", settings, "--stride", "2", "-q"]).ends_with(0);
    }
    let runs = folder.path().join("runs/tiny_room");
    let dated = std::fs::read_dir(&runs).unwrap().flatten().filter(|e| e.file_name() != "latest").count();
    assert_eq!(dated, 2);
    #[cfg(unix)]
    {
        let mut all: Vec<_> = std::fs::read_dir(&runs)
            .unwrap()
            .flatten()
            .map(|e| e.path())
            .filter(|p| !p.is_symlink())
            .collect();
        all.sort_by_key(|p| p.join("manifest.json").metadata().unwrap().modified().unwrap());
        assert_eq!(runs.join("latest").canonicalize().unwrap(), all[1].canonicalize().unwrap());
    }
}

#[test]
fn synth_never_overwrites_and_the_same_seed_makes_the_same_files() {
    let shared = shared();
    let again = shared.root.join("again");
    let world = text(&shared.world);
    let ran = vidar(&["synth", text(&again), "--world-config", world, "--json"]).ends_with(0);
    assert_eq!(keys(&ran.json(), 1), ["schema", "out", "summary"]);
    let files = files_under(&again);
    assert_eq!(files, files_under(&shared.sequence));
    for file in files {
        let same =
            std::fs::read(again.join(&file)).unwrap() == std::fs::read(shared.sequence.join(&file)).unwrap();
        assert!(same, "{file} differs");
    }
    vidar(&["synth", text(&again)]).ends_with(2).says(&["exists", "hint:"]);
}

#[test]
fn the_demo_prints_its_files_its_scores_and_how_to_view_them() {
    let folder = tempfile::tempdir().unwrap();
    let args = ["demo", "-o", "d", "--duration", "3", "--set", "fusion.voxel_size_m=0.05", "-q"];
    let ran = vidar_in(folder.path(), &args).ends_with(0);
    let report = folder.path().join("d/run/report.html");
    let html = std::fs::read_to_string(&report).unwrap();
    assert!(html.contains("data:image/png;base64,") && !html.contains("src=\"http"));
    for word in ["d/run/map/mesh.ply", "F@0.05", "look at it"] {
        assert!(ran.stdout.contains(word), "{word:?} is missing in\n{}", ran.stdout);
    }
    assert!(folder.path().join("d/sequence/mav0/cam0/data.csv").is_file());
}

#[test]
fn doctor_finds_no_problem_and_prints_json() {
    let ran = vidar(&["doctor"]).ends_with(0);
    assert!(ran.stdout.contains("ready") && ran.stdout.contains("da3-nano: built in"), "{}", ran.stdout);
    let json = vidar(&["doctor", "--json"]).ends_with(0).json();
    assert_eq!(keys(&json, 1), ["schema", "findings"]);
    assert_eq!(keys(&json["findings"][0], 1), ["what", "state", "found", "advice"]);
}

#[test]
fn completions_contain_every_verb_and_bash_accepts_them() {
    for shell in ["bash", "zsh", "fish"] {
        let script = vidar(&["completions", shell]).ends_with(0).stdout;
        for verb in VERBS {
            assert!(script.contains(verb[0]), "{shell} lacks {verb:?}");
        }
    }
    let script = vidar(&["completions", "bash"]).stdout;
    let file = shared().root.join("completions.bash");
    std::fs::write(&file, script).unwrap();
    match std::process::Command::new("bash").arg("-n").arg(&file).output() {
        Ok(checked) => assert!(checked.status.success(), "{}", String::from_utf8_lossy(&checked.stderr)),
        Err(error) => eprintln!("skipped: bash cannot be started: {error}"),
    }
}

#[test]
fn every_error_code_is_explained_in_either_case() {
    let all = vidar(&["explain", "all"]).ends_with(0).stdout;
    assert_eq!(all.lines().count(), vidar::error::CODES.len());
    for (code, about) in vidar::error::CODES {
        let ran = vidar(&["explain", &code.to_lowercase()]).ends_with(0);
        assert!(ran.stdout.contains(about), "{code}");
    }
}

#[test]
fn an_invalid_number_of_threads_is_refused() {
    let ran = command().args(["config", "show", "--threads", "x"]).output().unwrap();
    assert_eq!(ran.status.code(), Some(2));
}
