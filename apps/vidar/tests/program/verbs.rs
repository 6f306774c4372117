//! Every verb, its help, its exit codes and its machine-readable form.

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
            "evaluation",
            "seconds",
            "budget"
        ]
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
fn bounds_missed_end_with_5_and_bounds_kept_with_0() {
    let run = text(&finished().0);
    vidar(&["eval", run, "--fail-below", "f@0.10=0.01", "--fail-above", "chamfer=5"]).ends_with(0);
    vidar(&["eval", run, "--fail-below", "f@0.10=0.9999"]).ends_with(5).says(&[
        "error[E0501]",
        "f@0.10",
        "0.9999",
    ]);
    vidar(&["eval", run, "--fail-above", "speed=1"]).ends_with(5).says(&["speed", "there are: "]);
    let ran = vidar(&["eval", run, "--json", "--fail-below", "f@0.10=0.9999"]).ends_with(5);
    assert_eq!(
        keys(&ran.json(), 1),
        ["schema", "kind", "scores", "report"],
        "one object, also when a bound is missed"
    );
}

#[test]
fn eval_scores_trajectories_and_surfaces_and_a_file_equals_itself() {
    let run = &finished().0;
    let (tum, ply) = (run.join("trajectory/metric_camera.tum"), run.join("map/points.ply"));
    let json = vidar(&["eval", text(&tum), text(&tum), "--json"]).ends_with(0).json();
    assert_eq!(json["kind"], "trajectory");
    assert!(json["scores"]["ate"].as_f64().unwrap() < 1e-9);
    assert!(json["scores"]["scale"].as_f64().unwrap() < 1e-9);
    let json = vidar(&["eval", text(&ply), text(&ply), "--json"]).ends_with(0).json();
    assert_eq!(json["kind"], "surface");
    assert_eq!(json["scores"]["f@0.05"], 1.0);
    assert!(vidar(&["eval", text(&tum), text(&tum)]).ends_with(0).stdout.contains("ATE SE(3)"));
}

#[test]
fn options_named_in_hints_of_eval_exist() {
    let help = vidar(&["eval", "--help"]).ends_with(0).stdout;
    let file = |name: &str, rows: String| {
        let path = shared().root.join(name);
        std::fs::write(&path, rows).unwrap();
        path
    };
    let tum = |scale: f64| -> String {
        (0..20)
            .map(|i| format!("{} {i} {} 0 0 0 0 1\n", 1.6e9 * scale + f64::from(i) * scale, i * i))
            .collect()
    };
    let (plain, millis) = (file("plain.tum", tum(1.0)), file("millis.tum", tum(1e3)));
    let kitti =
        file("poses.kitti", (0..20).map(|i| format!("1 0 0 {i} 0 1 0 {} 0 0 1 0\n", i * i)).collect());
    let times = file("times.txt", (0..20).map(|i| format!("{}\n", 1_600_000_000 + i)).collect());
    let empty = file("empty.tum", String::new());
    for (estimate, code) in [(&plain, 0), (&millis, 0), (&kitti, 1), (&empty, 1)] {
        let ran = vidar(&["eval", text(estimate), text(&plain)]).ends_with(code);
        let named: Vec<&str> = ran
            .stderr
            .split(|c: char| !(c.is_ascii_alphanumeric() || c == '-'))
            .filter(|word| word.starts_with("--"))
            .collect();
        assert!(!named.is_empty(), "{}", ran.stderr);
        assert!(named.iter().all(|option| help.contains(option)), "{named:?} in\n{}", ran.stderr);
    }
    // The named options remove the cause.
    let body = ["--trajectory-body", "imu"];
    let ran = vidar(&[&["eval", text(&plain), text(&plain)], &body[..]].concat()).ends_with(0);
    assert!(!ran.stderr.contains("trajectory-body"), "{}", ran.stderr);
    let ran = vidar(&["eval", text(&kitti), text(&kitti), "--timestamps", text(&times), "--json"]);
    assert_eq!(ran.ends_with(0).json()["report"]["matched"], 20);
}

#[test]
fn every_export_is_made_and_an_unknown_one_is_refused_with_the_list() {
    let run = text(&finished().0);
    let folder = tempfile::tempdir().unwrap();
    for format in
        ["colmap", "colmap-text", "nerfstudio", "tum", "kitti", "euroc", "ply", "glb", "textured-glb"]
    {
        let out = folder.path().join(format);
        let json = vidar(&["export", run, "--to", format, "-o", text(&out), "--json"]).ends_with(0).json();
        assert_eq!(keys(&json, 1), ["schema", "made"]);
        let made = json["made"].as_array().unwrap();
        assert!(!made.is_empty(), "{format} made nothing");
        for file in made {
            let length = std::fs::metadata(file.as_str().unwrap()).unwrap();
            assert!(length.is_dir() || length.len() > 0, "{format}: {file} is empty");
        }
    }
    vidar(&["export", run, "--to", "dwg"]).ends_with(2).says(&["dwg", "colmap", "nerfstudio"]);
    vidar_in(folder.path(), &["export", "tum", "--to", "tum"]).ends_with(1).says(&["error[E0207]", "hint:"]);
    assert!(!folder.path().join("tum/export").exists(), "a refused export left a folder");
}

