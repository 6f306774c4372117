//! An ordinary recording, rendered: a phone in a lively hand, a rolling shutter, stamps 35 ms early, JPEG, a consumer IMU
//! and walls without texture. The calibration of lens and IMU is given; clock and readout are not.

use std::sync::OnceLock;
use tempfile::TempDir;
use vidar_core::{BodyFrame, Duration, NavState, SensorEvent, StampedPose, Trajectory};
use vidar_dataset::{OpenOptions, Recording};
use vidar_eval::{TrajectoryEvalConfig, evaluate_trajectory};
use vidar_odometry::bundle_adjustment::{Adjusted, CalibrationSigmas};
use vidar_odometry::{Odometry, OdometryConfig, OdometryOutput, Status};
use vidar_synth::{Lens, SynthConfig, write_sequence};

const READOUT_SECS: f64 = 0.022;
const STAMP_DELAY_SECS: f64 = -0.035;

/// The recording on disk, and what was read of it. Half a phone's resolution, so that rendering stays short.
fn recording() -> &'static (TempDir, Recording) {
    static ONCE: OnceLock<(TempDir, Recording)> = OnceLock::new();
    ONCE.get_or_init(|| {
        let mut config = SynthConfig::phone_fast();
        (config.seed, config.duration_secs, config.camera_rate_hz) = (91, 10.0, 20.0);
        (config.width, config.height, config.blur_samples) = (320, 240, 1);
        config.device.lens = Lens::Radtan {
            focal_px: 260.0,
            centre_offset_px: [-1.2, 2.5],
            distortion: [0.05, -0.08, -0.0004, 0.0006],
        };
        (config.device.readout_secs, config.device.stamp_delay_secs) = (READOUT_SECS, STAMP_DELAY_SECS);
        (config.depth, config.scan_spacing_m) = (false, 0.5);
        let folder = tempfile::tempdir().unwrap();
        write_sequence(folder.path(), &config, None, &|_, _| true).unwrap();
        let dataset = vidar_dataset::open(folder.path(), &OpenOptions::default()).unwrap();
        (folder, dataset)
    })
}

fn events(dataset: &Recording) -> impl Iterator<Item = SensorEvent> + '_ {
    dataset.events().map(Result::unwrap)
}

fn run(dataset: &Recording, mut odometry: Odometry) -> Vec<OdometryOutput> {
    let mut outputs: Vec<OdometryOutput> =
        events(dataset).filter_map(|e| odometry.push(e).unwrap()).collect();
    outputs.extend(odometry.finish());
    outputs
}

#[test]
fn clock_and_readout_are_found_and_the_trajectory_is_metric() {
    let (_, dataset) = recording();
    let config = OdometryConfig::default();
    let timing = Odometry::find_timing(&dataset.rig, dataset.camera, &config, events(dataset)).unwrap();
    let offset_ms = 1e3 * (timing.time_offset_secs + STAMP_DELAY_SECS);
    let readout_ms = 1e3 * (timing.readout_secs - READOUT_SECS);
    assert!(offset_ms.abs() < 3.0, "clock off by {offset_ms} ms: {timing:?}");
    assert!(readout_ms.abs() < 4.0, "readout off by {readout_ms} ms: {timing:?}");

    let odometry = Odometry::with_timing(&dataset.rig, dataset.camera, &config, &timing).unwrap();
    let outputs = run(dataset, odometry);
    let states = || outputs.iter().filter_map(|o| Some((o.time, o.tracking()?)));
    let first = states().next().map(|(time, _)| (time - outputs[0].time).as_secs_f64()).unwrap();
    assert!(first < 4.0, "first state after {first} s");
    let expected = outputs.iter().filter(|o| (o.time - outputs[0].time).as_secs_f64() >= first).count();
    let share = states().count() as f64 / expected as f64;
    assert!(share > 0.98, "a state for {share} of the images after the first");
    let poses = states().map(|(time, t)| StampedPose { time, world_from_body: t.state.world_from_body });
    let estimate = Trajectory::new(BodyFrame::Imu, poses.collect()).unwrap();
    let truth = dataset.ground_truth.as_ref().unwrap();
    let report = evaluate_trajectory(&estimate, truth, &TrajectoryEvalConfig::default()).unwrap();
    let (ate, scale) = (report.ate_se3_m.unwrap().rmse, report.scale_error.unwrap());
    let path = estimate.path_length_m();
    assert!(ate < 0.02 * path, "ATE {ate} m over {path} m");
    let (_, last) = states().next_back().unwrap();
    assert!(scale < (3.0 * last.scale_std).max(0.03), "|ln s| {scale} at a stated {}", last.scale_std);
}

