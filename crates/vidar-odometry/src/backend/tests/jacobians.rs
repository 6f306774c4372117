//! Residuals and their derivatives.

use crate::backend::image_shift::{BodyState, body_state, image_state, seen_by_turned};
use crate::backend::inertial::{
    Shift, body_velocity, by_ends, by_time_offset, gauge_prior_at, jacobians, residual,
};
use crate::backend::visual::{self, CameraPose};
use crate::backend::*;
use crate::imu::{Bias, ImuModel, Vector15};
use crate::simulate::{Course, CourseKind, Random, Simulation, SimulationConfig};
use nalgebra::{SMatrix, SVector, Vector1, Vector3};
use vidar_core::testing::check_jacobian;
use vidar_core::{ImuNoise, LieGroup, So3};

fn random_state(random: &mut Random) -> NavState {
    NavState {
        world_from_body: Se3::new(So3::exp(&(random.normal3() * 0.8)), random.normal3()),
        velocity: random.normal3(),
        bias: Bias { gyro: random.normal3() * 0.02, accel: random.normal3() * 0.1 },
    }
}

fn some_preintegration(bias: Bias) -> Preintegration {
    let course = Course { kind: CourseKind::Eight, secs: 3.0, speed: 2.0, phase: 0.2 };
    let simulation = Simulation::new(&course, 0.0, 2.0, &SimulationConfig::default());
    let model = ImuModel::from_data_sheet(&ImuNoise::EUROC, 2.0, 2.0);
    Preintegration::new(model, bias, &simulation.imu_samples[20..80])
}

fn pose_plus(state: &NavState, d: &SVector<f64, 6>) -> Se3 {
    let mut delta = Vector15::zeros();
    delta.fixed_rows_mut::<6>(0).copy_from(d);
    state.plus(&delta).world_from_body
}

#[test]
fn inertial_factor_agrees_with_numeric_derivatives() {
    let mut random = Random::new(11);
    for _ in 0..5 {
        let i = random_state(&mut random);
        let preintegration = some_preintegration(Bias { gyro: i.bias.gyro * 0.9, accel: i.bias.accel * 0.8 });
        let guess = Vector15::from_fn(|_, _| 0.1 * random.normal());
        let j = preintegration.predict(&i).plus(&guess);
        for shift in [Shift::NONE, Shift { begin: 4e-3, end: -7e-3 }, Shift { begin: -0.02, end: -0.02 }] {
            let (by_i, by_j) = jacobians(&preintegration, &i, &j, shift);
            let zero = Vector15::zeros();
            let of = |i: &NavState, j: &NavState| residual(&preintegration, i, j, shift);
            check_jacobian("by i", &by_i, |d| of(&i.plus(d), &j), &zero, 1e-6).unwrap();
            check_jacobian("by j", &by_j, |d| of(&i, &j.plus(d)), &zero, 1e-6).unwrap();
            let by_offset = by_time_offset(&preintegration, &i, &j, shift);
            let later = |d: &Vector1<f64>| {
                let shift = Shift { begin: shift.begin + d.x, end: shift.end + d.x };
                residual(&preintegration, &i, &j, shift)
            };
            check_jacobian("by clock", &by_offset, later, &Vector1::zeros(), 1e-6).unwrap();
            let [by_begin, by_end] = by_ends(&preintegration, &i, &j, shift);
            assert!((by_begin + by_end - by_offset).amax() < 1e-9 * by_end.amax());
            let begin = |d: &Vector1<f64>| {
                residual(&preintegration, &i, &j, Shift { begin: shift.begin + d.x, ..shift })
            };
            check_jacobian("by begin", &by_begin, begin, &Vector1::zeros(), 1e-6).unwrap();
            let end =
                |d: &Vector1<f64>| residual(&preintegration, &i, &j, Shift { end: shift.end + d.x, ..shift });
            check_jacobian("by end", &by_end, end, &Vector1::zeros(), 1e-6).unwrap();
        }
    }
}

