//! Factors against numeric derivatives, the prior against dense algebra, and what must stay unobservable.

mod images;
mod jacobians;

use super::prior::Part;
use super::system::System;
use super::*;
use crate::imu::{Bias, Matrix15};
use crate::simulate::{
    Course, CourseKind, FeatureOdometry, FeatureOdometryConfig, Random, Simulation, SimulationConfig,
    StepOutput,
};
use nalgebra::{DMatrix, DVector, SVector, Vector1, Vector3};
use vidar_core::{ImuNoise, LieGroup, So3};

/// A smoother that flew for a while on a built-in flight.
fn flown(
    seed: u64,
    secs: f64,
    change: impl Fn(&mut FeatureOdometryConfig, &mut GaugePriorSigmas),
) -> (FeatureOdometry, Simulation) {
    let course = Course { kind: CourseKind::Eight, secs: secs + 1.0, speed: 1.2, phase: 0.4 * seed as f64 };
    let settings = SimulationConfig { seed, tracks: 60, ..Default::default() };
    let simulation = Simulation::new(&course, 0.0, secs, &settings);
    let mut config = FeatureOdometryConfig::new(&ImuNoise::EUROC, 1.0);
    let mut sigmas = GaugePriorSigmas {
        position_m: 1e-3,
        yaw_rad: 1e-3,
        tilt_rad: 0.01,
        velocity_mps: 0.05,
        gyro_bias: 0.02,
        accel_bias: 0.05,
    };
    change(&mut config, &mut sigmas);
    let mut odometry = FeatureOdometry::for_simulation(config, &simulation).unwrap();
    let first = &simulation.frames[0];
    odometry.start_at(first, NavState { bias: Bias::ZERO, ..first.truth }, sigmas).unwrap();
    for frame in &simulation.frames[1..] {
        let out = odometry.push(frame.id, frame.time, &frame.observations).unwrap();
        assert!(matches!(out, StepOutput::Tracking(_)));
    }
    (odometry, simulation)
}

/// Directions that move the whole window: three shifts and a turn about the vertical, at the linearisation points.
fn free_directions(smoother: &Smoother, parts: &[Part], dim: usize) -> DMatrix<f64> {
    let mut n = DMatrix::zeros(dim, 4);
    let mut at = 0;
    let up = Vector3::z();
    for part in parts {
        if let Some(k) = part.frame() {
            let state = smoother.frames[k].linearised;
            match part {
                Part::Pose(_) => {
                    for axis in 0..3 {
                        n[(at + 3 + axis, axis)] = 1.0;
                    }
                    let turn = state.world_from_body.rotation.inverse() * up;
                    let shift = up.cross(&state.world_from_body.translation);
                    n.view_mut((at, 3), (3, 1)).copy_from(&turn);
                    n.view_mut((at + 3, 3), (3, 1)).copy_from(&shift);
                }
                Part::Motion(_) => n.view_mut((at, 3), (3, 1)).copy_from(&up.cross(&state.velocity)),
                _ => {}
            }
        }
        at += part.dim();
    }
    n
}

/// Scatter of stamps, ms, and shift of images, degrees.
const UNKNOWNS: [(f64, f64); 4] = [(0.0, 0.0), (4.0, 0.0), (0.0, 0.5), (4.0, 0.5)];

#[test]
fn shift_and_heading_stay_free_after_100_marginalisations() {
    for (stamp_scatter_ms, image_shift_deg) in UNKNOWNS {
        // Keyframes every second frame of 20 Hz.
        let (mut odometry, simulation) = flown(3, 11.5, |config, sigmas| {
            config.keyframe_every = 2;
            config.smoother.stamp_scatter_ms = stamp_scatter_ms;
            config.smoother.image_shift_deg = image_shift_deg;
            (sigmas.position_m, sigmas.yaw_rad) = (f64::INFINITY, f64::INFINITY);
        });
        let departures = simulation.frames.len() / 2 - 10;
        assert!(departures >= 100, "{departures} departures");
        let worst = worst_information(odometry.smoother().unwrap());
        assert!(worst < 1e-6, "|J N| / |J| = {worst:.2e}: {stamp_scatter_ms} ms, {image_shift_deg} degrees");
    }
}

/// Largest `|J N| / |J|` of the prior over the four free directions.
fn worst_information(smoother: &Smoother) -> f64 {
    let prior = &smoother.prior;
    assert!(prior.rows > 40, "{} rows", prior.rows);
    let root = DMatrix::from_row_slice(prior.rows, prior.dim, &prior.root);
    let n = free_directions(smoother, &prior.parts, prior.dim);
    let share = |k: usize| (&root * n.column(k).normalize()).norm() / root.norm();
    (0..4).map(share).fold(0.0, f64::max)
}

