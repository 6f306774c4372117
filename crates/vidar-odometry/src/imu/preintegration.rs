//! Preintegrated motion between two instants, with bias derivatives and covariance.
//!
//! IMU measurements are taken as linear between samples. One step of length `h` turns by the fourth-order Magnus expansion of a
//! linear rate (`φ = ½(ω₀+ω₁)h + h²/12 ω₀×ω₁`, on each half step), and integrates the rotated specific force by
//! Simpson's rule: fourth order, where the usual mid-point rule is second. Steps and longer stretches are joined by one
//! rule ([`Delta::then`]), which also joins their derivatives and covariances.

use super::{Bias, ImuModel, NavState, hat};
use nalgebra::{Matrix3, SMatrix, Vector3};
use std::borrow::Cow;
use vidar_core::{ImuSample, LieGroup, Se3, So3};

/// 9×9 in the order rotation, position, velocity.
pub(crate) type Matrix9 = SMatrix<f64, 9, 9>;
/// Derivative of rotation, position, velocity by one bias.
pub(crate) type ByBias = SMatrix<f64, 9, 3>;

/// Motion relative to its first instant, gravity left out.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Delta {
    pub(crate) secs: f64,
    pub(crate) rotation: So3,
    pub(crate) position: Vector3<f64>,
    pub(crate) velocity: Vector3<f64>,
    pub(crate) by_gyro_bias: ByBias,
    pub(crate) by_accel_bias: ByBias,
    /// By the gain of each axis of the gyroscope: over a step a gain acts as a bias of minus the measurement.
    pub(crate) by_gyro_gain: ByBias,
    /// Of white noise.
    pub(crate) covariance: Matrix9,
}

impl Delta {
    pub(crate) const fn none() -> Self {
        Self {
            secs: 0.0,
            rotation: So3::IDENTITY,
            position: Vector3::new(0.0, 0.0, 0.0),
            velocity: Vector3::new(0.0, 0.0, 0.0),
            by_gyro_bias: ByBias::from_array_storage(nalgebra::ArrayStorage([[0.0; 9]; 3])),
            by_accel_bias: ByBias::from_array_storage(nalgebra::ArrayStorage([[0.0; 9]; 3])),
            by_gyro_gain: ByBias::from_array_storage(nalgebra::ArrayStorage([[0.0; 9]; 3])),
            covariance: Matrix9::from_array_storage(nalgebra::ArrayStorage([[0.0; 9]; 9])),
        }
    }

