//! Trajectory errors agree with evo's to 1e-9 (golden numbers made by `tools/make_evo_golden.py`).

use serde_json::Value;
use std::path::{Path, PathBuf};
use vidar_core::testing::{shared_data, skipped};
use vidar_core::{BodyFrame, Se3, So3, StampedPose, Timestamp, Trajectory};
use vidar_eval::{ErrorStats, TrajectoryEvalConfig, TrajectoryReport, evaluate_trajectory};

const TOLERANCE: f64 = 1e-9;

fn data(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name)
}

fn json(name: &str) -> Value {
    serde_json::from_str(&std::fs::read_to_string(data(name)).unwrap()).unwrap()
}

fn read_tum(path: &Path) -> Trajectory {
    let text = std::fs::read_to_string(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    let stamped = text.lines().filter(|l| !l.starts_with('#') && !l.trim().is_empty()).map(|line| {
        let fields: Vec<&str> = line.split_whitespace().collect();
        let v: Vec<f64> = fields[1..8].iter().map(|f| f.parse().unwrap()).collect();
        StampedPose {
            time: Timestamp::parse_secs(fields[0]).unwrap(),
            world_from_body: Se3::new(
                So3::from_quaternion(v[3], v[4], v[5], v[6]).unwrap(),
                nalgebra::Vector3::new(v[0], v[1], v[2]),
            ),
        }
    });
    Trajectory::new(BodyFrame::Imu, stamped.collect()).unwrap()
}

#[track_caller]
fn assert_stats(what: &str, ours: Option<&ErrorStats>, golden: &Value) {
    let ours = ours.unwrap_or_else(|| panic!("{what}: no numbers"));
    assert_eq!(ours.count as u64, golden["count"].as_u64().unwrap(), "{what}: count");
    for (name, value) in [
        ("rmse", ours.rmse),
        ("mean", ours.mean),
        ("median", ours.median),
        ("std", ours.std),
        ("min", ours.min),
        ("max", ours.max),
    ] {
        let expected = golden[name].as_f64().unwrap();
        assert!(
            (value - expected).abs() <= TOLERANCE,
            "{what}: {name} is {value:.12}, evo says {expected:.12}"
        );
    }
}

#[track_caller]
fn assert_agrees(what: &str, report: &TrajectoryReport, golden: &Value) {
    assert_eq!(report.matched as u64, golden["matched"].as_u64().unwrap(), "{what}: matched");
    assert_stats(&format!("{what}: ATE SE(3)"), report.ate_se3_m.as_ref(), &golden["ate_se3_m"]);
    assert_stats(&format!("{what}: ATE Sim(3)"), report.ate_sim3_m.as_ref(), &golden["ate_sim3_m"]);
    let turned = &golden["orientation_se3_deg"];
    assert_stats(&format!("{what}: orientation"), report.orientation_se3_deg.as_ref(), turned);
    let (scale, expected) = (report.scale.unwrap(), golden["scale"].as_f64().unwrap());
    assert!((scale - expected).abs() <= TOLERANCE, "{what}: scale is {scale:.12}, evo says {expected:.12}");
}

#[track_caller]
fn assert_rpe(what: &str, report: Option<&vidar_eval::RpeReport>, golden: &Value, key: &str) {
    let report = report.unwrap_or_else(|| panic!("{what}: no {key}"));
    let expected = &golden[format!("{key}_translation_m")];
    assert_eq!(report.pairs as u64, expected["count"].as_u64().unwrap(), "{what}: {key} pairs");
    assert_stats(&format!("{what}: {key} translation"), Some(&report.translation_m), expected);
    let expected = &golden[format!("{key}_rotation_deg")];
    assert_stats(&format!("{what}: {key} rotation"), Some(&report.rotation_deg), expected);
}

fn evaluate_and_compare(what: &str, truth: &Path, estimate: &Path, golden: &Value) {
    let (truth, estimate) = (read_tum(truth), read_tum(estimate));
    let config = TrajectoryEvalConfig::default();
    let report = evaluate_trajectory(&estimate, &truth, &config).unwrap();
    assert_agrees(what, &report, golden);
    assert_rpe(what, report.rpe_frames.as_ref(), golden, "rpe_frames_1");
    assert_rpe(what, report.rpe_metres.as_ref(), golden, "rpe_metres_1");
    let tens = TrajectoryEvalConfig { rpe_frames: 10, ..config };
    let report = evaluate_trajectory(&estimate, &truth, &tens).unwrap();
    assert_rpe(what, report.rpe_frames.as_ref(), golden, "rpe_frames_10");
}

#[test]
fn a_made_up_flight_is_judged_as_evo_judges_it() {
    let golden = json("evo_synthetic.json");
    evaluate_and_compare(
        "synthetic",
        &data("synthetic_truth.tum"),
        &data("synthetic_estimate.tum"),
        &golden["result"],
    );
}

/// Ground truth of the eleven EuRoC sequences, unpacked into a folder of this process; `None` when not at hand.
fn unpacked_euroc() -> Option<PathBuf> {
    let packed = shared_data("data/packed/euroc_imu_gt_all11.tar.xz")?;
    let folder = std::env::temp_dir().join(format!("vidar-eval-evo-{}", std::process::id()));
    std::fs::create_dir_all(&folder).ok()?;
    let unpacked = std::process::Command::new("tar")
        .args(["-xJf".as_ref(), packed.as_os_str(), "-C".as_ref(), folder.as_os_str()])
        .args(["--wildcards", "*/groundtruth_openvins_tum.txt"])
        .status();
    if !matches!(unpacked, Ok(status) if status.success()) {
        skipped(&"the EuRoC ground truth could not be unpacked with tar and xz");
        return None;
    }
    Some(folder)
}

#[test]
fn real_euroc_estimates_are_judged_as_evo_judges_them() {
    let Some(root) = shared_data("data/rpg_reference_trajectories") else { return };
    let Some(folder) = unpacked_euroc() else { return };
    let golden = json("evo_euroc.json");
    let results = golden["results"].as_array().unwrap();
    assert!(results.len() >= 20, "golden file holds only {} trajectories", results.len());
    for result in results {
        let name = result["estimate"].as_str().unwrap();
        let sequence = result["sequence"].as_str().unwrap();
        let truth = folder.join("euroc_imu_gt_all11").join(sequence).join("groundtruth_openvins_tum.txt");
        evaluate_and_compare(name, &truth, &root.join(name), result);
    }
    std::fs::remove_dir_all(&folder).unwrap();
}