#[test]
fn first_estimates_keep_shift_and_heading_free_too() {
    let (mut odometry, _) = flown(3, 4.0, |config, sigmas| {
        config.keyframe_every = 2;
        config.smoother.linearisation = Linearisation::FirstEstimates;
        (sigmas.position_m, sigmas.yaw_rad) = (f64::INFINITY, f64::INFINITY);
    });
    assert!(worst_information(odometry.smoother().unwrap()) < 1e-6);
}

#[test]
fn at_present_states_alone_heading_seems_known() {
    let (mut odometry, _) = flown(3, 6.0, |config, sigmas| {
        config.keyframe_every = 2;
        config.smoother.linearisation = Linearisation::Present;
        (sigmas.position_m, sigmas.yaw_rad) = (f64::INFINITY, f64::INFINITY);
    });
    // The tests before this one can fail.
    let worst = worst_information(odometry.smoother().unwrap());
    assert!(worst > 1e-6, "{worst:.2e}");
}

/// Information and gradient over poses and motions, dense, in the order of the system.
fn dense(smoother: &mut Smoother) -> (DMatrix<f64>, DVector<f64>) {
    let mut system = System::default();
    smoother.linearise(&mut system, 0.0);
    let n = system.n;
    let h = DMatrix::from_fn(n, n, |i, j| if i >= j { system.h[i * n + j] } else { system.h[j * n + i] });
    (h, DVector::from_vec(system.gradient))
}

#[test]
fn the_prior_is_the_dense_marginal() {
    UNKNOWNS.into_iter().for_each(prior_is_the_dense_marginal);
}

fn prior_is_the_dense_marginal((stamp_scatter_ms, image_shift_deg): (f64, f64)) {
    let (mut odometry, _) = flown(5, 4.0, |config, _| {
        config.smoother.stamp_scatter_ms = stamp_scatter_ms;
        config.smoother.image_shift_deg = image_shift_deg;
    });
    let smoother = odometry.smoother().unwrap();
    // Only what leaves may speak, or both sides would have the rest in common: no landmarks of other hosts, and none
    // that lives on; robust weights stay as they are.
    let first = smoother.frames().next().unwrap();
    let elsewhere: Vec<LandmarkId> = smoother.landmarks().filter(|l| l.host != first).map(|l| l.id).collect();
    elsewhere.iter().for_each(|l| {
        smoother.remove_landmark(*l);
    });
    smoother.config.rehost_keyframes = 1;
    smoother.config.outlier_chi2 = 100.0;
    let keyframes: Vec<FrameId> = smoother.keyframes().collect();
    let frames: Vec<FrameId> = smoother.frames().collect();
    let hosted: Vec<LandmarkId> = smoother.landmarks().map(|l| l.id).collect();
    for l in &hosted {
        // Seen neither by frames that are no keyframes nor by the newest two: they all end.
        for f in frames.iter().filter(|f| !keyframes.contains(f) || frames[frames.len() - 2..].contains(f)) {
            smoother.remove_observation(*f, *l);
        }
    }
    for l in hosted.iter().step_by(2) {
        smoother.assume_distance(*l, 0.3, 0.5);
    }
    let mut marginalisation = MarginalisationReport::default();
    let (h, g) = dense(smoother);
    let (k, delay) = (smoother.len(), usize::from(stamp_scatter_ms > 0.0));
    let shift = 2 * usize::from(image_shift_deg > 0.0);
    // Motions, delays, shifts, poses.
    let first_columns = [(0, 9), (9 * k, delay), ((9 + delay) * k, shift), ((9 + delay + shift) * k, 6)];
    let leaving: Vec<usize> = first_columns.into_iter().flat_map(|(at, dim)| at..at + dim).collect();
    let staying: Vec<usize> = (0..h.nrows()).filter(|i| !leaving.contains(i)).collect();
    let pick = |r: &[usize], c: &[usize]| DMatrix::from_fn(r.len(), c.len(), |i, j| h[(r[i], c[j])]);
    let (mm, sm, ss) = (pick(&leaving, &leaving), pick(&staying, &leaving), pick(&staying, &staying));
    let inverse = mm.try_inverse().unwrap();
    let expected = &ss - &sm * &inverse * sm.transpose();
    let gm = DVector::from_fn(leaving.len(), |i, _| g[leaving[i]]);
    let gs = DVector::from_fn(staying.len(), |i, _| g[staying[i]]);
    let expected_gradient = gs - &sm * inverse * gm;

    smoother.marginalise(first, &mut marginalisation).unwrap();
    assert!(
        marginalisation.rehosted.is_empty()
            && marginalisation.ended.len() == hosted.len()
            && hosted.len() > 5
    );
    let (found, found_gradient) = dense(smoother);
    let scale = expected.amax();
    let error = (&found - &expected).amax() / scale;
    assert!(error < 1e-8, "information differs by {error:.2e}");
    let error = (&found_gradient - &expected_gradient).amax() / expected_gradient.amax().max(1.0);
    assert!(error < 1e-8 * scale / expected_gradient.amax().max(1.0), "gradient differs by {error:.2e}");
}

