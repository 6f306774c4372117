//! Nothing is said that is not so: scores judge the map's own scale, "good" is earned, and a scale is stated with all its parts.

use crate::support::{ProgramOutput, command, copy_tree, files_under, finished, run_on, shared, vidar};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;
use vidar::core::{Se3, StampedPose, Trajectory};

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

fn number(value: &Value) -> f64 {
    value.as_f64().unwrap_or_else(|| panic!("{value} is no number"))
}

fn reasons(verdict: &Value) -> String {
    let reasons: Vec<&str> =
        verdict["reasons"].as_array().unwrap().iter().filter_map(Value::as_str).collect();
    reasons.join("; ")
}

// ---- scores

#[test]
fn a_cloud_that_is_a_tenth_too_large_scores_as_such_and_misses_its_bound() {
    let truth = finished().0.join("map/points.ply");
    let mut cloud = vidar::export_formats::read_ply(&std::fs::read(&truth).unwrap()).unwrap().cloud;
    cloud.positions.iter_mut().flatten().for_each(|v| *v *= 1.10);
    let scaled = shared().root.join("a tenth too large.ply");
    let mut bytes = Vec::new();
    vidar::export_formats::write_ply_cloud(&mut bytes, &cloud, &[]).unwrap();
    std::fs::write(&scaled, bytes).unwrap();

    let ran =
        vidar(&["eval", text(&scaled), text(&truth)]).ends_with(0).says(&["[scale-refined]", "rigid F"]);
    let first = ran.stdout.lines().next().unwrap();
    assert!(first.starts_with("F@0.05 m ") && first.contains("rigid fit: scale as it is"), "{}", ran.stdout);
    assert!(ran.stdout.contains("scale refined to 0.9"), "{}", ran.stdout);

    let json = vidar(&["eval", text(&scaled), text(&truth), "--json"]).ends_with(0).json();
    let scores = &json["scores"];
    let (rigid, refined) = (number(&scores["f@0.10"]), number(&scores["f@0.10-refined"]));
    assert!(rigid < 0.8 && refined > 0.95, "{scores}");
    assert!(number(&scores["delta-f"]) > 0.15, "the true scale would gain: {scores}");
    assert!(number(&scores["chamfer"]) > 0.03, "{scores}");
    vidar(&["eval", text(&scaled), text(&truth), "--fail-below", "f@0.10=0.9"]).ends_with(5);
    vidar(&["eval", text(&scaled), text(&truth), "--fail-above", "chamfer=0.02"]).ends_with(5);
    // The true one is neither warned of nor refused.
    let ran = vidar(&["eval", text(&truth), text(&truth), "--fail-below", "f@0.10=0.99"]).ends_with(0);
    assert!(!ran.stderr.contains("scale-refined"), "{}", ran.stderr);
}

#[test]
fn a_runs_report_and_summary_show_the_rigid_fit_first() {
    let out = shared().root.join("rigid first");
    let more = ["-q", "--stride", "2", "--set", "eval.mode=auto", "--set", "output.report=true"];
    let ran = run_on(&shared().sequence, &out, &more).ends_with(0);
    let line = ran.stdout.lines().find(|l| l.starts_with("how good")).unwrap();
    assert!(line.find("F@0.05").unwrap() < line.find("refine").unwrap(), "{line}");
    let metrics: Value =
        serde_json::from_slice(&std::fs::read(out.join("eval/metrics.json")).unwrap()).unwrap();
    let surface = &metrics["evaluation"]["surface"];
    assert_eq!(metrics["scores"]["f@0.10"], surface["rigid"][1]["f"]);
    assert_eq!(surface["rigid_placement"]["scale"], 1.0);
    let report = std::fs::read_to_string(out.join("report.html")).unwrap();
    let (rigid, refined) = (report.find(">F@0.05 m<"), report.find(">F@0.10 m refined<"));
    assert!(rigid.is_some() && rigid < refined, "{rigid:?} {refined:?}");
}

// ---- verdicts

/// Six seconds at 20 Hz, small images; what the camera does is given.
const WORLD: &str = "camera_rate_hz = 20.0\nwidth = 376\nheight = 240\nblur_samples = 1\nexposure_secs = 0.0\n\
    scan_spacing_m = 0.2\ndepth = false\n";

