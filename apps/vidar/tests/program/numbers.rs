//! How good the map is on a world whose truth is known, and that the result does not depend on threads.

use crate::support::{ProgramOutput, VIDAR, files_under, finished, run_command, run_on, shared, vidar};
use serde_json::Value;
use std::path::{Path, PathBuf};
use vidar::core::{Se3, So3, StampedPose, Trajectory};

fn score(json: &Value, name: &str) -> f64 {
    json["scores"][name].as_f64().unwrap_or_else(|| panic!("no score {name} in {}", json["scores"]))
}

/// The camera's true poses at every image, as a trajectory of its own.
fn truth() -> Trajectory {
    let path = finished().0.join("trajectory/metric_camera.tum");
    vidar::dataset::read_trajectory(&path, &Default::default()).unwrap().0
}

/// The same flight told in another world: turned, moved, scaled about the origin, and with small noise.
fn told_otherwise(name: &str, scale: f64, noise_m: f64) -> PathBuf {
    let other_from_world =
        Se3::new(So3::from_quaternion(0.1, -0.2, 0.4, 0.9).unwrap(), [3.0, -7.0, 1.5].into());
    // A fixed sequence of numbers in [-1, 1]: Weyl's, so that the test needs no generator.
    let mut phase = 0.0_f64;
    let mut next = move || {
        phase = (phase + 0.618_033_988_749_895).fract();
        2.0 * phase - 1.0
    };
    let truth = truth();
    let mut text = String::from("# timestamp tx ty tz qx qy qz qw\n");
    for StampedPose { time, world_from_body } in truth.poses() {
        let p = other_from_world * *world_from_body;
        let t = p.translation * scale;
        let t = [t.x + noise_m * next(), t.y + noise_m * next(), t.z + noise_m * next()];
        let q = p.rotation.quaternion_xyzw();
        text.push_str(&format!("{time} {} {} {} {} {} {} {}\n", t[0], t[1], t[2], q[0], q[1], q[2], q[3]));
    }
    let file = shared().root.join(name);
    std::fs::write(&file, text).unwrap();
    file
}

fn run_with(trajectory: &Path, out: &str) -> Value {
    let flags = [
        "--json",
        "--set",
        "eval.mode=auto",
        "--progress",
        "off",
        "--trajectory",
        trajectory.to_str().unwrap(),
        "--trajectory-body",
        "camera0",
    ];
    run_on(&shared().sequence, &shared().root.join(out), &flags).ends_with(0).json()
}

#[test]
fn the_map_of_the_tiny_room_lies_on_the_scan() {
    let (_, json) = finished();
    assert!(json["result"]["mesh_triangles"].as_u64().unwrap() > 10_000);
    // 160 px wide images put neighbouring rays 4 cm apart at 3 m: precision at 0.10 m must be high, recall is
    // bounded by what 2.5 s of flight see. Without any of stereo, placement or fusion F would be below 0.2.
    assert!(score(json, "f@0.10") > 0.6, "{}", json["scores"]);
    let surface = &json["result"]["evaluation"]["surface"];
    let at_10 = surface["rigid"].as_array().unwrap().last().unwrap();
    assert!(at_10["precision"].as_f64().unwrap() > 0.8, "{at_10}");
    // The depth images are exact, so the error is stereo's own.
    assert!(score(json, "abs-rel") < 0.1, "{}", json["scores"]);
}

#[test]
fn poses_from_another_world_are_placed_by_their_trajectory() {
    let (_, with_truth) = finished();
    let trajectory = told_otherwise("vio moved.tum", 1.0, 0.002);
    let json = run_with(&trajectory, "moved");
    assert_eq!(json["result"]["metric_poses"]["source"], "external");
    // Noise of 2 mm uniform in each axis has an RMS of 2 mm in space; the fit can only take from it.
    assert!(score(&json, "ate") < 0.0025, "{}", json["scores"]);
    assert!(score(&json, "ate") > 0.0005, "the noise must be seen: {}", json["scores"]);
    // 2 mm against a path of about two metres.
    assert!(score(&json, "scale") < 0.005, "{}", json["scores"]);
    // Such noise costs some matches, the unknown rigid motion nothing.
    let (moved, truth) = (score(&json, "f@0.10"), score(with_truth, "f@0.10"));
    assert!(moved > truth - 0.1, "F@0.10 {moved} against {truth} with true poses");
}

#[test]
fn a_trajectory_of_wrong_scale_is_found_out_by_the_rigid_score_and_forgiven_by_the_free_one() {
    let (_, with_truth) = finished();
    let json = run_with(&told_otherwise("vio scaled.tum", 1.3, 0.0), "scaled");
    // The exact answer: ln 1.3.
    assert!((score(&json, "scale") - 1.3_f64.ln()).abs() < 1e-3, "{}", json["scores"]);
    assert!(score(&json, "ate-sim3") < 1e-3 && score(&json, "ate") > 0.02, "{}", json["scores"]);
    // The rigid fit undoes no scale, so a map that is 30 % too large must lose.
    let (native, truth) = (score(&json, "f@0.10"), score(with_truth, "f@0.10"));
    assert!(native < truth - 0.15, "native F {native} against {truth}");
    assert!(score(&json, "delta-f") > 0.15, "the free scale must win it back: {}", json["scores"]);
    let free = json["result"]["evaluation"]["surface"]["scale_free"].as_f64().unwrap();
    assert!((free * 1.3 - 1.0).abs() < 0.05, "free scale {free}, expected about {}", 1.0 / 1.3);
}

#[test]
fn the_result_has_the_same_bits_with_one_thread_and_with_four() {
    let root = &shared().root;
    let folders = ["1", "4"].map(|threads| {
        let out = root.join(format!("threads {threads}"));
        let mut command = run_command(
            &shared().sequence,
            &out,
            &["-q", "--threads", threads, "--stride", "2", "--set", "eval.mode=auto"],
        );
        ProgramOutput::from(command.output().unwrap()).ends_with(0);
        out
    });
    let names = files_under(&folders[0]);
    assert_eq!(names, files_under(&folders[1]));
    // Clock, host and command stand in these; everything else must agree to the bit.
    let clocked = ["manifest.json", "log.jsonl", "README.txt"];
    let mut compared = 0;
    for name in names.iter().filter(|n| !clocked.contains(&n.as_str())) {
        let [one, four] = [0, 1].map(|i| std::fs::read(folders[i].join(name)).unwrap());
        assert!(one == four, "{name} differs between 1 and 4 threads");
        compared += 1;
    }
    assert!(compared > 20, "only {compared} files");
    assert!(names.iter().any(|n| n == "map/mesh.ply") && names.iter().any(|n| n == "eval/metrics.json"));
}

#[test]
fn the_exported_truth_equals_the_truth_of_the_recording() {
    let truth_csv = shared().sequence.join("mav0/state_groundtruth_estimate0/data.csv");
    let body = vidar::dataset::read_trajectory(&truth_csv, &Default::default()).unwrap().0;
    assert!(
        body.len() >= 20 && truth().len() == body.len(),
        "poses of the trajectory are those of the recording"
    );
    assert!(Path::new(VIDAR).is_file());
    // A camera is a hand's breadth from its body: both fly the same way.
    let difference = (body.path_length_m() - truth().path_length_m()).abs();
    assert!(difference < 0.5, "path lengths differ by {difference} m");
    vidar(&["eval", truth_csv.to_str().unwrap(), truth_csv.to_str().unwrap()]).ends_with(0);
}
