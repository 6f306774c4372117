use super::*;
use crate::config::{FlightKind, SceneKind};
use vidar_core::{BodyFrame, LieGroup, StampedPose, Timestamp};

fn every_flight() -> Vec<(String, SynthConfig, FlightPath)> {
    let mut flights = Vec::new();
    for scene in [SceneKind::Room, SceneKind::Hall, SceneKind::Corridor] {
        for flight in [FlightKind::Sweep, FlightKind::Orbit, FlightKind::Aggressive] {
            for start in [Start::InFlight, Start::Static { secs: 1.0 }] {
                let config =
                    SynthConfig { scene, flight, start, duration_secs: 6.0, ..SynthConfig::default() };
                let path = FlightPath::built_in(&config).unwrap();
                flights.push((format!("{scene:?} {flight:?} {start:?}"), config, path));
            }
        }
    }
    flights
}

/// Derivative by central differences with Richardson extrapolation.
fn slope(f: impl Fn(f64) -> Vector3<f64>, t: f64) -> Vector3<f64> {
    let central = |h: f64| (f(t + h) - f(t - h)) / (2.0 * h);
    (central(5e-4) * 4.0 - central(1e-3)) / 3.0
}

#[test]
fn velocity_acceleration_and_rate_are_the_derivatives_of_the_pose() {
    for (name, _, path) in every_flight() {
        for k in 0..40 {
            let t = 0.011 + 0.147 * f64::from(k);
            let state = path.state(t);
            let velocity = slope(|t| path.world_from_body(t).translation, t);
            let acceleration = slope(|t| path.state(t).velocity_in_world, t);
            let here = state.world_from_body.rotation;
            let rate = slope(|t| path.world_from_body(t).rotation.minus(&here), t);
            assert!((velocity - state.velocity_in_world).norm() < 1e-6, "{name} velocity at {t}");
            assert!((acceleration - state.acceleration_in_world).norm() < 1e-6, "{name} acceleration at {t}");
            assert!((rate - state.angular_rate).norm() < 1e-6, "{name} rate at {t}");
        }
    }
}

#[test]
fn pose_velocity_and_acceleration_are_continuous_across_control_poses() {
    let (_, _, path) = every_flight().swap_remove(4);
    for k in 1..100 {
        let t = f64::from(k) * INTERVAL_SECS;
        let (a, b) = (path.state(t - 1e-9), path.state(t + 1e-9));
        assert!((a.acceleration_in_world - b.acceleration_in_world).norm() < 1e-5);
        assert!((a.angular_rate - b.angular_rate).norm() < 1e-6);
        assert!((a.world_from_body.translation - b.world_from_body.translation).norm() < 1e-7);
    }
}

/// Runge-Kutta of the strapdown equations: Ṙ = R ω^, v̇ = R f + g, ṗ = v.
fn integrate(path: &FlightPath, from: f64, until: f64, dt: f64) -> Se3 {
    let gravity = Vector3::new(0.0, 0.0, -vidar_core::GRAVITY_MPS2);
    let begin = path.state(from);
    let (mut r, mut v, mut p) =
        (begin.world_from_body.rotation, begin.velocity_in_world, begin.world_from_body.translation);
    let steps = ((until - from) / dt).round() as usize;
    for k in 0..steps {
        let t = from + k as f64 * dt;
        let w = |s: f64| path.state(s).angular_rate;
        let f = |s: f64| path.specific_force(s);
        // Rotation by the fourth-order Magnus expansion on the two Gauss nodes.
        let gauss = 0.5 * dt / 3.0_f64.sqrt();
        let turn_to = |h: f64| {
            let (m, g) = (t + 0.5 * h, gauss * h / dt);
            let (a, b) = (w(m - g), w(m + g));
            vidar_core::So3::exp(&((a + b) * (0.5 * h) + a.cross(&b) * (h * h * 3.0_f64.sqrt() / 12.0)))
        };
        let (half, full) = (r * turn_to(0.5 * dt), r * turn_to(dt));
        let a0 = r * f(t) + gravity;
        let a1 = half * f(t + 0.5 * dt) + gravity;
        let a2 = full * f(t + dt) + gravity;
        p += v * dt + (a0 + a1 * 2.0) * (dt * dt / 6.0);
        v += (a0 + a1 * 4.0 + a2) * (dt / 6.0);
        r = full;
    }
    Se3::new(r, p)
}

#[test]
fn integrating_the_noise_free_imu_returns_to_the_true_pose() {
    for (name, _, path) in every_flight() {
        let reached = integrate(&path, 0.0, 6.0, 0.005);
        let error = path.world_from_body(6.0).inverse() * reached;
        assert!(error.translation.norm() < 1e-3, "{name}: {} m", error.translation.norm());
        assert!(
            error.rotation.angle_rad() < 0.01_f64.to_radians(),
            "{name}: {} rad",
            error.rotation.angle_rad()
        );
    }
}

