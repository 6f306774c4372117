//! Preintegration and propagation against Runge-Kutta and numeric derivatives.

use super::preintegration::Delta;
use super::*;
use crate::simulate::{Course, CourseKind, Flight, Random};
use nalgebra::{SMatrix, SVector};
use vidar_core::testing::check_jacobian;
use vidar_core::{AngularRate, Duration, GRAVITY_MPS2, ImuNoise, ImuSample, SpecificForce, Timestamp};

const COURSE: Course = Course { kind: CourseKind::Eight, secs: 30.0, speed: 2.5, phase: 0.7 };

fn model() -> ImuModel {
    ImuModel::from_data_sheet(&ImuNoise::EUROC, 2.0, 2.0)
}

fn sample(flight: &impl Flight, secs: f64, bias: &Bias) -> ImuSample {
    let m = flight.motion(secs);
    let up = Vector3::new(0.0, 0.0, GRAVITY_MPS2);
    ImuSample {
        time: Timestamp::from_nanos((secs * 1e9).round() as i64),
        gyro: AngularRate(m.angular_rate + bias.gyro),
        accel: SpecificForce(m.world_from_body.rotation.inverse() * (m.acceleration + up) + bias.accel),
    }
}

fn imu_samples(from: f64, until: f64, rate: f64, bias: &Bias) -> Vec<ImuSample> {
    let n = ((until - from) * rate).round() as usize;
    (0..=n).map(|k| sample(&COURSE, from + k as f64 / rate, bias)).collect()
}

fn bias() -> Bias {
    Bias { gyro: Vector3::new(0.02, -0.03, 0.01), accel: Vector3::new(0.1, 0.05, -0.2) }
}

/// Rotation, velocity and position relative to the start by classical Runge-Kutta of `ẋ = f(t, x)` at 10 kHz on the
/// exact rates.
fn runge_kutta(from: f64, until: f64) -> (So3, Vector3<f64>, Vector3<f64>) {
    let h = 1e-4;
    let n = ((until - from) / h).round() as usize;
    let none = Bias::ZERO;
    let at = |t: f64| {
        let r = sample(&COURSE, t, &none);
        // The clock of IMU measurements is in whole nanoseconds; the rates are exact.
        (r.gyro.0, r.accel.0)
    };
    let quaternion_rate =
        |q: &nalgebra::Quaternion<f64>, w: &Vector3<f64>| q * nalgebra::Quaternion::from_imag(*w) * 0.5;
    let turn =
        |q: &nalgebra::Quaternion<f64>, v: &Vector3<f64>| nalgebra::UnitQuaternion::from_quaternion(*q) * v;
    let (mut q, mut v, mut p) = (nalgebra::Quaternion::identity(), Vector3::zeros(), Vector3::zeros());
    for k in 0..n {
        let t = from + k as f64 * h;
        let (w0, f0) = at(t);
        let (wm, fm) = at(t + 0.5 * h);
        let (w1, f1) = at(t + h);
        let k1 = (quaternion_rate(&q, &w0), turn(&q, &f0), v);
        let (q2, v2) = (q + k1.0 * (0.5 * h), v + k1.1 * (0.5 * h));
        let k2 = (quaternion_rate(&q2, &wm), turn(&q2, &fm), v2);
        let (q3, v3) = (q + k2.0 * (0.5 * h), v + k2.1 * (0.5 * h));
        let k3 = (quaternion_rate(&q3, &wm), turn(&q3, &fm), v3);
        let (q4, v4) = (q + k3.0 * h, v + k3.1 * h);
        let k4 = (quaternion_rate(&q4, &w1), turn(&q4, &f1), v4);
        q += (k1.0 + k2.0 * 2.0 + k3.0 * 2.0 + k4.0) * (h / 6.0);
        v += (k1.1 + k2.1 * 2.0 + k3.1 * 2.0 + k4.1) * (h / 6.0);
        p += (k1.2 + k2.2 * 2.0 + k3.2 * 2.0 + k4.2) * (h / 6.0);
        q = q.normalize();
    }
    (So3::from_quaternion(q.i, q.j, q.k, q.w).unwrap(), p, v)
}

