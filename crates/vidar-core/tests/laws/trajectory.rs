//! Trajectories: interpolation, nearest poses, and the lever arm between the frames of a rig.

// Helpers outside #[test] functions may stop at the first surprise too.

use nalgebra::{Matrix3, Vector3};
use proptest::prelude::*;
use std::f64::consts::FRAC_PI_2;
use vidar_core::{
    BodyFrame, CameraId, CameraModel, Duration, LieGroup, Pinhole, Rig, RigCamera, Se3, So3, StampedPose,
    Timestamp, Trajectory, TrajectoryError,
};

fn at(millis: i64, rotation: Vector3<f64>, translation: Vector3<f64>) -> StampedPose {
    // A Unix stamp, so that seconds in f64 would show.
    let time = Timestamp::from_nanos(1_403_636_580_838_555_648) + Duration::from_millis(millis);
    StampedPose { time, world_from_body: Se3::new(So3::exp(&rotation), translation) }
}

fn flight() -> Trajectory {
    let poses = vec![
        at(0, Vector3::zeros(), Vector3::zeros()),
        at(50, Vector3::z() * 0.2, Vector3::new(1.0, 0.0, 0.0)),
        at(100, Vector3::new(0.1, 0.0, 0.3), Vector3::new(1.0, 1.0, 0.0)),
        at(1100, Vector3::new(0.1, 0.5, 0.3), Vector3::new(1.0, 1.0, 2.0)),
    ];
    Trajectory::new(BodyFrame::Imu, poses).unwrap()
}

const GAP: Duration = Duration::from_millis(50);

#[test]
fn poses_at_stamps_are_exact_and_times_outside_give_none() {
    let flight = flight();
    for pose in flight.poses() {
        assert_eq!(flight.interpolate(pose.time, Duration::ZERO), Some(pose.world_from_body));
    }
    let (first, last) = flight.time_range().unwrap();
    let tick = Duration::from_nanos(1);
    assert_eq!(flight.interpolate(first - tick, GAP), None);
    assert_eq!(flight.interpolate(last + tick, GAP), None);
    assert!(flight.interpolate(first + tick, GAP).is_some());
}

#[test]
fn a_gap_is_not_bridged_beyond_its_limit() {
    let flight = flight();
    let inside = flight.poses()[2].time + Duration::from_millis(500);
    assert_eq!(flight.interpolate(inside, Duration::from_millis(999)), None);
    assert!(flight.interpolate(inside, Duration::from_millis(1000)).is_some());
}

#[test]
fn interpolation_runs_evenly_along_the_geodesic() {
    let poses = vec![
        at(0, Vector3::zeros(), Vector3::new(1.0, 2.0, 3.0)),
        at(100, Vector3::z() * FRAC_PI_2, Vector3::new(1.0, 2.0, 5.0)),
    ];
    let turn = Trajectory::new(BodyFrame::Imu, poses).unwrap();
    let time = turn.poses()[0].time + Duration::from_millis(25);
    let found = turn.interpolate(time, Duration::from_millis(100)).unwrap();
    assert!((found.rotation.log() - Vector3::z() * (FRAC_PI_2 / 4.0)).norm() < 1e-14);
    assert!((found.translation - Vector3::new(1.0, 2.0, 3.5)).norm() < 1e-14);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 500, failure_persistence: None, ..Default::default() })]

    #[test]
    fn interpolation_never_jumps(nanos in 0..1_100_000_000_i64) {
        let flight = flight();
        let wide = Duration::from_millis(1000);
        let time = flight.poses()[0].time + Duration::from_nanos(nanos);
        let now = flight.interpolate(time, wide).unwrap();
        let soon = flight.interpolate(time + Duration::from_nanos(1000), wide);
        if let Some(soon) = soon {
            // The fastest piece flies 20 m/s and turns 4 rad/s; a microsecond later it is 20 µm on.
            let step = soon.minus(&now).norm();
            prop_assert!(step < 3e-5 && step > 0.0, "{step:.2e}");
        }
    }
}

#[test]
fn the_nearest_pose_is_found_within_its_limit() {
    let flight = flight();
    let time = |millis: i64| flight.poses()[0].time + Duration::from_millis(millis);
    let limit = Duration::from_millis(20);
    let nearest =
        |millis| flight.nearest(time(millis), limit).map(|p| (p.time - time(0)).nanos() / 1_000_000);
    assert_eq!(
        [-21, -20, 3, 24, 30, 45, 50, 121, 1095, 1121].map(nearest),
        [None, Some(0), Some(0), None, Some(50), Some(50), Some(50), None, Some(1100), None]
    );
}

