//! Starts that must happen, and those that must not.

use super::gyro_bias::{RayPair, gyro_bias};
use super::*;
use crate::imu::{Bias, Preintegration};
use crate::simulate::{
    Course, CourseKind, FeatureOdometry, FeatureOdometryConfig, Random, Simulation, SimulationConfig,
    StepOutput,
};
use nalgebra::Vector3;
use vidar_core::{
    AngularRate, FrameId, GRAVITY_MPS2, ImuNoise, ImuSample, LieGroup, So3, SpecificForce, Timestamp,
};

fn simulate(course: &Course, config: &SimulationConfig) -> Simulation {
    Simulation::new(course, 0.0, course.secs, config)
}

/// Runs until a start is accepted or the recording ends; every initialisation failure on the way, and the start if there was one.
fn until_started(simulation: &Simulation) -> (Vec<InitFailure>, Option<(FrameId, f64, FeatureOdometry)>) {
    until_started_with(simulation, FeatureOdometryConfig::new(&ImuNoise::EUROC, 2.0))
}

fn until_started_with(
    simulation: &Simulation,
    config: FeatureOdometryConfig,
) -> (Vec<InitFailure>, Option<(FrameId, f64, FeatureOdometry)>) {
    let mut odometry = FeatureOdometry::for_simulation(config, simulation).unwrap();
    let mut failures = Vec::new();
    for frame in &simulation.frames {
        match odometry.push(frame.id, frame.time, &frame.observations).unwrap() {
            StepOutput::Waiting(failure) => failures.extend(failure),
            StepOutput::Initialised { log_scale_sigma, .. } => {
                return (failures, Some((frame.id, log_scale_sigma, odometry)));
            }
            StepOutput::Tracking(_) => unreachable!("it starts before it runs"),
        }
    }
    (failures, None)
}

#[test]
fn a_flight_with_speeding_up_and_turning_is_started_metrically() {
    for seed in [1, 2, 3] {
        let course = Course { kind: CourseKind::Eight, secs: 8.0, speed: 1.6, phase: seed as f64 };
        let simulation = simulate(&course, &SimulationConfig { seed, ..Default::default() });
        let (failures, started) = until_started(&simulation);
        let (at, sigma, mut odometry) =
            started.unwrap_or_else(|| panic!("never started, at last: {}", failures.last().unwrap()));
        assert!(sigma <= 0.03, "{sigma}");
        let truth = &simulation.frames[at.index()].truth;
        let (_, _, state) = odometry.smoother().unwrap().newest().unwrap();
        // Gravity fixes inclination; the speed carries the scale.
        let up = |s: &crate::imu::NavState| s.world_from_body.rotation.inverse() * Vector3::z();
        let tilt_deg = up(state).angle(&up(truth)).to_degrees();
        assert!(tilt_deg < 2.0, "seed {seed}: tilt off by {tilt_deg:.2} deg");
        let ratio = state.velocity.norm() / truth.velocity.norm();
        assert!((0.85..1.15).contains(&ratio), "seed {seed}: speed {ratio:.3} of the true one");
        assert!((state.bias.gyro - truth.bias.gyro).norm() < 0.01);
    }
}

/// A state begins with an assumed distance, and no attempt claims to know its scale better than to a factor.
#[test]
fn constant_velocity_never_tells_the_scale() {
    for (seed, speed) in [(1, 0.4), (2, 1.0), (3, 2.5), (4, 1.5)] {
        let course = Course { kind: CourseKind::Straight, secs: 6.0, speed, phase: 0.4 * seed as f64 };
        let simulation =
            simulate(&course, &SimulationConfig { seed, wall_distance_m: 4.0, ..Default::default() });
        let (failures, started) = until_started(&simulation);
        let (at, ..) =
            started.as_ref().unwrap_or_else(|| panic!("no state at {speed} m/s: {:?}", failures.last()));
        let waited = (simulation.frames[at.index()].time - simulation.frames[0].time).as_secs_f64();
        assert!(waited < 3.2, "a state after {waited} s at {speed} m/s");
        let refused = failures.iter().filter(|r| r.reason == InitFailureReason::ScaleUncertainty);
        let sigmas: Vec<f64> = refused.map(|r| r.measured).chain(started.map(|s| s.1)).collect();
        let least = sigmas.iter().copied().fold(f64::INFINITY, f64::min);
        assert!(least > 0.5, "σ(ln s) {least} at {speed} m/s");
        assert!(
            sigmas.len() * 2 > failures.len(),
            "{} of {} for the scale's sake",
            sigmas.len(),
            failures.len()
        );
    }
}

#[test]
fn pure_rotation_is_never_accepted() {
    for (seed, speed) in [(1, 0.3), (2, 1.0), (3, 2.0)] {
        let course = Course { kind: CourseKind::Spin, secs: 6.0, speed, phase: 0.4 * seed as f64 };
        let simulation = simulate(&course, &SimulationConfig { seed, ..Default::default() });
        let (failures, started) = until_started(&simulation);
        assert!(started.is_none(), "accepted turning at {speed} rad/s with sigma {:?}", started.map(|s| s.1));
        assert!(!failures.is_empty());
    }
}