    /// One step between neighbouring IMU measurements.
    fn step(a: &ImuSample, b: &ImuSample, bias: &Bias, [gyro_variance, accel_variance]: [f64; 2]) -> Self {
        let secs = (b.time - a.time).as_secs_f64();
        let (w0, w1) = (a.gyro.0 - bias.gyro, b.gyro.0 - bias.gyro);
        let (f0, f1) = (a.accel.0 - bias.accel, b.accel.0 - bias.accel);
        let (wm, fm) = ((w0 + w1) * 0.5, (f0 + f1) * 0.5);
        let half = 0.5 * secs;
        let (phi1, d_phi1) = magnus(&w0, &wm, half);
        let (phi2, d_phi2) = magnus(&wm, &w1, half);
        let (to_mid, mid_to_end) = (So3::exp(&phi1), So3::exp(&phi2));
        let end = to_mid * mid_to_end;
        let (r_mid, r_end) = (to_mid.matrix(), end.matrix());
        let mid_by_gyro = So3::right_jacobian(&phi1) * d_phi1;
        let end_by_gyro = mid_to_end.matrix().transpose() * mid_by_gyro + So3::right_jacobian(&phi2) * d_phi2;
        let (force_mid, force_end) = (r_mid * fm, r_end * f1);
        let (mid_force_by_gyro, end_force_by_gyro) =
            (-(r_mid * hat(&fm)) * mid_by_gyro, -(r_end * hat(&f1)) * end_by_gyro);
        let (c1, c2) = (secs / 6.0, secs * secs / 6.0);
        let mut by_gyro_bias = ByBias::zeros();
        by_gyro_bias.fixed_view_mut::<3, 3>(0, 0).copy_from(&end_by_gyro);
        by_gyro_bias.fixed_view_mut::<3, 3>(3, 0).copy_from(&(mid_force_by_gyro * (2.0 * c2)));
        by_gyro_bias
            .fixed_view_mut::<3, 3>(6, 0)
            .copy_from(&((mid_force_by_gyro * 4.0 + end_force_by_gyro) * c1));
        let mut by_accel_bias = ByBias::zeros();
        let identity = Matrix3::identity();
        by_accel_bias.fixed_view_mut::<3, 3>(3, 0).copy_from(&((identity + r_mid * 2.0) * -c2));
        by_accel_bias.fixed_view_mut::<3, 3>(6, 0).copy_from(&((identity + r_mid * 4.0 + r_end) * -c1));
        let mut by_gyro_gain = by_gyro_bias;
        for (k, mut column) in by_gyro_gain.column_iter_mut().enumerate() {
            column *= -0.5 * (a.gyro.0[k] + b.gyro.0[k]);
        }
        // White noise of density σ, averaged over the step, acts as a bias of variance σ²/h. Its course within the step adds
        // σ² h³ / 12 to the position's variance (σ² h³ / 3 in all). Without it a stretch of one step, as within a gap of the IMU,
        // has a singular covariance, and holds position to velocity as if it knew how the force went.
        let mut covariance = by_gyro_bias * by_gyro_bias.transpose() * gyro_variance
            + by_accel_bias * by_accel_bias.transpose() * accel_variance;
        for k in 3..6 {
            covariance[(k, k)] += accel_variance * secs.powi(4) / 12.0;
        }
        Self {
            secs,
            rotation: end,
            position: (f0 + force_mid * 2.0) * c2,
            velocity: (f0 + force_mid * 4.0 + force_end) * c1,
            by_gyro_bias,
            by_accel_bias,
            by_gyro_gain,
            covariance,
        }
    }

    /// This motion followed by `next`; both linearised at the same biases.
    pub(crate) fn then(&self, next: &Self) -> Self {
        let (f, g) = self.by_parts(next);
        let turn = self.rotation.matrix();
        let covariance = f * self.covariance * f.transpose() + g * next.covariance * g.transpose();
        Self {
            secs: self.secs + next.secs,
            rotation: self.rotation * next.rotation,
            position: self.position + self.velocity * next.secs + turn * next.position,
            velocity: self.velocity + turn * next.velocity,
            by_gyro_bias: f * self.by_gyro_bias + g * next.by_gyro_bias,
            by_accel_bias: f * self.by_accel_bias + g * next.by_accel_bias,
            by_gyro_gain: f * self.by_gyro_gain + g * next.by_gyro_gain,
            covariance: (covariance + covariance.transpose()) * 0.5,
        }
    }

    /// Derivatives of [`Delta::then`] by this motion and by `next`.
    fn by_parts(&self, next: &Self) -> (Matrix9, Matrix9) {
        let turn = self.rotation.matrix();
        let mut f = Matrix9::identity();
        f.fixed_view_mut::<3, 3>(0, 0).copy_from(&next.rotation.matrix().transpose());
        f.fixed_view_mut::<3, 3>(3, 0).copy_from(&(-(turn * hat(&next.position))));
        f.fixed_view_mut::<3, 3>(3, 6).copy_from(&(Matrix3::identity() * next.secs));
        f.fixed_view_mut::<3, 3>(6, 0).copy_from(&(-(turn * hat(&next.velocity))));
        let mut g = Matrix9::zeros();
        g.fixed_view_mut::<3, 3>(0, 0).copy_from(&Matrix3::identity());
        g.fixed_view_mut::<3, 3>(3, 3).copy_from(&turn);
        g.fixed_view_mut::<3, 3>(6, 6).copy_from(&turn);
        (f, g)
    }
}