#[test]
fn preintegration_agrees_with_runge_kutta_at_10_khz() {
    // What is left is that IMU measurements are not linear between samples: second order in their distance. Over half a second
    // of a 2.5 m/s flight; the noise of EuRoC's IMU alone is 1.2e-4 rad and 1.4e-3 m/s.
    for rate in [100.0, 200.0, 1000.0] {
        let (rad, m, mps) = (0.5 / (rate * rate), 0.5 / (rate * rate), 2.0 / (rate * rate));
        for from in [0.4, 3.0, 7.7] {
            let (rotation, position, velocity) = runge_kutta(from, from + 0.5);
            let found = Preintegration::new(model(), bias(), &imu_samples(from, from + 0.5, rate, &bias()));
            let (r, p, v) = found.corrected(&bias());
            let turned = (rotation.inverse() * r).angle_rad();
            assert!(turned < rad, "{rate} Hz from {from}: rotation off by {turned:.2e} rad");
            assert!((p - position).norm() < m, "{rate} Hz from {from}: {:.2e} m", (p - position).norm());
            assert!((v - velocity).norm() < mps, "{rate} Hz from {from}: {:.2e} m/s", (v - velocity).norm());
        }
    }
}

#[test]
fn prediction_arrives_where_the_flight_does() {
    let (from, until) = (2.0, 2.4);
    let state = |t: f64| {
        let m = COURSE.motion(t);
        NavState { world_from_body: m.world_from_body, velocity: m.velocity, bias: bias() }
    };
    let found = Preintegration::new(model(), bias(), &imu_samples(from, until, 1000.0, &bias()));
    let error = found.predict(&state(from)).minus(&state(until));
    assert!(error.amax() < 1e-6, "{error}");
}

fn delta_of(samples: &[ImuSample], b: &SVector<f64, 6>) -> Delta {
    let part = |k: usize| Vector3::new(b[k], b[k + 1], b[k + 2]);
    Preintegration::new(model(), Bias { gyro: part(0), accel: part(3) }, samples).delta
}

#[test]
fn derivatives_by_biases_agree_with_numeric_ones() {
    let samples = imu_samples(1.0, 1.5, 200.0, &bias());
    let at = SVector::<f64, 6>::from([0.01, 0.02, -0.01, 0.2, -0.1, 0.05]);
    let here = delta_of(&samples, &at);
    let mut analytic = SMatrix::<f64, 9, 6>::zeros();
    analytic.fixed_columns_mut::<3>(0).copy_from(&here.by_gyro_bias);
    analytic.fixed_columns_mut::<3>(3).copy_from(&here.by_accel_bias);
    let f = |b: &SVector<f64, 6>| {
        let there = delta_of(&samples, b);
        let mut out = SVector::<f64, 9>::zeros();
        out.fixed_rows_mut::<3>(0).copy_from(&(here.rotation.inverse() * there.rotation).log());
        out.fixed_rows_mut::<3>(3).copy_from(&there.position);
        out.fixed_rows_mut::<3>(6).copy_from(&there.velocity);
        out
    };
    check_jacobian("preintegration by biases", &analytic, f, &at, 1e-6).unwrap();
}