#[test]
fn standing_still_is_not_taken_for_flight() {
    let course = Course { kind: CourseKind::Still, secs: 5.0, speed: 0.0, phase: 0.3 };
    let simulation = simulate(&course, &SimulationConfig::default());
    // Once it is noticed no attempt is made; those before had not seen enough.
    let (failures, started) = until_started(&simulation);
    assert!(started.is_none());
    assert!(failures.iter().all(|f| f.reason == InitFailureReason::Seconds), "{failures:?}");
    let unnoticed =
        FeatureOdometryConfig { notices_rest: false, ..FeatureOdometryConfig::new(&ImuNoise::EUROC, 2.0) };
    let (failures, started) = until_started_with(&simulation, unnoticed);
    assert!(started.is_none());
    let parallax = failures.iter().rfind(|r| r.reason == InitFailureReason::Parallax).unwrap();
    assert!(parallax.measured < 0.2, "{parallax}");
    let told = parallax.to_string();
    assert!(told.starts_with("parallax 0.") && told.ends_with("deg < 0.500 deg: move sideways"), "{told}");
}

#[test]
fn gyroscope_bias_is_found_from_epipolar_planes_despite_wrong_tracks() {
    let mut random = Random::new(21);
    let truth = Vector3::new(0.03, -0.02, 0.015);
    let mut pairs = Vec::new();
    for k in 0..6 {
        let turn = So3::exp(&(random.normal3() * 0.1));
        let shift = random.normal3().normalize() * 0.3;
        let secs = 0.3 + 0.1 * f64::from(k);
        let mut rays = Vec::new();
        for n in 0..60 {
            let point = Vector3::new(random.normal(), random.normal(), 3.0 + random.uniform());
            let noise = random.normal3() * 1e-3;
            let a = (point + noise).normalize();
            let b = (turn.inverse() * (point - shift)).normalize();
            // One track of sixty is wrong by some 25 px.
            let b = if n == 7 { (b + random.normal3() * 0.05).normalize() } else { b };
            rays.push((a, b));
        }
        // The gyroscope with its bias reads another turn.
        let read = turn * So3::exp(&(truth * secs));
        pairs.push(RayPair { rays, rotation: move |bias: &Bias| read * So3::exp(&(bias.gyro * -secs)) });
    }
    let found = gyro_bias(&pairs, Vector3::zeros());
    assert!((found - truth).norm() < 5e-3, "{found} {truth}");
}

fn resting(seed: u64) -> (Vec<ImuSample>, Simulation) {
    let course = Course { kind: CourseKind::Still, secs: 2.0, speed: 0.0, phase: 0.8 };
    let simulation = simulate(&course, &SimulationConfig { seed, ..Default::default() });
    (simulation.imu_samples.clone(), simulation)
}

#[test]
fn a_body_at_rest_tells_its_inclination_and_gyroscope_bias() {
    let (imu_samples, simulation) = resting(4);
    let rest = initialize_static(&imu_samples, Some(0.1), &StaticInitConfig::default()).unwrap();
    let truth = &simulation.frames[10].truth;
    assert!((rest.state.bias.gyro - truth.bias.gyro).norm() < 5e-4);
    let up = |s: &crate::imu::NavState| s.world_from_body.rotation.inverse() * Vector3::z();
    let off = up(&rest.state).angle(&up(truth));
    assert!(off < 3.0 * rest.sigmas.tilt_rad, "{off} {}", rest.sigmas.tilt_rad);
    assert_eq!(rest.state.velocity, Vector3::zeros());
}

#[test]
fn what_moves_is_not_at_rest_and_says_why() {
    let course = Course { kind: CourseKind::Eight, secs: 3.0, speed: 1.0, phase: 0.1 };
    let simulation = simulate(&course, &SimulationConfig::default());
    let config = StaticInitConfig::default();
    let failed = initialize_static(&simulation.imu_samples, None, &config).unwrap_err();
    assert_eq!(failed.reason, InitFailureReason::GyroStd);
    assert!(failed.to_string().contains("gyroscope scatter"), "{failed}");
    let (mut imu_samples, _) = resting(5);
    assert_eq!(
        initialize_static(&imu_samples, Some(2.0), &config).unwrap_err().reason,
        InitFailureReason::ImageMotion
    );
    assert_eq!(
        initialize_static(&imu_samples[..20], None, &config).unwrap_err().reason,
        InitFailureReason::Seconds
    );
    assert_eq!(initialize_static(&[], None, &config).unwrap_err().reason, InitFailureReason::Seconds);
    imu_samples.iter_mut().for_each(|r| r.accel.0 /= GRAVITY_MPS2);
    assert_eq!(
        initialize_static(&imu_samples, None, &config).unwrap_err().reason,
        InitFailureReason::SpecificForce
    );
    imu_samples[7].accel.0.x = f64::NAN;
    assert!(initialize_static(&imu_samples, None, &config).is_err());
}