#[test]
fn a_body_at_rest_reads_gravity_upward_and_no_rate() {
    let config = SynthConfig { start: Start::Static { secs: 2.0 }, ..SynthConfig::default() };
    let path = FlightPath::built_in(&config).unwrap();
    for k in 0..18 {
        let t = 0.1 * f64::from(k);
        let state = path.state(t);
        assert_eq!(state.velocity_in_world, Vector3::zeros(), "at {t}");
        assert_eq!(state.angular_rate, Vector3::zeros(), "at {t}");
        let force_in_world = state.world_from_body.rotation * path.specific_force(t);
        assert!((force_in_world - Vector3::new(0.0, 0.0, 9.81)).norm() < 1e-12);
        // EuRoC's body has x up.
        assert!(path.specific_force(t).x > 9.7);
    }
    assert!(path.state(4.5).velocity_in_world.norm() > 0.5, "it took off");
}

#[test]
fn flights_stay_within_what_a_vehicle_can_do() {
    for (name, config, path) in every_flight() {
        for k in 0..600 {
            let state = path.state(0.01 * f64::from(k));
            let limit =
                if config.flight == FlightKind::Aggressive { (5.0, 8.0, 4.0) } else { (2.5, 4.0, 1.6) };
            assert!(state.velocity_in_world.norm() < limit.0, "{name} {}", state.velocity_in_world.norm());
            assert!(
                state.acceleration_in_world.norm() < limit.1,
                "{name} {}",
                state.acceleration_in_world.norm()
            );
            assert!(state.angular_rate.norm() < limit.2, "{name} {}", state.angular_rate.norm());
        }
    }
}

/// A wavy recorded flight sampled at 50 Hz about (20, −5, 1).
fn recording(body: BodyFrame) -> Trajectory {
    let poses = (0..300).map(|k| {
        let t = f64::from(k) * 0.02;
        let position = Vector3::new(20.0 + t.sin(), -5.0 + (0.7 * t).cos(), 1.0 + 0.3 * (1.3 * t).sin());
        let rotation = vidar_core::So3::exp(&Vector3::new(0.2 * t.sin(), 0.3 * (0.9 * t).cos(), 0.5 * t));
        let time = Timestamp::from_nanos(1_000_000_000 + i64::from(k) * 20_000_000);
        StampedPose { time, world_from_body: Se3::new(rotation, position) }
    });
    Trajectory::new(body, poses.collect()).unwrap()
}

#[test]
fn a_recorded_trajectory_is_flown_through_its_poses() {
    let recorded = recording(BodyFrame::Imu);
    let config =
        SynthConfig { trajectory_smoothing_secs: 0.0, duration_secs: 60.0, ..SynthConfig::default() };
    let path = FlightPath::from_trajectory(&recorded, &config).unwrap();
    assert!(path.duration_secs() > 5.0 && path.duration_secs() < 6.0, "{}", path.duration_secs());
    for (k, pose) in recorded.poses().iter().enumerate().skip(25).take(240) {
        let error = path.world_from_body(0.02 * k as f64 - MARGIN_SECS).inverse() * pose.world_from_body;
        // What a straight line between poses 20 ms apart misses, and the spline's own interpolation error.
        assert!(error.translation.norm() < 2e-4, "{k}: {} m", error.translation.norm());
        assert!(error.rotation.angle_rad() < 2e-4, "{k}: {} rad", error.rotation.angle_rad());
    }
}

#[test]
fn jitter_of_a_recording_is_smoothed() {
    let clean = recording(BodyFrame::Imu);
    let jittered: Vec<StampedPose> = clean
        .poses()
        .iter()
        .enumerate()
        .map(|(k, p)| {
            let mut p = *p;
            p.world_from_body.translation.x += if k % 2 == 0 { 0.004 } else { -0.004 };
            p
        })
        .collect();
    let jittered = Trajectory::new(BodyFrame::Imu, jittered).unwrap();
    let config = SynthConfig { trajectory_smoothing_secs: 0.06, ..SynthConfig::default() };
    let path = FlightPath::from_trajectory(&jittered, &config).unwrap();
    let fastest =
        (0..500).map(|k| path.state(0.01 * f64::from(k)).acceleration_in_world.norm()).fold(0.0, f64::max);
    assert!(fastest < 3.0, "{fastest} m/s²");
}