#[test]
fn poses_out_of_order_or_not_finite_are_an_error_with_their_index() {
    let mut poses = flight().poses().to_vec();
    poses[2].time = poses[1].time;
    let (time, previous) = (poses[2].time, poses[1].time);
    let error = Trajectory::new(BodyFrame::Imu, poses.clone()).unwrap_err();
    assert_eq!(error, TrajectoryError::NotIncreasing { index: 2, time, previous });
    assert!(error.to_string().contains("1403636580.888555648"), "{error}");
    poses[1].world_from_body.translation.y = f64::NAN;
    let time = poses[1].time;
    assert_eq!(Trajectory::new(BodyFrame::Imu, poses), Err(TrajectoryError::NotFinite { index: 1, time }));
    let empty = Trajectory::new(BodyFrame::Other, vec![]).unwrap();
    assert!(empty.is_empty() && empty.time_range().is_none());
    assert_eq!(empty.interpolate(time, GAP), None);
    assert_eq!(empty.nearest(time, GAP), None);
}

/// A camera 10 cm ahead of the IMU and 5 cm to its left, looking along the body's x axis.
fn rig() -> Rig {
    let model = CameraModel::Pinhole(Pinhole::new(400.0, 400.0, 320.0, 240.0, 640, 480).unwrap());
    // Columns: the camera's right, down and forward in the body's axes (x ahead, y left, z up).
    let axes = Matrix3::from_columns(&[-Vector3::y(), -Vector3::z(), Vector3::x()]);
    let body_from_camera = Se3::new(So3::from_matrix(&axes).unwrap(), Vector3::new(0.1, 0.05, 0.0));
    let camera = |body_from_camera| RigCamera {
        model: model.clone(),
        body_from_camera,
        time_offset: Duration::ZERO,
        rate_hz: Some(20.0),
    };
    Rig { cameras: vec![camera(body_from_camera), camera(Se3::from_translation(Vector3::z()))], imu: None }
}

#[test]
fn the_lever_arm_turns_with_the_body() {
    // The body turns left by 90 degrees on the spot: the camera swings from (0.1, 0.05) to (-0.05, 0.1).
    let poses = vec![
        at(0, Vector3::zeros(), Vector3::new(5.0, 5.0, 1.0)),
        at(100, Vector3::z() * FRAC_PI_2, Vector3::new(5.0, 5.0, 1.0)),
    ];
    let body = Trajectory::new(BodyFrame::Imu, poses).unwrap();
    let camera = body.in_frame(BodyFrame::Camera(CameraId(0)), &rig()).unwrap();
    assert_eq!(camera.body(), BodyFrame::Camera(CameraId(0)));
    let positions = [Vector3::new(5.1, 5.05, 1.0), Vector3::new(4.95, 5.1, 1.0)];
    let ahead = [Vector3::x(), Vector3::y()];
    for i in 0..2 {
        let pose = camera.poses()[i].world_from_body;
        assert!((pose.translation - positions[i]).norm() < 1e-14, "{i}: {}", pose.translation);
        assert!((pose.rotation * Vector3::z() - ahead[i]).norm() < 1e-14);
        assert_eq!(camera.poses()[i].time, body.poses()[i].time);
    }
    // The body stands still while the camera travels a chord.
    assert!(body.path_length_m() < 1e-15);
    assert!((camera.path_length_m() - 0.15_f64.hypot(0.05)).abs() < 1e-14);
}

#[test]
fn frames_can_be_changed_there_and_back_and_across() {
    let (rig, flight) = (rig(), flight());
    let camera0 = flight.in_frame(BodyFrame::Camera(CameraId(0)), &rig).unwrap();
    let camera1 = camera0.in_frame(BodyFrame::Camera(CameraId(1)), &rig).unwrap();
    let back = camera1.in_frame(BodyFrame::Imu, &rig).unwrap();
    assert_eq!(back.body(), BodyFrame::Imu);
    let direct = flight.in_frame(BodyFrame::Camera(CameraId(1)), &rig).unwrap();
    for i in 0..flight.len() {
        assert!(back.poses()[i].world_from_body.minus(&flight.poses()[i].world_from_body).norm() < 1e-14);
        assert!(direct.poses()[i].world_from_body.minus(&camera1.poses()[i].world_from_body).norm() < 1e-14);
    }
    assert_eq!(flight.in_frame(BodyFrame::Imu, &rig), Ok(flight.clone()));
}

#[test]
fn poses_of_a_body_with_unknown_mounting_are_never_relabelled() {
    let (rig, flight) = (rig(), flight());
    assert_eq!(
        flight.in_frame(BodyFrame::Camera(CameraId(2)), &rig),
        Err(TrajectoryError::NoSuchCamera(CameraId(2)))
    );
    let prism = Trajectory::new(BodyFrame::Other, flight.poses().to_vec()).unwrap();
    let error = prism.in_frame(BodyFrame::Camera(CameraId(0)), &rig).unwrap_err();
    assert_eq!(error, TrajectoryError::UnknownBody(BodyFrame::Other));
    assert_eq!(
        error.to_string(),
        "poses of a tracked-object cannot be expressed in another frame of the rig"
    );
    assert_eq!(flight.in_frame(BodyFrame::Other, &rig), Err(TrajectoryError::UnknownBody(BodyFrame::Other)));
}