#[test]
fn gravity_is_as_strong_as_it_is_told() {
    let course = Course { kind: CourseKind::Eight, secs: 8.0, speed: 1.6, phase: 2.0 };
    // At the equator.
    let simulation = simulate(&course, &SimulationConfig { gravity_mps2: 9.78, ..Default::default() });
    let up_bias = |is_valid_imu: f64| {
        let mut config = FeatureOdometryConfig::new(&ImuNoise::EUROC, 2.0);
        config.imu = config.imu.with_gravity(is_valid_imu);
        let mut odometry = FeatureOdometry::for_simulation(config, &simulation).unwrap();
        for frame in &simulation.frames {
            odometry.push(frame.id, frame.time, &frame.observations).unwrap();
        }
        let (.., state) = odometry.smoother().unwrap().newest().unwrap();
        let truth = &simulation.frames[simulation.frames.len() - 1].truth;
        (truth.world_from_body.rotation * (state.bias.accel - truth.bias.accel)).z
    };
    // What the configured gravity lacks is found in the accelerometer's bias.
    let (told, not_told) = (up_bias(9.78), up_bias(9.82));
    assert!(told.abs() < 0.015, "{told}");
    assert!((not_told - told + 0.04).abs() < 0.01, "{not_told} {told}");
    let (mut imu_samples, _) = resting(6);
    imu_samples.iter_mut().for_each(|r| r.accel.0 *= 1.2);
    let stronger = StaticInitConfig { gravity_mps2: 1.2 * GRAVITY_MPS2, ..StaticInitConfig::default() };
    assert!(
        initialize_static(&imu_samples, None, &stronger).is_ok()
            && initialize_static(&imu_samples, None, &StaticInitConfig::default()).is_err()
    );
}

#[test]
fn upside_down_is_level_too() {
    for up in [Vector3::z(), -Vector3::z(), Vector3::x(), Vector3::new(0.3, -0.9, 0.2).normalize()] {
        let turned = static_start::leveled(&(up * GRAVITY_MPS2)) * up;
        assert!((turned - Vector3::z()).norm() < 1e-9, "{up}");
    }
}

#[test]
fn a_log_without_imu_samples_or_tracks_fails() {
    let course = Course { kind: CourseKind::Eight, secs: 3.0, speed: 1.0, phase: 0.1 };
    let simulation = simulate(&course, &SimulationConfig::default());
    let mut start = InFlightInitializer::new(
        crate::backend::SmootherConfig::default(),
        simulation.camera.clone(),
        simulation.body_from_camera,
    );
    let failed = |start: &mut InFlightInitializer, log: &[LoggedFrame]| match start.attempt(log).unwrap() {
        InitOutcome::Failed(failure) => failure.reason,
        InitOutcome::Solved(_) => panic!("started"),
    };
    assert_eq!(failed(&mut start, &[]), InitFailureReason::Seconds);
    let frame = |k: usize, preintegration| LoggedFrame {
        frame: simulation.frames[k].id,
        time: simulation.frames[k].time,
        preintegration,
        observations: Vec::new(),
    };
    let apart: Vec<LoggedFrame> = (0..40).map(|k| frame(k, None)).collect();
    assert_eq!(failed(&mut start, &apart), InitFailureReason::Seconds);
    let model = crate::imu::ImuModel::from_data_sheet(&ImuNoise::EUROC, 2.0, 2.0);
    let blind: Vec<LoggedFrame> = (0..40)
        .map(|k| {
            let cut = &simulation.imu_samples[10 * k.max(1) - 10..=10 * k.max(1)];
            frame(k, Some(Preintegration::new(model, Bias::ZERO, cut)))
        })
        .collect();
    assert_eq!(failed(&mut start, &blind), InitFailureReason::Tracks);
}

/// A second of a level IMU whose body sways along x with this amplitude of its velocity, two periods a second.
fn swaying(velocity_mps: f64) -> Vec<ImuSample> {
    let rate = 4.0 * std::f64::consts::PI;
    let sample = |k: i64| {
        let accel = velocity_mps * rate * (rate * k as f64 / 200.0).cos();
        ImuSample {
            time: Timestamp::from_nanos(5_000_000 * k),
            gyro: AngularRate(Vector3::zeros()),
            accel: SpecificForce(Vector3::new(accel, 0.0, GRAVITY_MPS2)),
        }
    };
    (0..=200).map(sample).collect()
}

#[test]
fn a_hand_that_sways_is_not_one_that_hardly_moves() {
    let slow = |samples: &[ImuSample]| initialize_slow(samples, &Vector3::zeros(), GRAVITY_MPS2);
    let calm = slow(&swaying(0.1)).unwrap();
    assert!(calm.state.world_from_body.rotation.log().norm() < 0.01, "{:?}", calm.state);
    assert!(slow(&swaying(0.5)).is_none());
    let mut damaged = swaying(0.1);
    damaged[100].accel.0.x = f64::NAN;
    assert!(slow(&damaged).is_none());
    assert!(slow(&[]).is_none());
}