#[test]
fn covariance_of_motion_is_what_noisy_measurements_scatter() {
    let model = model();
    let clean = imu_samples(0.5, 0.8, 200.0, &Bias::ZERO);
    let exact = Preintegration::new(model, Bias::ZERO, &clean);
    let mut random = Random::new(3);
    let runs = 3000;
    let mut sum = SMatrix::<f64, 9, 9>::zeros();
    for _ in 0..runs {
        let noisy: Vec<ImuSample> = clean
            .iter()
            .map(|s| ImuSample {
                time: s.time,
                gyro: AngularRate(
                    s.gyro.0 + random.normal3() * (model.noise.gyro_density * 200.0_f64.sqrt()),
                ),
                accel: SpecificForce(
                    s.accel.0 + random.normal3() * (model.noise.accel_density * 200.0_f64.sqrt()),
                ),
            })
            .collect();
        let found = Preintegration::new(model, Bias::ZERO, &noisy).delta;
        let mut e = SVector::<f64, 9>::zeros();
        e.fixed_rows_mut::<3>(0).copy_from(&(exact.delta.rotation.inverse() * found.rotation).log());
        e.fixed_rows_mut::<3>(3).copy_from(&(found.position - exact.delta.position));
        e.fixed_rows_mut::<3>(6).copy_from(&(found.velocity - exact.delta.velocity));
        sum += e * e.transpose() / f64::from(runs);
    }
    for k in 0..9 {
        let ratio = (sum[(k, k)] / exact.delta.covariance[(k, k)]).sqrt();
        assert!((0.93..1.07).contains(&ratio), "component {k}: scatter {ratio:.3} of the stated σ");
    }
}

#[test]
fn one_step_has_the_covariance_of_white_noise_integrated_twice() {
    let at_rest = |nanos| ImuSample {
        time: Timestamp::from_nanos(nanos),
        gyro: AngularRate(Vector3::zeros()),
        accel: SpecificForce(Vector3::zeros()),
    };
    let model = model();
    let (h, variance) = (0.005_f64, model.noise.accel_density.powi(2));
    let found = Preintegration::new(model, Bias::ZERO, &[at_rest(0), at_rest(5_000_000)]).covariance();
    for axis in 0..3 {
        let (position, velocity) = (3 + axis, 6 + axis);
        for (row, column, expected) in [
            (position, position, variance * h.powi(3) / 3.0),
            (position, velocity, variance * h.powi(2) / 2.0),
            (velocity, velocity, variance * h),
        ] {
            assert!((found[(row, column)] / expected - 1.0).abs() < 1e-9, "({row}, {column})");
        }
    }
    assert!(found.cholesky().is_some());
}

#[test]
fn two_stretches_joined_are_the_whole() {
    let samples = imu_samples(1.0, 1.6, 200.0, &bias());
    let whole = Preintegration::new(model(), Bias::ZERO, &samples);
    let mut joined = Preintegration::new(model(), Bias::ZERO, &samples[..60]);
    // The second stretch was integrated at other biases and is read again.
    joined.append(&Preintegration::new(model(), bias(), &samples[59..]));
    assert!((joined.delta.position - whole.delta.position).norm() < 1e-12);
    assert!((joined.delta.covariance - whole.delta.covariance).amax() < 1e-15);
    assert_eq!(joined.samples(), whole.samples());
    assert!((joined.secs() - 0.6).abs() < 1e-9);
}

#[test]
fn gains_of_both_sensors_act_as_their_derivatives_say() {
    let samples = imu_samples(1.0, 1.6, 200.0, &bias());
    let plain = Preintegration::new(model(), Bias::ZERO, &samples);
    let step = 1e-5;
    for axis in 0..6 {
        // A measurement that is larger by a share of itself is one whose bias is lower by as much.
        let scaled: Vec<ImuSample> = samples
            .iter()
            .map(|s| {
                let (mut gyro, mut accel) = (s.gyro.0, s.accel.0);
                let measured = if axis < 3 { &mut gyro[axis] } else { &mut accel[axis - 3] };
                *measured *= 1.0 + step;
                ImuSample { time: s.time, gyro: AngularRate(gyro), accel: SpecificForce(accel) }
            })
            .collect();
        let moved = Preintegration::new(model(), Bias::ZERO, &scaled).delta;
        let mut numeric = SVector::<f64, 9>::zeros();
        numeric.fixed_rows_mut::<3>(0).copy_from(&(plain.delta.rotation.inverse() * moved.rotation).log());
        numeric.fixed_rows_mut::<3>(3).copy_from(&(moved.position - plain.delta.position));
        numeric.fixed_rows_mut::<3>(6).copy_from(&(moved.velocity - plain.delta.velocity));
        let error = (numeric / step - plain.by_gain().column(axis)).amax();
        assert!(error < 2e-3, "axis {axis}: {error:.1e}");
    }
}