/// The JSON of a GLB.
fn gltf(path: &Path) -> Value {
    let bytes = std::fs::read(path).unwrap();
    let length = u32::from_le_bytes(bytes[12..16].try_into().unwrap()) as usize;
    serde_json::from_slice(&bytes[20..20 + length]).unwrap()
}

#[test]
fn a_textured_mesh_has_the_triangles_of_the_map_and_the_asked_size() {
    let run = text(&finished().0);
    let folder = tempfile::tempdir().unwrap();
    let mut widths = Vec::new();
    for more in [&["--texture-px", "256"][..], &[], &["--input-size"]] {
        let out = folder.path().join(widths.len().to_string());
        vidar(&[&["export", run, "--to", "textured-glb", "-o", text(&out)], more].concat()).ends_with(0);
        let document = gltf(&out.join("textured.glb"));
        let indices = |p: &Value| {
            let accessor = p["indices"].as_u64().unwrap() as usize;
            document["accessors"][accessor]["count"].as_u64().unwrap()
        };
        let primitives = document["meshes"][0]["primitives"].as_array().unwrap();
        assert!(primitives[0]["attributes"]["TEXCOORD_0"].is_u64(), "{primitives:?}");
        let ply = std::fs::read(Path::new(run).join("map/mesh.ply")).unwrap();
        let header = String::from_utf8_lossy(&ply[..2000]);
        let faces = header.lines().find_map(|l| l.strip_prefix("element face ")).unwrap();
        let all: u64 = primitives.iter().map(indices).sum();
        assert_eq!(all, 3 * faces.parse::<u64>().unwrap());
        assert!(indices(&primitives[0]) * 10 > all * 9, "{} of {all} are textured", indices(&primitives[0]));
        // Columns of the JPEG, from the frame header of a baseline image (T.81, B.2.2).
        let glb = std::fs::read(out.join("textured.glb")).unwrap();
        let start = glb.windows(3).rposition(|w| w == [0xff, 0xd8, 0xff]).unwrap();
        let frame = start + glb[start..].windows(2).position(|w| w == [0xff, 0xc0]).unwrap();
        widths.push(u16::from_be_bytes([glb[frame + 7], glb[frame + 8]]));
    }
    // The run's images have the size of the recording's.
    assert!(widths[0] <= 256 && widths[0] < widths[1] && widths[1] == widths[2], "{widths:?}");
    let refused = |more: &[&str]| vidar(&[&["export", run], more].concat()).ends_with(2);
    refused(&["--to", "textured-glb", "--texture-px", "20"]).says(&["--texture-px", "64", "16384"]);
    refused(&["--to", "glb", "--texture-px", "256"]).says(&["--texture-px", "textured-glb"]);
}

#[test]
fn colmap_gets_tracks_and_images_of_the_input_s_size_on_request() {
    let run = text(&finished().0);
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("large");
    let more = ["--tracks", "--input-size", "-o", text(&out)];
    vidar(&[&["export", run, "--to", "colmap-text"], &more[..]].concat()).ends_with(0);
    let points = std::fs::read_to_string(out.join("sparse/0/points3D.txt")).unwrap();
    let columns = |l: &str| l.split_whitespace().count();
    let (all, seen) = points.lines().filter(|l| !l.starts_with('#')).fold((0, 0), |(all, seen), line| {
        // Eight columns and two for every image: seen twice or more.
        (all + 1, seen + usize::from(columns(line) >= 8 + 4))
    });
    assert!(all > 1000 && seen * 10 > all * 8, "{seen} of {all} points are seen twice");
    let images = std::fs::read_to_string(out.join("sparse/0/images.txt")).unwrap();
    let observations = images.lines().filter(|l| !l.starts_with('#')).skip(1).step_by(2).map(columns);
    let in_tracks: usize = points.lines().filter(|l| !l.starts_with('#')).map(|l| (columns(l) - 8) / 2).sum();
    assert_eq!(observations.sum::<usize>(), 3 * in_tracks, "tracks and observations agree");
    let cameras = std::fs::read_to_string(out.join("sparse/0/cameras.txt")).unwrap();
    assert!(cameras.contains("PINHOLE 160 "), "{cameras}");
    for image in std::fs::read_dir(out.join("images")).unwrap().flatten() {
        let png = std::fs::read(image.path()).unwrap();
        assert_eq!(png[16..20], 160_u32.to_be_bytes(), "its width");
    }
    vidar(&["export", run, "--to", "tum", "--tracks"]).ends_with(2).says(&["--tracks", "colmap"]);
    vidar(&["export", run, "--to", "ply", "--input-size"]).ends_with(2).says(&["--input-size", "nerfstudio"]);
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