/// A recording along a path of its own: position (m) and rotation about the vertical (rad) at a time (s).
fn recording(name: &str, secs: f64, path: impl Fn(f64) -> ([f64; 3], f64)) -> PathBuf {
    let root = &shared().root;
    let (world, flight, sequence) =
        (root.join(format!("{name}.toml")), root.join(format!("{name}.tum")), root.join(name));
    std::fs::write(&world, WORLD).unwrap();
    // A body that looks along its x axis, level, in the middle of the room.
    let mut rows = String::new();
    for k in 0..=(secs * 50.0) as usize {
        let t = k as f64 * 0.02;
        let (p, yaw) = path(t);
        let (sin, cos) = (0.5 * yaw).sin_cos();
        rows += &format!("{:.3} {} {} {} 0 0 {sin} {cos}\n", 100.0 + t, p[0], p[1], p[2]);
    }
    std::fs::write(&flight, rows).unwrap();
    let made =
        ["synth", text(&sequence), "-q", "--world-config", text(&world), "--trajectory", text(&flight)];
    vidar(&made).ends_with(0);
    sequence
}

fn odometry(sequence: &Path, name: &str) -> ProgramOutput {
    odometry_with(sequence, name, &[])
}

fn odometry_with(sequence: &Path, name: &str, more: &[&str]) -> ProgramOutput {
    let out = shared().root.join(format!("odometry of {name}"));
    let mut command = command();
    command.arg("odometry").arg(sequence).arg("-o").arg(out).args(["--json", "--progress", "off"]).args(more);
    command.output().unwrap().into()
}

#[test]
fn motions_that_do_not_show_the_scale_are_not_metric_and_not_good() {
    let middle = [0.0, 0.0, 1.5];
    for (name, path) in [
        ("standing", (|_| ([0.0, 0.0, 1.5], 0.0)) as fn(f64) -> ([f64; 3], f64)),
        ("turning", |t| ([0.0, 0.0, 1.5], 0.6 * (1.1 * t).sin())),
        ("gliding", |t| ([-0.9 + 0.3 * t, 0.0, 1.5], 0.0)),
    ] {
        let ran = odometry(&recording(name, 6.0, path), name).ends_with(3);
        let json = ran.json();
        assert_ne!(json["verdict"]["level"], "good", "{name}: {json}");
        let never_started = json["images_with_state"] == 0;
        assert!(never_started || json["is_metric"] == false, "{name}: {json}");
        assert!(!reasons(&json["verdict"]).is_empty(), "{name}");
    }
    assert_eq!(middle[2], 1.5);
}

/// A flight that shows everything, long enough to start.
fn flight() -> &'static Path {
    static FLIGHT: OnceLock<PathBuf> = OnceLock::new();
    FLIGHT.get_or_init(|| {
        let world = shared().root.join("trusted.toml");
        std::fs::write(&world, format!("duration_secs = 6.0\n{WORLD}")).unwrap();
        let sequence = shared().root.join("trusted flight");
        vidar(&["synth", text(&sequence), "-q", "--world-config", text(&world)]).ends_with(0);
        sequence
    })
}

#[test]
fn half_a_recording_is_not_tracked_throughout() {
    // What is adjusted after the end reaches back before the start.
    let json = odometry(flight(), "whole flight").ends_with(0).json();
    assert!(number(&json["quality"]["covered_time_ratio"]) > 0.95, "{}", json["quality"]);
    assert!(json["scale"]["unchecked"].is_null(), "{}", json["scale"]);
    let live = ["--set", "odometry.adjust=false"];
    let json = odometry_with(flight(), "flight", &live).ends_with(0).json();
    // Nothing has checked the calibration that a live trajectory is of.
    assert_eq!(json["scale"]["unchecked"], 0.07);
    assert!(number(&json["scale"]["sigma"]) > 0.07, "{}", json["scale"]);
    assert!(json["scale"]["words"].as_str().unwrap().contains("calibration not checked 7.0 %"));
    let quality = &json["quality"];
    assert!(number(&quality["covered_time_ratio"]) < 0.8, "this flight starts late: {quality}");
    assert_eq!(quality["is_adjusted"], false);
    assert_eq!(json["verdict"]["level"], "caution", "{}", json["verdict"]);
    let why = reasons(&json["verdict"]);
    assert!(why.contains("images have a state") && !why.contains("throughout"), "{why}");
    let report = std::fs::read_to_string(shared().root.join("odometry of flight/report.html")).unwrap();
    assert!(!report.contains("tracked throughout"));
}

