//! `vidar bench`: tables of rendered sequences, in one command that can be repeated.

use crate::support::{ProgramOutput, files_under, shared, vidar};
use serde_json::Value;
use std::path::Path;

/// Small images and short flights; ground truth as poses, because so little is no flight to track.
fn bench(out: &Path, more: &[&str]) -> ProgramOutput {
    bench_of(&shared().world, "room1_1,room2_3", out, more)
}

fn bench_of(world: &Path, sequences: &str, out: &Path, more: &[&str]) -> ProgramOutput {
    let world = world.to_str().unwrap();
    let settings = shared().settings.to_str().unwrap();
    let mut all = vec!["bench", "euroc", "--synthetic", "--world-config", world, "--config", settings];
    all.extend(["--geometry", "simulated", "--sequences", sequences, "--no-trajectories"]);
    all.extend([
        "--set",
        "input.poses=ground-truth",
        "--set",
        "eval.mode=auto",
        "--set",
        "output.report=true",
    ]);
    all.extend(["-o", out.to_str().unwrap(), "-q"]);
    all.extend(more);
    vidar(&all)
}

#[test]
fn a_bench_writes_the_papers_tables_and_is_not_done_twice() {
    let out = shared().root.join("bench tables");
    let modes = ["--modes", "pose-free,hybrid", "--json"];
    let json = bench(&out, &modes).ends_with(0).json();
    assert_eq!(json["sequences"], serde_json::json!(["room1_1", "room2_3"]));
    let runs = json["runs"].as_array().unwrap();
    assert_eq!(runs.len(), 4);
    for run in runs {
        assert!(run["failure"].is_null() && run["f10"].as_f64().is_some(), "{run}");
        assert!(run["f10_free"].as_f64().unwrap() >= run["f10"].as_f64().unwrap() - 0.05, "{run}");
    }
    let text = std::fs::read_to_string(out.join("tables.md")).unwrap();
    for word in [
        "Table I:",
        "Table II: F@0.10",
        "Table III",
        "mean \\|ln s\\|",
        "room2_3",
        "[0.405]",
        "(2/2)",
        "Rendered sequences",
    ] {
        assert!(text.contains(word), "{word} is missing in\n{text}");
    }
    let report = std::fs::read_to_string(out.join("report.html")).unwrap();
    assert!(report.matches("data:image/png").count() >= 4);

    let stamp = |name: &str| std::fs::metadata(out.join(name)).unwrap().modified().unwrap();
    let mesh = "runs/room1_1/hybrid/map/mesh.ply";
    let before = stamp(mesh);
    bench(&out, &modes).ends_with(0);
    assert_eq!(stamp(mesh), before, "existing results are not computed again");
    assert_eq!(std::fs::read_to_string(out.join("tables.md")).unwrap(), text);
    assert!(files_under(&out).iter().any(|f| f == "bench.json"));

    // Another world under the same names is another table.
    let world = shared().root.join("another world.toml");
    let text = std::fs::read_to_string(&shared().world).unwrap();
    std::fs::write(&world, format!("image_noise_sigma = 3.0\n{text}")).unwrap();
    let before = stamp("sequences/room1_1/synth.toml");
    bench_of(&world, "room1_1,room2_3", &out, &["--modes", "hybrid"]).ends_with(0);
    assert!(stamp("sequences/room1_1/synth.toml") > before);
    assert!(stamp("runs/room1_1/hybrid/map/mesh.ply") > before);
}

#[test]
fn a_run_that_fails_is_a_row_with_its_reason() {
    let out = shared().root.join("bench failed");
    // The sequence is too short for the odometry: the coupling that needs it fails, the other one succeeds.
    let more = ["--modes", "pose-free,pose-conditioned", "--set", "input.poses=odometry"];
    let ran = bench_of(&shared().world, "room1_1", &out, &more);
    let table: Value = serde_json::from_slice(&std::fs::read(out.join("bench.json")).unwrap()).unwrap();
    let failed: Vec<&Value> =
        table["runs"].as_array().unwrap().iter().filter(|r| !r["failure"].is_null()).collect();
    ran.ends_with(3);
    assert!(failed.len() == 1 && failed[0]["mode"] == "pose-conditioned", "{failed:?}");
    let text = std::fs::read_to_string(out.join("tables.md")).unwrap();
    assert!(text.contains("E0209") && text.contains("failed"), "{text}");
}

#[test]
fn unsupported_benches_are_refused() {
    vidar(&["bench", "euroc"]).ends_with(2).says(&["--synthetic"]);
    vidar(&["bench", "tum", "--synthetic"]).ends_with(2).says(&["EuRoC"]);
    vidar(&["bench", "euroc", "/no/such"]).ends_with(4);
    vidar(&["bench", "euroc", "x", "--modes", "magic"]).ends_with(2).says(&["couplings:", "hybrid"]);
    let empty = shared().root.join("no sequences");
    std::fs::create_dir_all(&empty).unwrap();
    vidar(&["bench", "tum", empty.to_str().unwrap()]).ends_with(2).says(&["rgb.txt"]);
}

#[test]
fn an_ablation_gives_every_coupling_the_same_keyframes_and_is_not_done_twice() {
    let out = shared().root.join("ablation");
    let more = ["--ablation", "--seeds", "1", "--json"];
    let more = [&more[..], &["--set", "geometry.chunk_keyframes=5", "--set", "geometry.overlap_keyframes=2"]]
        .concat();
    let bench = |more: &[&str]| bench_of(&shared().world, "room1_1", &out, more);
    let json = bench(&more).ends_with(0).json();
    let rows = json["rows"].as_array().unwrap();
    // Five couplings with five sets of measurements, but no loops for chunks that are placed by poses alone.
    assert_eq!(rows.len(), 24, "{rows:?}");
    let offered = rows[0]["offered"].as_u64().unwrap();
    assert!(offered > 5 && rows.iter().all(|r| r["offered"] == offered), "{rows:?}");
    assert!(
        rows.iter().all(|r| r["f05"].as_f64().is_some() && r["log_scale"].as_f64().is_some()),
        "{rows:?}"
    );
    let text = std::fs::read_to_string(out.join("ablation.md")).unwrap();
    for word in
        ["| pose-free, hybrid |", "| given poses, coupled |", "+ stereo points", "What the graph itself adds"]
    {
        assert!(text.contains(word), "{word} is missing in\n{text}");
    }
    assert_eq!(bench(&more).ends_with(0).json()["rows"], json["rows"]);
    vidar(&["bench", "euroc", "x", "--ablation"]).ends_with(2).says(&["--synthetic"]);
}