#[test]
fn the_body_of_a_shifted_image_agrees_with_numeric_derivatives() {
    let mut random = Random::new(16);
    let place = Simulation::body_from_camera();
    for _ in 0..5 {
        let (image, other) = (random_state(&mut random), random_state(&mut random));
        let turn = Vector2::new(random.normal(), random.normal()) * 0.02;
        let body = BodyState::new(&image, &turn, &place);
        // The camera stays where it is.
        let camera = |s: &NavState| s.world_from_body.act(&place.translation);
        assert!((camera(&body.state) - camera(&image)).norm() < 1e-12);
        assert!(image_state(&body.state, &turn, &place).minus(&image).norm() < 1e-12);
        let preintegration = some_preintegration(other.bias);
        let of = |image: &NavState, turn: &Vector2<f64>| {
            residual(&preintegration, &body_state(image, turn, &place), &other, Shift::NONE)
        };
        let (by_body, _) = jacobians(&preintegration, &body.state, &other, Shift::NONE);
        let (by_image, by_shift) = body.through(&by_body);
        check_jacobian("by image", &by_image, |d| of(&image.plus(d), &turn), &Vector15::zeros(), 1e-6)
            .unwrap();
        check_jacobian("by shift", &by_shift, |d| of(&image, &(turn + d)), &Vector2::zeros(), 1e-6).unwrap();
    }
}

#[test]
fn a_turned_camera_shows_what_a_shifted_lens_does() {
    let camera = Simulation::camera();
    let lens = *camera.intrinsics();
    let turn = Vector2::new(0.008, -0.011);
    for ray in [Vector3::new(0.0, 0.0, 1.0), Vector3::new(0.4, -0.2, 1.0), Vector3::new(-0.5, 0.3, 1.0)] {
        let shifted = camera.project(&ray).unwrap() + Vector2::new(-lens.fx * turn.y, lens.fy * turn.x);
        let turned = So3::exp(&-Vector3::new(turn.x, turn.y, 0.0)) * ray;
        let seen = seen_by_turned(&camera, &shifted, &turn).unwrap();
        assert!((seen - camera.project(&turned).unwrap()).norm() < 1e-9, "{ray}");
        // What is left of it is of second order.
        assert!((seen - shifted).norm() < 0.5 * lens.fx * turn.norm(), "{ray}");
    }
}

#[test]
fn shifted_measurements_are_those_of_the_shifted_stretch() {
    let course = Course { kind: CourseKind::Eight, secs: 3.0, speed: 1.2, phase: 0.2 };
    let settings = SimulationConfig { noise_scale: 0.0, imu_rate_hz: 1000.0, ..Default::default() };
    let simulation = Simulation::new(&course, 0.0, 2.0, &settings);
    let model = ImuModel::from_data_sheet(&ImuNoise::EUROC, 2.0, 2.0);
    let state = |k: usize| simulation.frames[0].truth.plus(&Vector15::from_element(k as f64 * 0.01));
    let (i, j) = (state(1), state(7));
    let cut = |bias: Bias, from: usize, until: usize| {
        Preintegration::new(model, bias, &simulation.imu_samples[from..=until])
    };
    // Later by so many milliseconds at one end and at the other; how much of the difference is left.
    let left = |bias: Bias, begin: usize, end: usize| {
        let shift = Shift { begin: 1e-3 * begin as f64, end: 1e-3 * end as f64 };
        let exact = residual(&cut(bias, 100 + begin, 300 + end), &i, &j, Shift::NONE);
        let shifted = residual(&cut(bias, 100, 300), &i, &j, shift);
        let not_at_all = residual(&cut(bias, 100, 300), &i, &j, Shift::NONE);
        ((shifted - exact).amax(), (not_at_all - exact).amax())
    };
    // The shift holds the rates of one sample: what they change by meanwhile is of second order.
    let lefts = [(8, 4), (4, 2), (2, 1)].map(|(begin, end)| left(i.bias, begin, end));
    assert!(lefts[0].0 < 0.1 * lefts[0].1, "{lefts:?}");
    assert!(lefts.windows(2).all(|w| w[1].0 < 0.3 * w[0].0), "a quarter per halving: {lefts:?}");
    // Its rates are those at the bias of the integration; a bias that moved since by 0.01 rad/s and 0.01 m/s² leaves a
    // part of first order, and IMU measurements are integrated anew long before.
    let (moved, before) = left(Bias::ZERO, 2, 1);
    assert!(moved < lefts[2].0 + 0.05 * before, "{moved:.2e} of {before:.2e}");
}

#[test]
fn inertial_residual_vanishes_on_its_own_prediction() {
    let i = random_state(&mut Random::new(12));
    let preintegration = some_preintegration(i.bias);
    assert!(residual(&preintegration, &i, &preintegration.predict(&i), Shift::NONE).amax() < 1e-12);
}