/// Rotation vector of a linear rate from `w0` to `w1` over `secs`, and its derivative by the gyroscope bias in both.
fn magnus(w0: &Vector3<f64>, w1: &Vector3<f64>, secs: f64) -> (Vector3<f64>, Matrix3<f64>) {
    let k = secs * secs / 12.0;
    ((w0 + w1) * (0.5 * secs) + w0.cross(w1) * k, Matrix3::identity() * -secs + hat(&(w1 - w0)) * k)
}

/// A sensor stays beyond its range for about so long, s: its error is the same meanwhile, while steps are integrated as if theirs were independent.
const SATURATED_SECS: f64 = 0.05;

/// Variances of the white noise of the gyroscope and the accelerometer, averaged over the step between two samples.
fn step_variances(a: &ImuSample, b: &ImuSample, model: &ImuModel) -> [f64; 2] {
    let secs = (b.time - a.time).as_secs_f64();
    // Ten times the noise per 50 ms without IMU measurements, at most 1e4.
    let missing_secs = (secs - 2.0 * model.noise.period_secs).max(0.0);
    let gap_factor = 10.0_f64.powf((missing_secs / 0.05).min(4.0));
    let beyond = |x: &Vector3<f64>, y: &Vector3<f64>, limit: f64| x.amax() > limit || y.amax() > limit;
    // Beyond its range a sensor says only that much: what was may be off by the range again.
    let variance = |density: f64, saturated: bool, limit: f64| {
        let white = (density * gap_factor).powi(2) / secs;
        if saturated { white.max(limit * limit * (SATURATED_SECS / secs).max(1.0)) } else { white }
    };
    let gyro_saturated = beyond(&a.gyro.0, &b.gyro.0, model.gyro_limit);
    let accel_saturated = beyond(&a.accel.0, &b.accel.0, model.accel_limit);
    [
        variance(model.noise.gyro_density, gyro_saturated, model.gyro_limit),
        variance(model.noise.accel_density, accel_saturated, model.accel_limit),
    ]
}

/// Raw IMU measurements are kept for exact re-integration up to this many; longer stretches are corrected to first order.
const MAX_RAW_SAMPLES: usize = 4096;

/// Re-integrate when the bias moved by more than this over the interval: rad, and m.
const REINTEGRATE_RAD: f64 = 1e-3;
const REINTEGRATE_M: f64 = 5e-3;

/// IMU measurements between two instants, integrated once and corrected for other biases to first order.
#[derive(Clone, Debug)]
pub struct Preintegration {
    pub(crate) delta: Delta,
    bias: Bias,
    model: ImuModel,
    samples: Vec<ImuSample>,
    sealed: bool,
    /// First and last sample, kept however long the stretch is.
    ends: [Rates; 2],
}

/// Angular rate, rad/s, and specific force, m/s², at one instant.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rates {
    pub(crate) turn: Vector3<f64>,
    pub(crate) force: Vector3<f64>,
}

impl Rates {
    const NONE: Self = Self { turn: Vector3::new(0.0, 0.0, 0.0), force: Vector3::new(0.0, 0.0, 0.0) };

    fn of(sample: &ImuSample) -> Self {
        Self { turn: sample.gyro.0, force: sample.accel.0 }
    }
}

impl Preintegration {
    /// Integrates `samples` (in the order of time; the first and last are the ends) at `bias`.
    pub fn new(model: ImuModel, bias: Bias, samples: &[ImuSample]) -> Self {
        let samples_held = Vec::with_capacity(64);
        let ends = [Rates::NONE; 2];
        let mut fresh =
            Self { delta: Delta::none(), bias, model, samples: samples_held, sealed: false, ends };
        fresh.restart(bias, samples);
        fresh
    }

