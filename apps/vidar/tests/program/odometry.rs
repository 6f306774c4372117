//! `vidar odometry`: a metric trajectory from camera and IMU alone.

use crate::support::{ProgramOutput, command, copy_tree, files_under, manifest, shared, vidar};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// Small images at 20 Hz, six seconds: long enough to initialise and to be evaluated.
const WORLD: &str = "duration_secs = 6.0\ncamera_rate_hz = 20.0\nwidth = 376\nheight = 240\nblur_samples = 1\n\
    exposure_secs = 0.0\nscan_spacing_m = 0.1\n";

/// The rendered flight, without which nothing is tracked.
pub fn flight() -> &'static Path {
    static FLIGHT: OnceLock<PathBuf> = OnceLock::new();
    FLIGHT.get_or_init(|| {
        let world = shared().root.join("flight.toml");
        std::fs::write(&world, WORLD).unwrap();
        let sequence = shared().root.join("flight to track");
        let made = command()
            .args(["synth".as_ref(), sequence.as_os_str(), "--world-config".as_ref(), world.as_os_str()])
            .output();
        ProgramOutput::from(made.unwrap()).ends_with(0);
        sequence
    })
}

fn odometry(sequence: &Path, out: &Path, more: &[&str]) -> ProgramOutput {
    let mut command = command();
    command.arg("odometry").arg(sequence).arg("-o").arg(out).args(["--json", "-q"]).args(more);
    command.output().unwrap().into()
}

#[test]
fn a_rendered_flight_is_tracked_in_metres_and_its_trajectory_places_a_map() {
    let out = shared().root.join("tracked");
    let json = odometry(flight(), &out, &["--debug-dump"]).ends_with(0).json();
    assert_eq!(json["schema"], "vidar.odometry/1");
    assert_eq!(json["is_metric"], true);
    let number = |v: &Value| v.as_f64().unwrap();
    assert!(number(&json["images_with_state"]) > 0.5 * number(&json["images"]), "{json}");
    assert!(number(&json["trajectory"]["ate_se3_m"]["rmse"]) < 0.05, "{json}");
    assert!(number(&json["trajectory"]["scale_error"]) < 0.03, "{json}");
    let files = files_under(&out);
    for name in [
        "manifest.json",
        "odometry/debug_states.csv",
        "odometry/debug_tracks.csv",
        "odometry/health.csv",
        "odometry/keyframes.json",
        "odometry/landmarks.csv",
        "odometry/report.json",
        "pictures/odometry_tracks.png",
        "report.html",
        "trajectory/odometry_body.euroc.csv",
        "trajectory/odometry_body.tum",
    ] {
        assert!(files.iter().any(|f| f == name), "{name} is missing in {files:?}");
    }
    let keyframes: Value =
        serde_json::from_slice(&std::fs::read(out.join("odometry/keyframes.json")).unwrap()).unwrap();
    let first = &keyframes["keyframes"][0];
    assert_eq!(first["pose_covariance"].as_array().unwrap().len(), 6);
    assert!(first["landmarks"].as_u64().unwrap() > 10, "{first}");
    let health = std::fs::read_to_string(out.join("odometry/health.csv")).unwrap();
    assert_eq!(health.lines().count() as u64, 1 + json["images"].as_u64().unwrap());

    let states = std::fs::read_to_string(out.join("odometry/debug_states.csv")).unwrap();
    assert_eq!(states.lines().count() as u64, 1 + json["images_with_state"].as_u64().unwrap());
    let columns = states.lines().next().unwrap().split(',').count();
    assert!(states.lines().all(|l| l.split(',').count() == columns), "{columns} columns");
    let tracks = std::fs::read_to_string(out.join("odometry/debug_tracks.csv")).unwrap();
    assert!(tracks.lines().count() > 1000, "{} tracks", tracks.lines().count());

    let log = std::fs::read_to_string(out.join("log.jsonl")).unwrap();
    let events: Vec<Value> = log.lines().map(|l| serde_json::from_str(l).unwrap()).collect();
    let ended = |stage: &str| events.iter().any(|e| e["event"] == "stage-finished" && e["stage"] == stage);
    assert!(ended("read") && ended("odometry") && ended("write"), "{log}");
    assert_eq!(events.last().unwrap()["event"], "finished");

    // The trajectory places a map like any other.
    let map = shared().root.join("map on odometry");
    let trajectory = out.join("trajectory/odometry_body.tum");
    let mut command = command();
    command.arg("run").arg(flight()).arg("-o").arg(&map).arg("--trajectory").arg(&trajectory);
    command.args(["--trajectory-body", "imu", "-q", "--config"]).arg(&shared().settings);
    command.args(["--set", "input.poses=external"]);
    command.args(["--set", "geometry.max_width_px=160", "--set", "input.stride=4"]);
    let ran: ProgramOutput = command.output().unwrap().into();
    assert_eq!(ran.code, 0, "{}", ran.stderr);
    assert!(map.join("map/mesh.ply").is_file());
}

#[test]
fn without_any_trajectory_the_odometry_places_the_map() {
    let sequence = shared().root.join("flight without truth");
    copy_tree(flight(), &sequence);
    std::fs::remove_dir_all(sequence.join("mav0/state_groundtruth_estimate0")).unwrap();
    let out = shared().root.join("map without truth");
    let mut command = command();
    command.arg("run").arg(&sequence).arg("-o").arg(&out).args(["-q", "--config"]).arg(&shared().settings);
    command.args(["--set", "input.poses=auto"]);
    command.args(["--set", "geometry.max_width_px=160", "--set", "keyframes.max_count=12"]);
    let ran: ProgramOutput = command.output().unwrap().into();
    assert_eq!(ran.code, 0, "{}", ran.stderr);
    let manifest = manifest(&out);
    assert_eq!(manifest["poses"]["source"], "odometry");
    assert!(out.join("map/mesh.ply").is_file());
}