#[test]
fn anchor_and_standstill_agree_with_numeric_derivatives() {
    let mut random = Random::new(13);
    let sigmas = GaugePriorSigmas {
        position_m: 0.5,
        yaw_rad: 0.4,
        tilt_rad: 0.3,
        velocity_mps: 0.7,
        gyro_bias: 0.9,
        accel_bias: 1.3,
    };
    let reference = random_state(&mut random);
    let state = reference.plus(&Vector15::from_fn(|_, _| 0.2 * random.normal()));
    let zero = Vector15::zeros();
    let (_, j) = gauge_prior_at(&reference, &sigmas, &state, &state);
    let f = |d: &Vector15| gauge_prior_at(&reference, &sigmas, &state.plus(d), &state).0;
    check_jacobian("anchor", &j, f, &zero, 1e-6).unwrap();
    let (_, by_rotation, by_velocity) = body_velocity(&state);
    let mut analytic = SMatrix::<f64, 3, 15>::zeros();
    analytic.fixed_view_mut::<3, 3>(0, 0).copy_from(&by_rotation);
    analytic.fixed_view_mut::<3, 3>(0, 6).copy_from(&by_velocity);
    check_jacobian("standstill", &analytic, |d| body_velocity(&state.plus(d)).0, &zero, 1e-6).unwrap();
}

struct View {
    host: NavState,
    target: NavState,
    place: Se3,
    bearing: Vector3<f64>,
    rho: f64,
}

fn some_view(random: &mut Random) -> View {
    let host = random_state(random);
    let small = Vector15::from_fn(|_, _| 0.1 * random.normal());
    let bearing = Vector3::new(0.2 * random.normal(), 0.2 * random.normal(), 1.0).normalize();
    View { target: host.plus(&small), host, place: Simulation::body_from_camera(), bearing, rho: 0.3 }
}

#[test]
fn reprojection_agrees_with_numeric_derivatives() {
    let mut random = Random::new(14);
    let camera = Simulation::camera();
    for _ in 0..8 {
        let View { host, target, place, bearing, rho } = some_view(&mut random);
        let pixel = |h: &Se3, t: &Se3, place: &Se3, bearing: &Vector3<f64>, rho: f64| {
            let (h, t) = (CameraPose::new(h, place), CameraPose::new(t, place));
            camera.project(&visual::direction(&h, &t, bearing, rho)).unwrap()
        };
        let (h, t) = (host.world_from_body, target.world_from_body);
        let (at_h, at_t) = (CameraPose::new(&h, &place), CameraPose::new(&t, &place));
        let j = visual::jacobians(&camera, &at_h, &at_t, &bearing, rho).unwrap();
        let zero = SVector::<f64, 6>::zeros();
        let by_host = |d: &SVector<f64, 6>| pixel(&pose_plus(&host, d), &t, &place, &bearing, rho);
        check_jacobian("host", &j.by_host, by_host, &zero, 1e-6).unwrap();
        let by_target = |d: &SVector<f64, 6>| pixel(&h, &pose_plus(&target, d), &place, &bearing, rho);
        check_jacobian("target", &j.by_target, by_target, &zero, 1e-6).unwrap();
        let by_landmark = |d: &Vector3<f64>| {
            pixel(&h, &t, &place, &bearing_plus(&bearing, &Vector2::new(d.x, d.y)), rho + d.z)
        };
        check_jacobian("landmark", &j.by_landmark, by_landmark, &Vector3::zeros(), 1e-6).unwrap();
        let by_place = visual::by_body_from_camera(&camera, &at_h, &at_t, &bearing, rho).unwrap();
        let moved = |d: &SVector<f64, 6>| {
            let turn = So3::exp(&d.fixed_rows::<3>(0).into_owned());
            let place = Se3::new(place.rotation * turn, place.translation + d.fixed_rows::<3>(3));
            pixel(&h, &t, &place, &bearing, rho)
        };
        check_jacobian("camera's place", &by_place, moved, &zero, 1e-6).unwrap();
    }
}

#[test]
fn relative_pose_agrees_with_numeric_derivatives() {
    let mut random = Random::new(15);
    let (a, b) = (random_state(&mut random), random_state(&mut random));
    let here = a.world_from_body.inverse() * b.world_from_body;
    let f = |d: &SVector<f64, 12>| {
        let a = pose_plus(&a, &d.fixed_rows::<6>(0).into_owned());
        let b = pose_plus(&b, &d.fixed_rows::<6>(6).into_owned());
        (a.inverse() * b).minus(&here)
    };
    let j = d_relative_d_poses(&a.world_from_body, &b.world_from_body);
    check_jacobian("relative pose", &j, f, &SVector::zeros(), 1e-6).unwrap();
}
