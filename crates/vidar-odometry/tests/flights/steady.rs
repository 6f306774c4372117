//! Steady motion round a hall: it hardly accelerates, so that the IMU tells the scale late. The state begins all the same, with the scale as far as
//! a distance that is assumed tells it, and keyframes told before are revised when the scale is settled on the way.

use std::collections::BTreeMap;
use vidar_core::{BodyFrame, KeyframeId, LieGroup, Se3, StampedPose, Timestamp, Trajectory};
use vidar_dataset::{OpenOptions, Recording};
use vidar_eval::{TrajectoryEvalConfig, evaluate_trajectory};
use vidar_odometry::{Odometry, OdometryConfig, OdometryOutput};
use vidar_synth::{FlightKind, SceneKind, SynthConfig, write_sequence};

type Stamped = Vec<(Timestamp, Se3)>;

fn run(recording: &Recording) -> Vec<OdometryOutput> {
    let events = || recording.events().map(Result::unwrap);
    let config = OdometryConfig::default();
    let timing = Odometry::find_timing(&recording.rig, recording.camera, &config, events()).unwrap();
    let mut odometry = Odometry::with_timing(&recording.rig, recording.camera, &config, &timing).unwrap();
    let mut outputs: Vec<OdometryOutput> = events().filter_map(|e| odometry.push(e).unwrap()).collect();
    outputs.extend(odometry.finish());
    outputs
}

/// Stamps and poses world_from_camera of all keyframes, as they were told and as they were revised last.
fn keyframes(outputs: &[OdometryOutput]) -> (Stamped, Stamped) {
    let mut told: BTreeMap<KeyframeId, (Timestamp, Se3, Se3)> = BTreeMap::new();
    for tracking in outputs.iter().filter_map(|o| o.tracking()) {
        if let Some(k) = &tracking.keyframe {
            told.insert(k.id, (k.state.time, k.world_from_camera, k.world_from_camera));
        }
        for revised in tracking.revised.iter().chain(&tracking.settled) {
            told.get_mut(&revised.id).unwrap().2 = revised.world_from_camera;
        }
    }
    told.into_values().map(|(time, first, last)| ((time, first), (time, last))).unzip()
}

#[test]
fn a_scale_that_is_settled_later_revises_the_keyframes_before() {
    let mut config = SynthConfig::phone_slow().resized(320, 240);
    (config.scene, config.flight, config.seed) = (SceneKind::Hall, FlightKind::Orbit, 61);
    (config.duration_secs, config.camera_rate_hz, config.depth, config.scan_spacing_m) =
        (14.0, 15.0, false, 0.5);
    config.blur_samples = 1;
    let folder = tempfile::tempdir().unwrap();
    write_sequence(folder.path(), &config, None, &|_, _| true).unwrap();
    let recording = vidar_dataset::open(folder.path(), &OpenOptions::default()).unwrap();
    let outputs = run(&recording);

    let first = outputs.iter().find(|o| o.tracking().is_some()).unwrap();
    let waited = (first.time - outputs[0].time).as_secs_f64();
    assert!(waited < 2.8, "first state after {waited} s");
    let sigma = first.tracking().unwrap().scale_std;
    assert!(
        (0.3..1.0).contains(&sigma),
        "σ(ln s) of the first state {sigma}: an assumed distance tells it to a factor"
    );
    let segments: Vec<u32> = outputs.iter().filter_map(|o| Some(o.tracking()?.segment)).collect();
    assert!(segments.iter().all(|s| *s == segments[0]), "one world");

    let truth = recording.ground_truth.as_ref().unwrap();
    let camera_from_body = recording.rig.cameras[0].body_from_camera.inverse();
    let errors = |poses: &[(Timestamp, Se3)]| {
        let poses = poses
            .iter()
            .map(|(time, pose)| StampedPose { time: *time, world_from_body: *pose * camera_from_body });
        let estimate = Trajectory::new(BodyFrame::Imu, poses.collect()).unwrap();
        let report = evaluate_trajectory(&estimate, truth, &TrajectoryEvalConfig::default()).unwrap();
        (report.ate_se3_m.unwrap().rmse, report.scale_error.unwrap())
    };
    let (told, revised) = keyframes(&outputs);
    let (told, revised) = (errors(&told), errors(&revised));
    println!("first state after {waited} s at σ {sigma}; ATE, |ln s|: told {told:?}, revised {revised:?}");
    assert!(revised.0 < 0.5 * told.0, "ATE of keyframes as told {} m, as revised {} m", told.0, revised.0);
}