#[test]
fn the_same_recording_gives_the_same_bits() {
    let folders = ["1", "3"].map(|threads| {
        let out = shared().root.join(format!("tracked by {threads}"));
        odometry(flight(), &out, &["--threads", threads]).ends_with(0);
        std::fs::read(out.join("trajectory/odometry_body.euroc.csv")).unwrap()
    });
    assert!(folders[0] == folders[1]);
}

#[test]
fn what_never_starts_is_an_outcome_with_its_reason() {
    // Two and a half seconds at 8 Hz of 160x104 pixels are no flight to start on.
    let out = shared().root.join("never started");
    let ran = odometry(&shared().sequence, &out, &[]);
    let json = ran.ends_with(3).json();
    assert!(json["path_m"].is_null(), "{json}");
    let manifest = manifest(&out);
    assert_eq!(manifest["exit"], 3);
    assert_eq!(manifest["warnings"]["odometry-never-started"], 1, "{manifest}");
}

#[test]
fn settings_of_the_odometry_are_checked() {
    vidar(&["odometry", flight().to_str().unwrap(), "--set", "odometry.max_landmarks=0"])
        .ends_with(2)
        .says(&["max_landmarks"]);
}

#[test]
fn real_frames_are_tracked_to_a_centimetre() {
    let Some(excerpt) = vidar::core::testing::shared_data("data/euroc_MH_01_real_11s") else { return };
    let out = shared().root.join("real");
    let json = odometry(&excerpt, &out, &[]).ends_with(0).json();
    assert!(json["trajectory"]["ate_se3_m"]["rmse"].as_f64().unwrap() < 0.01, "{json}");
    assert!(json["trajectory"]["scale_error"].as_f64().unwrap() < 0.02, "{json}");
    assert!(json["first_state_secs"].as_f64().unwrap() < 1.5, "{json}");
}

/// A lively hand whose tremor the lens takes back: no attempt to begin believes it, and it is tracked once more.
const STABILISED: &str = "seed = 11\nflight = \"handheld-lively\"\nduration_secs = 8.0\ncamera_rate_hz = 20.0\nwidth = 376\n\
    height = 240\nblur_samples = 1\nexposure_secs = 0.0\nscan_spacing_m = 0.1\n[device]\nstabilisation = 0.8\n";

#[test]
fn stabilised_images_are_tracked_all_the_same_and_told() {
    let (world, sequence) = (shared().root.join("stabilised.toml"), shared().root.join("stabilised"));
    std::fs::write(&world, STABILISED).unwrap();
    vidar(&["synth", sequence.to_str().unwrap(), "--world-config", world.to_str().unwrap()]).ends_with(0);
    let live =
        odometry(&sequence, &shared().root.join("stabilised live"), &["--set", "odometry.adjust=false"]);
    live.ends_with(3).says(&["odometry-never-started", "contradict each other"]);
    let out = shared().root.join("stabilised tracked");
    let run = odometry(&sequence, &out, &["--debug-dump"]).ends_with(0);
    assert_eq!(manifest(&out)["warnings"], serde_json::json!({ "images-stabilised": 1 }));
    // The tables are those of the last time alone.
    let states = std::fs::read_to_string(out.join("odometry/debug_states.csv")).unwrap();
    let times: Vec<i64> =
        states.lines().skip(1).map(|l| l.split(',').next().unwrap().parse().unwrap()).collect();
    assert!(times.is_sorted() && times.len() <= 160, "{} rows", times.len());
    let json = run.json();
    assert!(json["quality"]["mapped_images"].as_u64().unwrap() >= 150, "{json}");
    let last = &json["final"]["trajectory"];
    assert!(last["scale_error"].as_f64().unwrap() < 0.02, "{last}");
    assert!(last["ate_se3_m"]["rmse"].as_f64().unwrap() < 0.02, "{last}");
}

#[test]
fn noise_that_a_file_inflates_is_named_and_bounded() {
    let inflated = shared().root.join("inflated noise");
    copy_tree(flight(), &inflated);
    let file = inflated.join("mav0/imu0/sensor.yaml");
    let text = std::fs::read_to_string(&file).unwrap();
    let lines = text.lines().map(|line| match line.split_once("_noise_density:") {
        Some(("gyroscope", _)) => "gyroscope_noise_density: 0.05".to_owned(),
        Some((sensor, _)) => format!("{sensor}_noise_density: 0.5"),
        None => line.to_owned(),
    });
    std::fs::write(&file, lines.collect::<Vec<_>>().join("\n")).unwrap();
    let sequence = inflated.to_str().unwrap();
    vidar(&["inspect", sequence]).says(&["imu-noise-contradicted", "gyroscope 5.0e-2 is taken as"]);
    let out = shared().root.join("inflated noise tracked");
    let run = odometry(&inflated, &out, &[]).ends_with(0);
    assert_eq!(manifest(&out)["warnings"]["imu-noise-contradicted"], 1);
    let trajectory = &run.json()["final"]["trajectory"];
    assert!(trajectory["scale_error"].as_f64().unwrap() < 0.03, "{trajectory}");
    let honest = vidar(&["inspect", flight().to_str().unwrap()]).ends_with(0);
    assert!(!honest.stderr.contains("imu-noise"), "{}", honest.stderr);
}
