//! The inertial factor of the adjustment: a preintegrated stretch with the sensors' gains.
//!
//! A consumer IMU's measurements are off by up to a percent in scale. With gains `γ` the true rate is `(1 + γ) ∘ measured − b`, per
//! axis and sensor. The stretch is integrated with gains and biases as they were, and corrected to first order for what they are.

use crate::backend::{Shift, Whitening, inertial_jacobians, inertial_residual};
use crate::imu::{Bias, ImuBuffer, ImuModel, Matrix15, NavState, Preintegration, Vector15};
use nalgebra::{SMatrix, SVector, Vector3};
use vidar_core::{AngularRate, ImuSample, SpecificForce};

/// Unknowns of the gains: gyroscope and accelerometer, per axis.
pub(super) const GAIN_DIM: usize = 6;

/// Difference of a gain beyond which a stretch is integrated again: over a stretch that turns by 0.5 rad its second order is
/// below 1e-6 rad.
const REINTEGRATE_GAIN: f64 = 1e-3;

/// What the sensors' measurements are to be multiplied by, minus one, per axis of the body.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct ImuGain {
    pub(crate) gyro: Vector3<f64>,
    pub(crate) accel: Vector3<f64>,
}

impl ImuGain {
    pub(crate) fn applied(&self, sample: &ImuSample) -> ImuSample {
        let one = Vector3::repeat(1.0);
        ImuSample {
            time: sample.time,
            gyro: AngularRate(sample.gyro.0.component_mul(&(one + self.gyro))),
            accel: SpecificForce(sample.accel.0.component_mul(&(one + self.accel))),
        }
    }

    /// What is left to apply where `used` was applied already.
    pub(crate) fn beyond(&self, used: &Self) -> Self {
        let ratio =
            |new: &Vector3<f64>, old: &Vector3<f64>| new.zip_map(old, |n, o| (1.0 + n) / (1.0 + o) - 1.0);
        Self { gyro: ratio(&self.gyro, &used.gyro), accel: ratio(&self.accel, &used.accel) }
    }

    pub(super) fn values(&self) -> [f64; GAIN_DIM] {
        let (g, a) = (&self.gyro, &self.accel);
        [g.x, g.y, g.z, a.x, a.y, a.z]
    }

    pub(super) fn plus(&self, step: &[f64]) -> Self {
        Self {
            gyro: self.gyro + Vector3::from_column_slice(&step[..3]),
            accel: self.accel + Vector3::from_column_slice(&step[3..GAIN_DIM]),
        }
    }
}

impl ImuBuffer {
    /// The same measurements with gains applied.
    pub(crate) fn multiplied(&self, gain: &ImuGain) -> Self {
        let mut out = Self::new(1.0 / self.nominal_period().as_secs_f64());
        for sample in self.iter() {
            // They are in order and finite, as they were.
            let _ = out.push(gain.applied(sample));
        }
        out
    }
}

/// What the IMU says of the motion between two states.
#[derive(Clone, Debug)]
pub(super) struct InertialFactor {
    raw: Vec<ImuSample>,
    preintegration: Preintegration,
    gain: ImuGain,
    by_gain: SMatrix<f64, 9, GAIN_DIM>,
    whitening: Whitening,
}

/// Derivatives of the whitened residual.
pub(super) struct InertialJacobians {
    pub(super) residual: Vector15,
    pub(super) by_i: Matrix15,
    pub(super) by_j: Matrix15,
    pub(super) by_gain: SMatrix<f64, 15, GAIN_DIM>,
}

impl InertialFactor {
    pub(super) fn new(model: &ImuModel, bias: &Bias, gain: &ImuGain, samples: &[ImuSample]) -> Self {
        let applied: Vec<ImuSample> = samples.iter().map(|s| gain.applied(s)).collect();
        let preintegration = Preintegration::new(*model, *bias, &applied);
        let by_gain = preintegration.by_gain();
        let whitening = Whitening::of(&preintegration);
        Self { raw: samples.to_vec(), preintegration, gain: *gain, by_gain, whitening }
    }

    /// Integrates again where biases or gains are far from those integrated with.
    pub(super) fn follow(&mut self, bias: &Bias, gain: &ImuGain) {
        let moved =
            gain.values().iter().zip(self.gain.values()).any(|(a, b)| (a - b).abs() > REINTEGRATE_GAIN);
        if moved {
            let applied: Vec<ImuSample> = self.raw.iter().map(|s| gain.applied(s)).collect();
            self.gain = *gain;
            self.preintegration.restart(*bias, &applied);
        }
        if moved || self.preintegration.follow(bias) {
            self.by_gain = self.preintegration.by_gain();
            self.whitening = Whitening::of(&self.preintegration);
        }
    }

    /// Takes another model of the noise.
    pub(super) fn reweigh(&mut self, model: &ImuModel) {
        *self = Self::new(model, self.preintegration.bias(), &self.gain, &self.raw);
    }

    /// Whitened residual between two states.
    pub(super) fn error(&self, i: &NavState, j: &NavState, gain: &ImuGain) -> Vector15 {
        let mut residual = inertial_residual(&self.preintegration, i, j, Shift::default());
        let moved: [f64; GAIN_DIM] = std::array::from_fn(|k| gain.values()[k] - self.gain.values()[k]);
        let by_gain = self.by_gain * SVector::<f64, GAIN_DIM>::from(moved);
        let mut motion = residual.fixed_rows_mut::<9>(0);
        motion -= by_gain;
        self.whitening.apply(&residual)
    }

    /// Whitened residual with its derivatives.
    pub(super) fn linearise(&self, i: &NavState, j: &NavState, gain: &ImuGain) -> InertialJacobians {
        let (by_i, by_j) = inertial_jacobians(&self.preintegration, i, j, Shift::default());
        let mut by_gain = SMatrix::<f64, 15, GAIN_DIM>::zeros();
        by_gain.fixed_view_mut::<9, GAIN_DIM>(0, 0).copy_from(&-self.by_gain);
        InertialJacobians {
            residual: self.error(i, j, gain),
            by_i: self.whitening.apply(&by_i),
            by_j: self.whitening.apply(&by_j),
            by_gain: self.whitening.apply(&by_gain),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A gain that is applied after another one gives what the sum of knowledge says.
    #[test]
    fn what_is_beyond_a_used_gain_completes_it() {
        let gain = |g: f64, a: f64| ImuGain { gyro: Vector3::new(g, 0.0, -g), accel: Vector3::repeat(a) };
        let (used, found) = (gain(0.02, -0.01), gain(-0.01, 0.03));
        let sample = ImuSample {
            time: vidar_core::Timestamp::from_nanos(0),
            gyro: AngularRate(Vector3::new(0.4, -0.2, 1.0)),
            accel: SpecificForce(Vector3::new(1.0, 2.0, 9.0)),
        };
        let both = found.beyond(&used).applied(&used.applied(&sample));
        assert!((both.gyro.0 - found.applied(&sample).gyro.0).norm() < 1e-14);
        assert!((both.accel.0 - found.applied(&sample).accel.0).norm() < 1e-14);
    }
}