#[test]
fn an_uncertain_gain_widens_the_covariance_by_the_square_of_time() {
    let samples = imu_samples(1.0, 1.6, 200.0, &bias());
    let (short, long) = (&samples[..41], &samples[..81]);
    let added = |samples: &[ImuSample]| {
        let sure = Preintegration::new(model(), Bias::ZERO, samples).covariance();
        let unsure = Preintegration::new(model().with_gyro_gain_std(0.01), Bias::ZERO, samples);
        let turned = unsure.rotation(&Bias::ZERO).log().norm();
        let added = unsure.covariance() - sure;
        (added.fixed_view::<3, 3>(0, 0).trace().sqrt() / turned, added.amax())
    };
    // Gains of the three axes are independent, so that turning about one axis by an angle leaves 1 % of it.
    for samples in [short, long] {
        let (share, _) = added(samples);
        assert!((0.009..0.011).contains(&share), "{share}");
    }
    assert!(added(long).1 > 3.0 * added(short).1);
}

#[test]
fn a_bias_that_moved_far_is_integrated_again_and_a_near_one_is_not() {
    let samples = imu_samples(1.0, 1.6, 200.0, &bias());
    let mut found = Preintegration::new(model(), Bias::ZERO, &samples);
    let near = Bias { gyro: Vector3::new(1e-4, 0.0, 0.0), accel: Vector3::new(1e-3, 0.0, 0.0) };
    assert!(!found.follow(&near) && found.bias() == &Bias::ZERO);
    assert!(found.follow(&bias()) && found.bias() == &bias());
    let exact = Preintegration::new(model(), bias(), &samples);
    assert_eq!(found.delta, exact.delta);
}

#[test]
fn transition_agrees_with_numeric_derivatives() {
    let samples = imu_samples(1.0, 1.3, 200.0, &bias());
    let found = Preintegration::new(model(), Bias::ZERO, &samples);
    let m = COURSE.motion(1.0);
    let small = Bias { gyro: Vector3::new(2e-3, 1e-3, -1e-3), accel: Vector3::new(0.01, 0.0, 0.02) };
    let state = NavState { world_from_body: m.world_from_body, velocity: m.velocity, bias: small };
    let end = found.predict(&state);
    let f = |d: &Vector15| found.predict(&state.plus(d)).minus(&end);
    check_jacobian("transition", &propagate::d_end_d_start(&state, &found), f, &Vector15::zeros(), 1e-6)
        .unwrap();
}

#[test]
fn propagated_covariance_grows_and_stays_symmetric() {
    let samples = imu_samples(1.0, 1.5, 200.0, &bias());
    let found = Preintegration::new(model(), bias(), &samples);
    let m = COURSE.motion(1.0);
    let state = NavState { world_from_body: m.world_from_body, velocity: m.velocity, bias: bias() };
    let start = Matrix15::identity() * 1e-6;
    let end = propagate(&state, &start, &found);
    assert_eq!(end.covariance, end.covariance.transpose());
    assert!(end.covariance.cholesky().is_some());
    assert!((0..15).all(|k| end.covariance[(k, k)] >= 0.999e-6));
    assert!(end.covariance[(3, 3)] > 1.2e-6, "position inherits from velocity");
}