#[test]
fn a_recording_of_the_camera_is_moved_to_the_body_and_may_start_at_rest() {
    let config = SynthConfig { start: Start::Static { secs: 1.0 }, ..SynthConfig::default() };
    let of_camera = recording(BodyFrame::Camera(vidar_core::CameraId(0)));
    let path = FlightPath::from_trajectory(&of_camera, &config).unwrap();
    let first = of_camera.poses()[0].world_from_body;
    let camera = path.world_from_body(0.5) * crate::rig::euroc_body_from_camera();
    assert!((camera.translation - first.translation).norm() < 5e-3);
    assert_eq!(path.state(0.5).velocity_in_world, Vector3::zeros());
    assert!(path.state(3.5).velocity_in_world.norm() > 0.3);
}

#[test]
fn trajectories_that_cannot_be_flown_are_refused_with_a_reason() {
    let config = SynthConfig::default();
    let refuse = |poses: Vec<StampedPose>, words: &str| {
        let trajectory = Trajectory::new(BodyFrame::Imu, poses).unwrap();
        let error = FlightPath::from_trajectory(&trajectory, &config).unwrap_err().to_string();
        assert!(error.contains(words), "{error}");
    };
    let good = recording(BodyFrame::Imu).poses().to_vec();
    refuse(Vec::new(), "empty");
    refuse(good[..3].to_vec(), "at least 4");
    refuse(good[..20].to_vec(), "at least 1 s");
    refuse([&good[..100], &good[200..]].concat(), "gap");
    let mut jump = good.clone();
    jump[50].world_from_body.translation.x += 100.0;
    refuse(jump, "jumps");
    let other = Trajectory::new(BodyFrame::Other, good).unwrap();
    assert!(matches!(FlightPath::from_trajectory(&other, &config), Err(SynthError::Frame(_))));
}

#[test]
fn along_a_real_flight_the_simulated_imu_reads_what_the_real_one_read() {
    let Some(mav) = vidar_core::testing::shared_data("data/euroc_MH_01_real_11s/mav0") else { return };
    let read = |name: &str| -> Vec<(i64, Vec<f64>)> {
        let text = std::fs::read_to_string(mav.join(name)).unwrap();
        let row = |line: &str| {
            let (time, rest) = line.split_once(',').unwrap();
            (time.parse().unwrap(), rest.split(',').map(|v| v.trim().parse().unwrap()).collect())
        };
        text.lines().filter(|l| !l.starts_with('#') && !l.is_empty()).map(row).collect()
    };
    let (truth, imu) = (read("state_groundtruth_estimate0/data.csv"), read("imu0/data.csv"));
    let pose = |(time, v): &(i64, Vec<f64>)| {
        let rotation = vidar_core::So3::from_quaternion(v[4], v[5], v[6], v[3]).unwrap();
        let position = Vector3::new(v[0], v[1], v[2]);
        StampedPose { time: Timestamp::from_nanos(*time), world_from_body: Se3::new(rotation, position) }
    };
    let trajectory = Trajectory::new(BodyFrame::Imu, truth.iter().map(pose).collect()).unwrap();
    let config =
        SynthConfig { duration_secs: 60.0, trajectory_smoothing_secs: 0.02, ..SynthConfig::default() };
    let path = FlightPath::from_trajectory(&trajectory, &config).unwrap();
    let begin = truth[0].0 + (MARGIN_SECS * 1e9) as i64;
    let bias = |k: usize| Vector3::new(truth[0].1[k], truth[0].1[k + 1], truth[0].1[k + 2]);
    let (mut gyro, mut accel, mut n) = (0.0, 0.0, 0);
    for (time, v) in &imu {
        let secs = (*time - begin) as f64 * 1e-9;
        if secs < 0.0 || secs > path.duration_secs() {
            continue;
        }
        let rate = Vector3::new(v[0], v[1], v[2]) - bias(10);
        let force = Vector3::new(v[3], v[4], v[5]) - bias(13);
        gyro += (path.state(secs).angular_rate - rate).norm_squared();
        accel += (path.specific_force(secs) - force).norm_squared();
        n += 1;
    }
    assert!(n > 1500, "{n} IMU samples");
    let (gyro, accel) = ((gyro / f64::from(n)).sqrt(), (accel / f64::from(n)).sqrt());
    // What remains is vibration and the smoothing; a wrong frame or gravity sign would give 0.3 rad/s and 20 m/s².
    assert!(gyro < 0.06 && accel < 0.6, "rms differences {gyro} rad/s, {accel} m/s²");
    let fitted = trajectory.poses().iter().skip(200).step_by(10).filter(|p| p.time.nanos() > begin);
    for p in fitted.take_while(|p| ((p.time.nanos() - begin) as f64 * 1e-9) < path.duration_secs()) {
        let here = path.world_from_body((p.time.nanos() - begin) as f64 * 1e-9);
        let off = (here.translation - p.world_from_body.translation).norm();
        assert!(off < 0.01, "{off} m off the flown path at {} s", p.time);
    }
}