#[test]
fn a_live_odometry_corrects_clock_and_readout_on_the_way_and_the_adjustment_afterwards_reaches_every_image() {
    let (_, dataset) = recording();
    let config = OdometryConfig::default();
    let mut odometry = Odometry::new(&dataset.rig, dataset.camera, &config).unwrap();
    odometry.keep_log();
    let mut outputs: Vec<OdometryOutput> =
        events(dataset).filter_map(|e| odometry.push(e).unwrap()).collect();
    outputs.extend(odometry.finish());
    let last = outputs.last().unwrap();
    assert!(matches!(last.status, Status::Tracking(_)), "{:?}", last.status);
    let with_state = outputs.iter().filter(|o| o.tracking().is_some()).count();
    let first = outputs.iter().position(|o| o.tracking().is_some()).unwrap();
    assert_eq!(with_state, outputs.len() - first, "every image after the first state has one");
    // What is known of the clock changes on the way; the world does not.
    assert!(outputs.iter().filter_map(OdometryOutput::tracking).all(|t| t.segment == 0));
    let found_ms = 1e3 * (odometry.timing().time_offset_secs + STAMP_DELAY_SECS);
    assert!(found_ms.abs() < 4.0, "clock off by {found_ms} ms");

    let adjusted = odometry.adjust(&CalibrationSigmas::default()).unwrap();
    assert!(adjusted.is_consistent(), "{:?}", adjusted.report);
    assert!(adjusted.images.len() + 2 >= outputs.len(), "{} of {}", adjusted.images.len(), outputs.len());
    let calibration = &adjusted.calibration;
    let offset_ms = 1e3 * (calibration.time_offset_secs + STAMP_DELAY_SECS);
    let readout_ms = 1e3 * (calibration.readout_secs - READOUT_SECS);
    assert!(offset_ms.abs() < 1.0, "clock off by {offset_ms} ms, stated {}", 1e3 * calibration.sigmas[0]);
    assert!(readout_ms.abs() < 1.5, "readout off by {readout_ms} ms, stated {}", 1e3 * calibration.sigmas[1]);
    // Ground truth is in the IMU's clock.
    let offset = Duration::from_secs_f64(calibration.time_offset_secs);
    let pose = |s: &NavState| StampedPose { time: s.time + offset, world_from_body: s.world_from_body };
    let poses = adjusted.images.iter().map(|(_, state)| pose(state)).collect();
    let estimate = Trajectory::new(BodyFrame::Imu, poses).unwrap();
    let truth = dataset.ground_truth.as_ref().unwrap();
    let report = evaluate_trajectory(&estimate, truth, &TrajectoryEvalConfig::default()).unwrap();
    let (ate, scale) = (report.ate_se3_m.unwrap().rmse, report.scale_error.unwrap());
    let path = estimate.path_length_m();
    eprintln!("ATE {ate:.4} m over {path:.2} m, |ln s| {scale:.4} at σ {:.4}", adjusted.scale_std);
    assert!(ate < 0.005 * path, "ATE {ate} m over {path} m");
    assert!(scale < (3.0 * adjusted.scale_std).max(0.01), "|ln s| {scale} at σ {}", adjusted.scale_std);
    assert!(adjusted.keyframes.iter().all(|k| k.landmarks.len() < 400));
    let covariances = adjusted.keyframes.iter().filter_map(|k| k.previous.map(|(_, c)| c));
    assert!(covariances.clone().count() + 1 == adjusted.keyframes.len());
    for covariance in covariances {
        assert!(covariance.symmetric_eigenvalues().min() > 0.0, "{covariance}");
    }
    let again = odometry.adjust(&CalibrationSigmas::default()).unwrap();
    assert!(again == adjusted, "the same log gave another adjustment");
}

#[test]
fn what_comes_into_view_again_is_tied_and_makes_no_pose_worse() {
    let mut config = SynthConfig::phone_slow().resized(320, 240);
    (config.seed, config.duration_secs, config.camera_rate_hz) = (101, 14.0, 15.0);
    (config.blur_samples, config.depth, config.scan_spacing_m) = (1, false, 0.5);
    let folder = tempfile::tempdir().unwrap();
    write_sequence(folder.path(), &config, None, &|_, _| true).unwrap();
    let dataset = vidar_dataset::open(folder.path(), &OpenOptions::default()).unwrap();
    let mut odometry = Odometry::new(&dataset.rig, dataset.camera, &OdometryConfig::default()).unwrap();
    odometry.keep_log();
    for event in events(&dataset) {
        odometry.push(event).unwrap();
    }
    odometry.finish();
    let truth = dataset.ground_truth.as_ref().unwrap();
    let ate_m = |adjusted: &Adjusted| {
        let offset = Duration::from_secs_f64(adjusted.calibration.time_offset_secs);
        let pose = |s: &NavState| StampedPose { time: s.time + offset, world_from_body: s.world_from_body };
        let poses = adjusted.images.iter().map(|(_, state)| pose(state)).collect();
        let estimate = Trajectory::new(BodyFrame::Imu, poses).unwrap();
        let report = evaluate_trajectory(&estimate, truth, &TrajectoryEvalConfig::default()).unwrap();
        report.ate_se3_m.unwrap().rmse
    };
    let with = odometry.adjust(&CalibrationSigmas::default()).unwrap();
    assert!(with.report.loops > 0 && with.findings.is_empty(), "{:?} {:?}", with.report, with.findings);
    odometry.forget_log_images();
    let without = odometry.adjust(&CalibrationSigmas::default()).unwrap();
    assert_eq!(without.report.loops, 0);
    let (with_m, without_m) = (ate_m(&with), ate_m(&without));
    eprintln!("ATE {with_m:.4} m with {} loops, {without_m:.4} m without", with.report.loops);
    // The error of scale, which no loop shows, is a part of both.
    assert!(with_m < 1.1 * without_m, "ATE {with_m} m with loops, {without_m} m without");
}