    /// Forgets everything and integrates `samples` at `bias`, in the memory already held.
    pub fn restart(&mut self, bias: Bias, samples: &[ImuSample]) {
        self.bias = bias;
        self.sealed = samples.len() > MAX_RAW_SAMPLES;
        self.delta = integrate(samples, &bias, &self.model);
        self.ends = [samples.first(), samples.last()].map(|s| s.map_or(Rates::NONE, Rates::of));
        self.samples.clear();
        if !self.sealed {
            self.samples.extend_from_slice(samples);
        }
    }

    /// Integrates again at `bias`; without raw IMU measurements (very long stretches) the first-order correction stays.
    pub fn reintegrate(&mut self, bias: Bias) {
        if !self.sealed {
            self.bias = bias;
            self.delta = integrate(&self.samples, &bias, &self.model);
        }
    }

    /// Re-integrates if `bias` lies so far from the one integrated with that the first order is not enough.
    /// Says whether it did.
    pub fn follow(&mut self, bias: &Bias) -> bool {
        let t = self.delta.secs;
        let turned_rad = (bias.gyro - self.bias.gyro).norm() * t;
        let moved_m = (bias.accel - self.bias.accel).norm() * 0.5 * t * t;
        let far = turned_rad > REINTEGRATE_RAD || moved_m > REINTEGRATE_M;
        if far {
            self.reintegrate(*bias);
        }
        far && !self.sealed
    }

    /// This stretch followed by `next`, which begins where this one ends; `next` is read at this stretch's biases.
    pub fn append(&mut self, next: &Self) {
        let joined = if next.bias == self.bias || next.sealed {
            self.delta.then(&next.delta)
        } else {
            self.delta.then(&integrate(&next.samples, &self.bias, &self.model))
        };
        self.delta = joined;
        self.ends[1] = next.ends[1];
        self.sealed |= next.sealed || self.samples.len() + next.samples.len() > MAX_RAW_SAMPLES;
        if self.sealed {
            self.samples.clear();
        } else {
            // The first sample of `next` is the last of this stretch.
            self.samples.extend_from_slice(next.samples.get(1..).unwrap_or(&[]));
        }
    }

    /// Whether an IMU sample kept lies beyond the range of its sensor: what was felt is less than what was.
    pub fn is_saturated(&self) -> bool {
        let beyond = |s: &ImuSample| {
            s.gyro.0.amax() > self.model.gyro_limit || s.accel.0.amax() > self.model.accel_limit
        };
        self.samples.iter().any(beyond)
    }

    /// Length of the stretch, s.
    pub fn secs(&self) -> f64 {
        self.delta.secs
    }

    /// Biases that were integrated with.
    pub fn bias(&self) -> &Bias {
        &self.bias
    }

    /// The IMU's model.
    pub fn model(&self) -> &ImuModel {
        &self.model
    }

    /// Rates of the first and the last sample, less the biases of the integration.
    pub(crate) fn ends(&self) -> [Rates; 2] {
        self.ends.map(|r| Rates { turn: r.turn - self.bias.gyro, force: r.force - self.bias.accel })
    }

    /// IMU measurements kept, ends included; empty after very long stretches.
    pub fn samples(&self) -> &[ImuSample] {
        &self.samples
    }

    /// Rotation `first_from_last` for `bias`.
    pub fn rotation(&self, bias: &Bias) -> So3 {
        self.corrected(bias).0
    }

    /// Covariance of rotation (first side of the end), position and velocity: white noise, and the gyroscope's gain, which is the
    /// same over the whole stretch.
    pub fn covariance(&self) -> SMatrix<f64, 9, 9> {
        let by_gain = self.delta.by_gyro_gain * self.model.gyro_gain_std;
        self.delta.covariance + by_gain * by_gain.transpose()
    }