#[test]
fn the_gradient_is_the_slope_of_the_cost() {
    let (mut odometry, _) = flown(6, 1.5, |config, _| {
        config.smoother.huber_sigmas = 10.0;
        config.smoother.stamp_scatter_ms = 4.0;
        config.smoother.image_shift_deg = 0.5;
    });
    // No frame has left yet: all derivatives are at the present states, so gradient and cost belong together.
    let smoother = odometry.smoother().unwrap();
    assert!(smoother.prior.parts.is_empty());
    let all: Vec<LandmarkId> = smoother.landmarks().map(|l| l.id).collect();
    all.iter().for_each(|l| {
        smoother.remove_landmark(*l);
    });
    let mut random = Random::new(4);
    for frame in &mut smoother.frames {
        frame.image_shift.apply(&(Vector2::new(random.normal(), random.normal()) * 0.01));
    }
    let mut system = System::default();
    smoother.linearise(&mut system, 0.0);
    let direction: Vec<f64> = system.gradient.iter().map(|_| random.normal() * 1e-6).collect();
    let slope: f64 = direction.iter().zip(&system.gradient).map(|(d, g)| d * g).sum();
    let cost = |sign: f64| {
        let mut moved = smoother.clone();
        for (k, frame) in moved.frames.iter_mut().enumerate() {
            let [pose, delay] = [Part::Pose(k), Part::Delay(k)].map(|part| system.offset(part));
            frame.delay.apply(&Vector1::new(sign * direction[delay]));
            let shift = system.offset(Part::ImageShift(k));
            frame.image_shift.apply(&(Vector2::new(direction[shift], direction[shift + 1]) * sign));
            let pose = SVector::<f64, 6>::from_fn(|i, _| sign * direction[pose + i]);
            let motion = SVector::<f64, 9>::from_fn(|i, _| sign * direction[9 * k + i]);
            frame.apply(&pose, &motion);
        }
        moved.linearise(&mut System::default(), 0.0)
    };
    let numeric = 0.5 * (cost(1.0) - cost(-1.0));
    assert!((numeric - slope).abs() < 1e-3 * slope.abs().max(1e-9), "{numeric:.6e} {slope:.6e}");
}

/// Flies with a calibration that is off and lets it be estimated.
fn calibrated(off: &So3, offset_secs: f64, change: impl Fn(&mut SmootherConfig)) -> (Se3, f64, [f64; 7]) {
    let course = Course { kind: CourseKind::Eight, secs: 9.0, speed: 1.6, phase: 0.9 };
    let settings =
        SimulationConfig { seed: 5, tracks: 60, time_offset_secs: offset_secs, ..Default::default() };
    let simulation = Simulation::new(&course, 0.0, 8.0, &settings);
    let mut config = FeatureOdometryConfig::new(&ImuNoise::EUROC, 1.0);
    change(&mut config.smoother);
    let truth = simulation.body_from_camera;
    let is_valid_imu = Se3::new(truth.rotation * *off, truth.translation);
    let mut odometry = FeatureOdometry::new(config, simulation.camera.clone(), is_valid_imu);
    simulation.imu_samples.iter().for_each(|r| odometry.take(*r).unwrap());
    let sigmas = GaugePriorSigmas { velocity_mps: 0.2, tilt_rad: 0.02, ..GaugePriorSigmas::GAUGE };
    let first = &simulation.frames[0];
    odometry.start_at(first, NavState { bias: Bias::ZERO, ..first.truth }, sigmas).unwrap();
    for frame in &simulation.frames[1..] {
        odometry.push(frame.id, frame.time, &frame.observations).unwrap();
    }
    let smoother = odometry.smoother().unwrap();
    let sigmas = smoother.calibration_sigmas().unwrap();
    let place = *smoother.body_from_camera();
    (place, smoother.time_offset().as_secs_f64(), sigmas)
}

#[test]
fn a_camera_that_is_turned_by_two_degrees_is_found() {
    let off = So3::exp(&(Vector3::new(0.5, -0.6, 0.62).normalize() * 2.0_f64.to_radians()));
    let (place, _, sigmas) = calibrated(&off, 0.0, |config| {
        config.estimate_camera_rotation = true;
    });
    let left = (place.rotation.inverse() * Simulation::body_from_camera().rotation).angle_rad().to_degrees();
    assert!(left < 0.2, "{left:.3} deg left of 2");
    assert!(sigmas[0] < 0.2_f64.to_radians() && sigmas[0] > 0.0);
}