/// The true path of the tiny recording, changed.
fn changed_truth(name: &str, change: impl Fn(&StampedPose) -> String) -> PathBuf {
    let path = finished().0.join("trajectory/metric_camera.tum");
    let truth: Trajectory = vidar::dataset::read_trajectory(&path, &Default::default()).unwrap().0;
    let file = shared().root.join(name);
    std::fs::write(&file, truth.poses().iter().map(change).collect::<String>()).unwrap();
    file
}

fn row(pose: &Se3, secs: f64) -> String {
    let (t, q) = (pose.translation, pose.rotation.quaternion_xyzw());
    format!("{secs:.9} {} {} {} {} {} {} {}\n", t.x, t.y, t.z, q[0], q[1], q[2], q[3])
}

fn mapped_on(trajectory: &Path, name: &str) -> ProgramOutput {
    let flags = ["--json", "--set", "eval.mode=auto", "--progress", "off", "--trajectory-body", "camera0"];
    let flags = [&flags[..], &["--trajectory", text(trajectory)]].concat();
    run_on(&shared().sequence, &shared().root.join(name), &flags)
}

#[test]
fn a_map_on_a_scaled_trajectory_is_not_good_and_its_scale_is_not_claimed() {
    let scaled = changed_truth("twelve per cent.tum", |p| {
        let mut pose = p.world_from_body;
        pose.translation *= 1.12;
        row(&pose, p.time.as_secs_f64())
    });
    let json = mapped_on(&scaled, "twelve per cent").ends_with(0).json();
    let result = &json["result"];
    assert_eq!(result["verdict"]["level"], "caution", "{}", result["verdict"]);
    assert!(reasons(&result["verdict"]).contains("% off ground truth"), "{}", result["verdict"]);
    // Nobody states the scale of a given trajectory.
    assert!(result["scale"]["sigma"].is_null(), "{}", result["scale"]);
    assert!(result["scale"]["words"].as_str().unwrap().contains("not known"), "{}", result["scale"]);
}

#[test]
fn a_map_of_views_that_contradict_each_other_is_bad_and_degraded() {
    // The path backwards: poses of another recording. Images and poses have nothing in common.
    let poses = std::cell::RefCell::new(Vec::new());
    changed_truth("forwards.tum", |p| {
        poses.borrow_mut().push(p.world_from_body);
        String::new()
    });
    let wrong = changed_truth("another recording.tum", |p| {
        row(&poses.borrow_mut().pop().unwrap(), p.time.as_secs_f64())
    });
    let ran = mapped_on(&wrong, "another recording");
    assert_eq!(ran.code, 3, "{}", ran.stderr);
    let verdict = &ran.json()["result"]["verdict"];
    assert_eq!(verdict["level"], "bad", "{}", reasons(verdict));
}

#[test]
fn a_bench_of_nothing_is_refused() {
    let bench = |sequences: &str| {
        let out = shared().root.join("bench of nothing");
        let all = ["bench", "euroc", "--synthetic", "--sequences", sequences, "-q", "-o", text(&out)];
        vidar(&all)
    };
    bench("ZZZ").ends_with(2).says(&["ZZZ", "room1_1"]);
    // A prefix that is misspelt beside one that is not.
    bench("room1_1,rom2").ends_with(2).says(&["rom2"]);
}

// ---- scales