    /// Derivative of rotation, position and velocity by the sensors' gains (gyroscope, accelerometer, per axis): over a step a
    /// gain acts as a bias of minus the measurement. The accelerometer's is zero after very long stretches, whose samples are not kept.
    pub(crate) fn by_gain(&self) -> SMatrix<f64, 9, 6> {
        let none = (Delta::none(), ByBias::zeros());
        let (_, by_accel_gain) =
            fold_steps(&self.samples, &self.bias, &self.model, none, |(sum, by_gain), [a, b], step| {
                let mut of_step = step.by_accel_bias;
                for (k, mut column) in of_step.column_iter_mut().enumerate() {
                    column *= -0.5 * (a.accel.0[k] + b.accel.0[k]);
                }
                let (f, g) = sum.by_parts(step);
                (sum.then(step), f * by_gain + g * of_step)
            });
        let mut by_gain = SMatrix::<f64, 9, 6>::zeros();
        by_gain.fixed_columns_mut::<3>(0).copy_from(&self.delta.by_gyro_gain);
        by_gain.fixed_columns_mut::<3>(3).copy_from(&by_accel_gain);
        by_gain
    }

    /// Rotation, position and velocity for `bias`, to first order.
    pub(crate) fn corrected(&self, bias: &Bias) -> (So3, Vector3<f64>, Vector3<f64>) {
        let (dg, da) = (bias.gyro - self.bias.gyro, bias.accel - self.bias.accel);
        let shift = self.delta.by_gyro_bias * dg + self.delta.by_accel_bias * da;
        let turn = So3::exp(&shift.fixed_rows::<3>(0).into_owned());
        (
            self.delta.rotation * turn,
            self.delta.position + shift.fixed_rows::<3>(3),
            self.delta.velocity + shift.fixed_rows::<3>(6),
        )
    }

    /// Where a body in `state` at the first instant is at the last.
    pub fn predict(&self, state: &NavState) -> NavState {
        let (rotation, position, velocity) = self.corrected(&state.bias);
        let t = self.delta.secs;
        let gravity = self.model.gravity();
        let start = &state.world_from_body;
        NavState {
            world_from_body: Se3::new(
                start.rotation * rotation,
                start.translation + state.velocity * t + gravity * (0.5 * t * t) + start.rotation * position,
            ),
            velocity: state.velocity + gravity * t + start.rotation * velocity,
            bias: state.bias,
        }
    }
}

fn integrate(samples: &[ImuSample], bias: &Bias, model: &ImuModel) -> Delta {
    fold_steps(samples, bias, model, Delta::none(), |sum, _, step| sum.then(step))
}

/// Goes through the steps between samples, with the two samples of each as measured.
fn fold_steps<T>(
    samples: &[ImuSample],
    bias: &Bias,
    model: &ImuModel,
    none: T,
    then: impl Fn(T, [&ImuSample; 2], &Delta) -> T,
) -> T {
    let is_clipped = samples.iter().any(|s| s.gyro.0.amax() > model.gyro_limit);
    let read = if is_clipped { within_range(samples, model.gyro_limit).into() } else { Cow::from(samples) };
    let steps = samples.windows(2).zip(read.windows(2)).filter(|(pair, _)| pair[1].time > pair[0].time);
    steps.fold(none, |sum, (pair, read)| {
        let variances = step_variances(&pair[0], &pair[1], model);
        then(sum, [&pair[0], &pair[1]], &Delta::step(&read[0], &read[1], bias, variances))
    })
}

/// Samples with the nearest rate within the gyroscope's range in place of clipped ones, where there is any. What lies beyond the range was not
/// measured, and a rotation of a radian that was not would turn what the accelerometer feels afterwards.
fn within_range(samples: &[ImuSample], limit: f64) -> Vec<ImuSample> {
    let good: Vec<usize> = (0..samples.len()).filter(|k| samples[*k].gyro.0.amax() <= limit).collect();
    let nearest = |k: usize| {
        let after = good.partition_point(|g| *g < k);
        let around = [after.checked_sub(1), Some(after)].into_iter().flatten();
        around.filter_map(|at| good.get(at)).min_by_key(|g| g.abs_diff(k))
    };
    let stand_in = |(k, s): (usize, &ImuSample)| {
        let gyro = nearest(k).map_or(s.gyro, |g| samples[*g].gyro);
        ImuSample { gyro, ..*s }
    };
    samples.iter().enumerate().map(stand_in).collect()
}
