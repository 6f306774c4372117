use super::*;
use proptest::prelude::*;
use vidar_core::{BodyFrame, CameraId, Duration, So3, Timestamp};

const EPOCH_NS: i64 = 1_403_636_580_838_555_648;

fn stamped(nanos: i64, world_from_body: Se3) -> StampedPose {
    StampedPose { time: Timestamp::from_nanos(nanos), world_from_body }
}

fn along(times_ms: impl IntoIterator<Item = i64>, place: impl Fn(f64) -> Se3) -> Trajectory {
    let poses = times_ms.into_iter().map(|ms| stamped(EPOCH_NS + ms * 1_000_000, place(ms as f64 * 1e-3)));
    Trajectory::new(BodyFrame::Imu, poses.collect()).unwrap()
}

/// A flight through all three dimensions, with turns.
fn flight(t: f64) -> Se3 {
    let rotation = So3::exp(&Vector3::new(0.3 * t.sin(), 0.2 * (0.7 * t).cos(), 0.5 * t));
    Se3::new(
        rotation,
        Vector3::new(2.0 * (0.8 * t).sin(), 1.5 * (0.5 * t).cos(), 0.3 * (1.3 * t).sin() + 0.1 * t),
    )
}

fn moved(trajectory: &Trajectory, a_from_b: &Sim3) -> Trajectory {
    let poses = trajectory
        .poses()
        .iter()
        .map(|p| StampedPose { time: p.time, world_from_body: a_from_b.transform_pose(&p.world_from_body) });
    Trajectory::new(trajectory.body(), poses.collect()).unwrap()
}

fn some_similarity(scale: f64) -> Sim3 {
    Sim3::new(So3::exp(&Vector3::new(0.4, -1.2, 2.0)), Vector3::new(5.0, -30.0, 1.0), scale).unwrap()
}

fn evaluate(estimate: &Trajectory, truth: &Trajectory) -> TrajectoryReport {
    evaluate_trajectory(estimate, truth, &TrajectoryEvalConfig::default()).unwrap()
}

#[test]
fn a_flight_told_in_another_world_and_unit_is_recovered_exactly() {
    let truth = along((0..200).map(|i| i * 50), flight);
    let estimate = moved(&truth, &some_similarity(0.8));
    let report = evaluate(&estimate, &truth);
    assert_eq!(
        (report.matched, report.coverage.estimate_ratio, report.coverage.truth_time_ratio),
        (200, 1.0, 1.0)
    );
    assert!(report.ate_sim3_m.unwrap().max < 1e-12);
    assert!((report.scale.unwrap() - 1.25).abs() < 1e-13);
    assert!((report.scale_error.unwrap() - 1.25_f64.ln()).abs() < 1e-13);
    assert!(report.ate_se3_m.unwrap().rmse > 0.1, "a wrong scale must show under SE(3)");
    let sim3 = report.truth_from_estimate_sim3.unwrap().to_sim3().unwrap();
    let identity = sim3 * some_similarity(0.8);
    assert!(identity.log().norm() < 1e-12, "{identity:?}");
    assert!((report.estimate_path_m - 0.8 * report.truth_path_m).abs() < 1e-9);
    assert!(report.warnings.is_empty(), "{:?}", report.warnings);
}

#[test]
fn scale_errors_of_inverse_scales_are_equal() {
    let truth = along((0..100).map(|i| i * 50), flight);
    let error = |s| evaluate(&moved(&truth, &some_similarity(s)), &truth).scale_error.unwrap();
    assert!((error(0.5) - error(2.0)).abs() < 1e-12);
    assert!(error(1.0) < 1e-12);
}

#[test]
fn another_body_is_refused_by_name() {
    let truth = along([0, 50, 100], flight);
    let camera = Trajectory::new(BodyFrame::Camera(CameraId(1)), truth.poses().to_vec()).unwrap();
    let error = evaluate_trajectory(&camera, &truth, &TrajectoryEvalConfig::default()).unwrap_err();
    let text = error.to_string();
    assert!(text.contains("camera1") && text.contains("of the body"), "{text}");
}

#[test]
fn coverage_tells_of_late_starts_holes_and_strays() {
    let truth = along((0..=1000).map(|i| i * 10), flight);
    // Starts at 2 s, is lost from 5 s to 8 s, ends at 9 s; five poses lie after the truth's end.
    let times =
        (200..=900).filter(|i| !(501..800).contains(i)).map(|i| i * 10).chain((1100..1105).map(|i| i * 10));
    let report = evaluate(&along(times, flight), &truth);
    assert_eq!((report.matched, report.estimate_poses, report.truth_poses), (402, 407, 1001));
    assert!((report.coverage.estimate_ratio - 402.0 / 407.0).abs() < 1e-12);
    assert!((report.coverage.truth_time_ratio - 0.4).abs() < 1e-9);
    assert!((report.coverage.longest_gap_secs - 3.0).abs() < 1e-9);
    assert!(report.warnings.iter().any(|w| w.kind == "low-coverage"), "{:?}", report.warnings);
}