#[test]
fn a_gap_and_a_saturated_sample_inflate_the_noise() {
    let mut samples = imu_samples(1.0, 1.5, 200.0, &Bias::ZERO);
    let plain = Preintegration::new(model(), Bias::ZERO, &samples).delta.covariance;
    let mut clipped = samples.clone();
    clipped[40].gyro.0.x = 17.5;
    let saturated = Preintegration::new(model(), Bias::ZERO, &clipped).delta.covariance;
    samples.drain(30..50);
    let gapped = Preintegration::new(model(), Bias::ZERO, &samples).delta.covariance;
    assert!(gapped[(0, 0)] > 100.0 * plain[(0, 0)] && saturated[(0, 0)] > 100.0 * plain[(0, 0)]);
}

/// A gyroscope that reads its limit for 60 ms: the rate around stands in, and the motion is told to a tenth of what its covariance says.
#[test]
fn a_clipped_gyroscope_does_not_turn_what_the_accelerometer_feels() {
    let samples = imu_samples(1.0, 1.5, 200.0, &Bias::ZERO);
    let clean = Preintegration::new(model(), Bias::ZERO, &samples).delta;
    let mut clipped = samples;
    clipped[40..52].iter_mut().for_each(|s| s.gyro.0 = Vector3::new(17.5, -17.5, 17.5));
    let found = Preintegration::new(model(), Bias::ZERO, &clipped).delta;
    let turned = (clean.rotation.inverse() * found.rotation).log().norm();
    assert!(turned < 0.1, "{turned} rad");
    let off = found.velocity - clean.velocity;
    let sigma = found.covariance.fixed_view::<3, 3>(6, 6).trace().sqrt();
    assert!(off.norm() < 0.1 * sigma, "velocity off by {} m/s at {sigma}", off.norm());
    assert!(sigma > 0.5, "what was clipped is hardly known: {sigma} m/s");
}

#[test]
fn the_buffer_cuts_between_samples_and_tells_gaps() {
    let mut buffer = ImuBuffer::new(200.0);
    let all = imu_samples(0.0, 1.0, 200.0, &Bias::ZERO);
    for (k, s) in all.iter().enumerate().filter(|(k, _)| !(100..130).contains(k)) {
        buffer.push(*s).unwrap_or_else(|e| panic!("sample {k}: {e}"));
    }
    let ns = Timestamp::from_nanos;
    let mut cut = Vec::new();
    let gap = buffer.interval(ns(102_000_000), ns(148_000_000), &mut cut).unwrap();
    assert_eq!((gap, cut.len()), (None, 11));
    assert_eq!((cut[0].time, cut[10].time), (ns(102_000_000), ns(148_000_000)));
    let expected = all[20].gyro.0.lerp(&all[21].gyro.0, 0.4);
    assert!((cut[0].gyro.0 - expected).norm() < 1e-12);
    let gap = buffer.interval(ns(520_000_000), ns(600_000_000), &mut cut).unwrap().unwrap();
    assert_eq!((gap.after, gap.length), (ns(495_000_000), Duration::from_millis(155)));
    assert!(matches!(
        buffer.interval(ns(0), ns(2_000_000_000), &mut cut),
        Err(BufferError::NotCovered { .. })
    ));
    assert!(matches!(buffer.interval(ns(5), ns(5), &mut cut), Err(BufferError::NotCovered { .. })));
    assert!(matches!(buffer.push(all[3]), Err(BufferError::NotIncreasing { .. })));
    let mut broken = all[200];
    broken.accel.0.y = f64::NAN;
    broken.time = ns(3_000_000_000);
    assert!(matches!(buffer.push(broken), Err(BufferError::NotFinite { .. })));
    buffer.forget_before(ns(402_000_000));
    assert_eq!(buffer.iter().next().map(|s| s.time), Some(ns(400_000_000)));
}

#[test]
fn states_move_and_differ_consistently() {
    let mut random = Random::new(8);
    for _ in 0..20 {
        let m = COURSE.motion(random.between(0.0, 20.0));
        let state = NavState { world_from_body: m.world_from_body, velocity: m.velocity, bias: bias() };
        let delta = Vector15::from_fn(|_, _| 0.3 * random.normal());
        assert!((state.plus(&delta).minus(&state) - delta).amax() < 1e-12);
    }
}