#[test]
fn a_clock_that_is_10_ms_off_is_found() {
    for offset in [-0.01, 0.01] {
        let (_, found, sigmas) = calibrated(&So3::IDENTITY, offset, |config| {
            config.estimate_time_offset = true;
        });
        assert!((found - offset).abs() < 1e-3, "{:.2} ms instead of {:.0}", found * 1e3, offset * 1e3);
        assert!(sigmas[6] < 5e-4, "{}", sigmas[6]);
    }
}

#[test]
fn dropping_a_frame_joins_its_imu_measurements() {
    let (mut odometry, simulation) = flown(7, 2.0, |_, _| {});
    let smoother = odometry.smoother().unwrap();
    let keyframes: Vec<FrameId> = smoother.keyframes().collect();
    let frames: Vec<FrameId> = smoother.frames().collect();
    let at = frames.iter().rposition(|f| !keyframes.contains(f) && Some(f) != frames.last()).unwrap();
    let before: f64 = smoother.frames[at].imu_factor.as_ref().unwrap().preintegration.secs();
    let after: f64 = smoother.frames[at + 1].imu_factor.as_ref().unwrap().preintegration.secs();
    let mut marginalisation = MarginalisationReport::default();
    smoother.drop_frame(frames[at], &mut marginalisation).unwrap();
    let joined = smoother.frames[at].imu_factor.as_ref().unwrap().preintegration.secs();
    assert!((joined - before - after).abs() < 1e-9, "{joined} {before} {after}");
    assert_eq!(smoother.len(), frames.len() - 1);
    let newest = smoother.newest().map(|(id, ..)| id);
    assert_eq!(newest, simulation.frames.last().map(|f| f.id));
}

#[test]
fn what_is_of_no_use_is_refused_in_words() {
    let (mut odometry, _) = flown(8, 1.0, |_, _| {});
    let smoother = odometry.smoother().unwrap();
    let (frame, time, state) = smoother.newest().map(|(id, t, s)| (id, t, *s)).unwrap();
    let seen = |landmark, covariance| Observation {
        frame,
        landmark: LandmarkId(landmark),
        pixel: Vector2::new(100.0, 100.0),
        covariance,
    };
    let bad = seen(90_000, Matrix2::new(1.0, 2.0, 2.0, 1.0));
    let told = smoother.add_landmark(&bad, 0.5).unwrap_err().to_string();
    assert!(told.contains("covariance of landmark 90000") && told.contains("[1 2; 2 1]"), "{told}");
    let good = seen(90_000, Matrix2::identity());
    assert_eq!(smoother.add_observation(&good), Err(SmootherError::NoSuchLandmark(LandmarkId(90_000))));
    smoother.add_landmark(&good, 0.5).unwrap();
    assert!(matches!(smoother.add_landmark(&good, 0.5), Err(SmootherError::Twice { .. })));
    assert!(matches!(smoother.add_observation(&good), Err(SmootherError::Twice { .. })));
    assert!(smoother.add_landmark(&seen(90_001, Matrix2::identity()), f64::NAN).is_err());
    assert!(matches!(
        smoother.add_frame(FrameId(9999), time, state, None),
        Err(SmootherError::NotNext { .. })
    ));
    let mut lost = state;
    lost.velocity.x = f64::NAN;
    assert_eq!(
        smoother.add_frame(FrameId(9999), time, lost, None),
        Err(SmootherError::BadState(FrameId(9999)))
    );
    assert!(SmootherConfig { huber_sigmas: f64::NAN, ..Default::default() }.validate().is_err());
    assert!(SmootherConfig::default().validate().is_ok());
}

#[test]
fn covariances_are_symmetric_and_positive() {
    let (mut odometry, _) = flown(9, 3.0, |_, _| {});
    let smoother = odometry.smoother().unwrap();
    let full: Matrix15 = smoother.covariance_of_newest().unwrap();
    assert!((full - full.transpose()).amax() < 1e-12 && full.cholesky().is_some());
    let keyframes: Vec<FrameId> = smoother.keyframes().collect();
    let [.., a, b] = keyframes[..] else { panic!("too few keyframes") };
    let relative = smoother.relative_covariance(a, b).unwrap();
    assert!(relative.cholesky().is_some());
    let absolute = smoother.pose_covariance(b).unwrap();
    assert!(relative.trace() < absolute.trace(), "neighbours know each other better than the origin");
    assert!(smoother.log_scale_sigma().unwrap() < 0.1);
}