#[test]
fn straight_lines_stillness_and_two_poses_leave_blanks_and_never_nan() {
    let straight = |t: f64| Se3::from_translation(Vector3::new(t, 2.0 * t, 0.5 * t));
    let still = |_: f64| Se3::from_translation(Vector3::new(1.0, 2.0, 3.0));
    let (line, rest, pair) = (
        along((0..50).map(|i| i * 100), straight),
        along((0..50).map(|i| i * 100), still),
        along([0, 100], flight),
    );
    for trajectory in [&line, &rest, &pair] {
        let report = evaluate(trajectory, trajectory);
        assert_eq!(
            (report.ate_se3_m, report.ate_sim3_m, report.scale, report.scale_error),
            (None, None, None, None)
        );
        assert_eq!(report.truth_from_estimate_se3, None);
        assert!(report.warnings.iter().any(|w| w.kind == "alignment-undetermined"), "{:?}", report.warnings);
        // What needs no alignment is still there.
        assert_eq!(report.ate_unaligned_m.unwrap().max, 0.0);
        assert!(report.rpe_frames.unwrap().translation_m.rmse < 1e-12);
    }
    assert!(evaluate(&rest, &rest).rpe_metres.is_none());
    let single = along([0], flight);
    let report = evaluate(&single, &single);
    assert_eq!((report.matched, report.rpe_frames, report.coverage.truth_time_ratio), (1, None, 1.0));
}

#[test]
fn the_sparser_side_chooses_its_nearest_partner_within_the_limit() {
    let at = |ms: &[i64]| along(ms.iter().copied(), flight);
    let pairs = |e: &[i64], t: &[i64]| associate(&at(e), &at(t), Duration::from_millis(10)).unwrap();
    // The truth is sparser: each of its stamps takes the nearest of the estimate's, once or twice.
    assert_eq!(pairs(&[0, 4, 6, 1000, 2000], &[5, 1003]), [(1, 0), (3, 1)]);
    assert_eq!(pairs(&[5, 1003], &[0, 4, 6, 1000, 2000]), [(0, 1), (1, 3)]);
    assert_eq!(pairs(&[6, 1000, 2000, 3000], &[1, 8, 1000]), [(0, 0), (0, 1), (1, 2)]);
    // The limit itself is within.
    assert_eq!(pairs(&[0, 1000], &[10, 1011, 5000]), [(0, 0)]);
    // As many on both sides: the estimate chooses.
    assert_eq!(pairs(&[4, 2000, 3000], &[0, 8, 1000]), [(0, 0)]);
}

#[track_caller]
fn hint_for(estimate: Vec<i64>, truth: Vec<i64>) -> String {
    let with = |times: Vec<i64>| {
        Trajectory::new(BodyFrame::Imu, times.into_iter().map(|ns| stamped(ns, Se3::IDENTITY)).collect())
            .unwrap()
    };
    evaluate_trajectory(&with(estimate), &with(truth), &TrajectoryEvalConfig::default())
        .unwrap_err()
        .to_string()
}

#[test]
fn stamps_that_never_meet_are_explained() {
    let unix: Vec<i64> = (0..100).map(|i| EPOCH_NS + i * 50_000_000).collect();
    // Unix milliseconds that were read as microseconds, so that they still fit 64-bit nanoseconds.
    let slipped: Vec<i64> = unix.iter().map(|t| t / 1000).collect();
    let text = hint_for(slipped.clone(), unix.clone());
    assert!(text.contains("unit slip: the ground truth's stamps look like milliseconds"), "{text}");
    assert!(text.contains("1403636580.838555648 … 1403636585.788555648 s"), "both ranges: {text}");
    assert!(text.contains("1403636.580838555"), "both ranges: {text}");
    let text = hint_for(unix.clone(), slipped);
    assert!(text.contains("unit slip: the estimate's stamps look like milliseconds"), "{text}");
    // A clock that starts at zero, off by its origin only.
    let text = hint_for(unix.iter().map(|t| t - EPOCH_NS).collect(), unix.clone());
    assert!(text.contains("different clocks") && text.contains("starts 1403636580.839 s after"), "{text}");
    let text = hint_for(unix.iter().map(|t| t + 25_000_000).collect(), unix);
    assert!(text.contains("interleave: allow at least 25.0 ms"), "{text}");
}