/// The flight with a changed IMU file.
fn with_imu(name: &str, change: impl Fn(&mut [f64; 6], f64)) -> PathBuf {
    let sequence = shared().root.join(name);
    copy_tree(flight(), &sequence);
    let path = sequence.join("mav0/imu0/data.csv");
    let before = std::fs::read_to_string(&path).unwrap();
    let mut first = None;
    let after: String = before
        .lines()
        .map(|line| {
            if line.starts_with('#') {
                return format!("{line}\n");
            }
            let fields: Vec<&str> = line.split(',').collect();
            let time: f64 = fields[0].parse().unwrap();
            let secs = (time - *first.get_or_insert(time)) * 1e-9;
            let mut values: [f64; 6] = std::array::from_fn(|k| fields[k + 1].parse().unwrap());
            change(&mut values, secs);
            let values: Vec<String> = values.iter().map(f64::to_string).collect();
            format!("{},{}\n", fields[0], values.join(","))
        })
        .collect();
    std::fs::write(path, after).unwrap();
    sequence
}

#[test]
fn a_stated_scale_holds_odometry_and_what_no_estimate_sees() {
    let run = |name: &str, more: &[&str]| {
        let out = shared().root.join(name);
        let mut command = command();
        command.arg("run").arg(flight()).arg("-o").arg(&out).args([
            "--json",
            "--progress",
            "off",
            "--config",
        ]);
        command.arg(&shared().settings).args([
            "--set",
            "input.poses=odometry",
            "--set",
            "geometry.max_width_px=160",
        ]);
        command.args(["--set", "keyframes.max_count=8"]).args(more);
        ProgramOutput::from(command.output().unwrap()).ends_with(0).json()["result"]["scale"].clone()
    };
    let scale = run("stated", &[]);
    let part = |scale: &Value, name: &str| number(&scale[name]);
    assert!(part(&scale, "poses") > 0.001 && part(&scale, "unseen") == 0.01, "{scale}");
    let all = ["poses", "unseen", "chunks"].map(|name| part(&scale, name).powi(2)).iter().sum::<f64>().sqrt();
    assert!((part(&scale, "sigma") - all).abs() < 1e-12, "{scale}");
    for word in ["odometry", "accelerometer gain and lever arm 1.0 %", "chunks"] {
        assert!(scale["words"].as_str().unwrap().contains(word), "{scale}");
    }
    let calibrated = run("stated calibrated", &["--set", "input.imu_scale_std=0.003"]);
    assert_eq!(calibrated["unseen"], 0.003);
    assert!(part(&calibrated, "sigma") < part(&scale, "sigma"));
    vidar(&["config", "show", "--set", "input.imu_scale_std=-1"]).ends_with(2).says(&["imu_scale_std"]);
}

#[test]
fn an_accelerometer_that_is_off_at_rest_is_told_and_widens_the_scale() {
    // Two seconds of rest in front of the flight: gravity along one axis, without and with a wrong gain.
    let resting = |gain: f64, name: &str| {
        let sequence = shared().root.join(name);
        copy_tree(flight(), &sequence);
        let path = sequence.join("mav0/imu0/data.csv");
        let text = std::fs::read_to_string(&path).unwrap();
        let first: i64 = text.lines().nth(1).unwrap().split(',').next().unwrap().parse().unwrap();
        let mut lines = vec![text.lines().next().unwrap().to_owned()];
        lines.extend(
            (1..=400).rev().map(|k| format!("{},0.001,0,0,{},0,0", first - k * 5_000_000, 9.80665 * gain)),
        );
        lines.extend(text.lines().skip(1).map(str::to_owned));
        std::fs::write(path, lines.join("\n")).unwrap();
        sequence
    };
    let ran = vidar(&["inspect", text(&resting(1.05, "gain"))]).ends_with(0);
    ran.says(&["[accelerometer-gain]", "+5.0 %"]);
    let ran = vidar(&["inspect", text(&resting(1.004, "no gain"))]).ends_with(0);
    assert!(!ran.stderr.contains("accelerometer-gain"), "{}", ran.stderr);
    let json = odometry(&resting(0.97, "small gain"), "small gain").json();
    assert!((number(&json["scale"]["unseen"]) - 0.03).abs() < 1e-3, "{}", json["scale"]);
    // Also where no second is at rest, the flight itself says nothing wrong.
    let ran = vidar(&["inspect", text(&with_imu("as it was", |_, _| {}))]).ends_with(0);
    assert!(!ran.stderr.contains("accelerometer-gain"), "{}", ran.stderr);
    assert!(files_under(flight()).len() > 100);
}