#[test]
fn empty_trajectories_and_bad_settings_are_errors() {
    let empty = Trajectory::new(BodyFrame::Imu, Vec::new()).unwrap();
    let some = along([0, 50], flight);
    let config = TrajectoryEvalConfig::default();
    let which = |e: &Trajectory, t: &Trajectory| match evaluate_trajectory(e, t, &config) {
        Err(EvalError::EmptyTrajectory { which }) => which,
        other => panic!("{other:?}"),
    };
    assert_eq!((which(&empty, &some), which(&some, &empty)), ("estimated", "ground-truth"));
    for bad in [
        TrajectoryEvalConfig { max_time_difference_ms: -1.0, ..config.clone() },
        TrajectoryEvalConfig { rpe_frames: 0, ..config.clone() },
        TrajectoryEvalConfig { rpe_distance_m: f64::NAN, ..config.clone() },
        TrajectoryEvalConfig { coverage_gap_ms: 0.0, ..config.clone() },
        TrajectoryEvalConfig { low_coverage_ratio: 1.5, ..config },
    ] {
        assert!(matches!(evaluate_trajectory(&some, &some, &bad), Err(EvalError::Config { .. })), "{bad:?}");
    }
}

#[test]
fn every_setting_changes_something() {
    let truth = along((0..=400).map(|i| i * 25), flight);
    let estimate = along((0..200).filter(|i| i % 40 < 30).map(|i| i * 50 + 7), flight);
    let base = TrajectoryEvalConfig::default();
    let report = |config: &TrajectoryEvalConfig| evaluate_trajectory(&estimate, &truth, config).ok();
    for changed in [
        TrajectoryEvalConfig { max_time_difference_ms: 5.0, ..base.clone() },
        TrajectoryEvalConfig { rpe_frames: 3, ..base.clone() },
        TrajectoryEvalConfig { rpe_distance_m: 2.0, ..base.clone() },
        TrajectoryEvalConfig { coverage_gap_ms: 300.0, ..base.clone() },
        TrajectoryEvalConfig { low_coverage_ratio: 1.0, coverage_gap_ms: 300.0, ..base.clone() },
    ] {
        assert_ne!(report(&changed), report(&base), "{changed:?}");
    }
}

#[test]
fn the_report_has_stable_keys() {
    let truth = along((0..100).map(|i| i * 50), flight);
    let value = serde_json::to_value(evaluate(&truth, &truth)).unwrap();
    let keys: Vec<&str> = value.as_object().unwrap().keys().map(String::as_str).collect();
    let expected = "body matched estimate_poses truth_poses coverage ate_se3_m ate_sim3_m ate_unaligned_m \
                    orientation_se3_deg scale scale_error rpe_frames rpe_metres estimate_path_m truth_path_m \
                    matched_estimate_path_m matched_truth_path_m truth_from_estimate_se3 truth_from_estimate_sim3 \
                    warnings";
    assert_eq!(keys, expected.split_whitespace().collect::<Vec<_>>());
    let inner =
        |value: &serde_json::Value| -> Vec<String> { value.as_object().unwrap().keys().cloned().collect() };
    assert_eq!(inner(&value["ate_se3_m"]), ["count", "rmse", "mean", "median", "std", "min", "max"]);
    assert_eq!(inner(&value["rpe_frames"]), ["step", "pairs", "translation_m", "rotation_deg"]);
    assert_eq!(value["rpe_metres"]["step"], serde_json::json!({ "unit": "metres", "length": 1.0 }));
    let again: TrajectoryReport = serde_json::from_value(value).unwrap();
    assert_eq!(again.matched, 100);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn a_rigid_motion_of_the_estimate_changes_no_error(
        turn in prop::array::uniform3(-3.0_f64..3.0),
        shift in prop::array::uniform3(-100.0_f64..100.0),
    ) {
        let truth = along((0..80).map(|i| i * 50), flight);
        let wobbly = along((0..80).map(|i| i * 50), |t| {
            let p = flight(t);
            Se3::new(p.rotation, p.translation + Vector3::new((9.0 * t).sin(), (7.0 * t).cos(), (5.0 * t).sin()) * 0.05)
        });
        let motion = Sim3::from_se3(&Se3::new(So3::exp(&Vector3::from(turn)), Vector3::from(shift)));
        let (a, b) = (evaluate(&wobbly, &truth), evaluate(&moved(&wobbly, &motion), &truth));
        let close = |x: f64, y: f64| (x - y).abs() < 1e-9;
        prop_assert!(close(a.ate_se3_m.unwrap().rmse, b.ate_se3_m.unwrap().rmse));
        prop_assert!(close(a.ate_sim3_m.unwrap().rmse, b.ate_sim3_m.unwrap().rmse));
        prop_assert!(close(a.scale.unwrap(), b.scale.unwrap()));
        prop_assert!(close(a.rpe_frames.unwrap().translation_m.rmse, b.rpe_frames.unwrap().translation_m.rmse));
        prop_assert!(a.ate_sim3_m.unwrap().rmse <= a.ate_se3_m.unwrap().rmse + 1e-12);
    }
}
