//! Orientation of the body over time from gyroscope samples, with its derivatives by bias and scale.

use crate::gyro_alignment::RateSample;
use nalgebra::{Matrix3, Vector3};
use vidar_core::{LieGroup, So3};

/// Rate-corrected orientation: `rate = (1 + scale) ∘ measured − bias`, integrated from the first sample.
#[derive(Debug)]
pub(super) struct GyroPath {
    secs: Vec<f64>,
    /// first_from_body at each sample.
    orientations: Vec<So3>,
    /// Mean corrected rate of the interval that follows each sample.
    rates: Vec<Vector3<f64>>,
    measured: Vec<Vector3<f64>>,
    /// ∫ R dt and ∫ R diag(measured) dt up to each sample.
    bias_integrals: Vec<Matrix3<f64>>,
    scale_integrals: Vec<Matrix3<f64>>,
}

/// The path at one time.
#[derive(Clone, Copy, Debug)]
pub(super) struct PathPoint<'a> {
    path: &'a GyroPath,
    /// The sample before, and how much later this is, s.
    sample: usize,
    late: f64,
    /// first_from_body.
    pub rotation: Matrix3<f64>,
    /// Corrected angular rate in body axes, rad/s.
    pub rate: Vector3<f64>,
}

impl GyroPath {
    /// `samples` in the order of time, at least two.
    pub fn new(samples: &[RateSample], bias: &Vector3<f64>, scale: &Vector3<f64>) -> Self {
        let n = samples.len();
        let mut path = Self {
            secs: samples.iter().map(|s| s.secs).collect(),
            orientations: Vec::with_capacity(n),
            rates: Vec::with_capacity(n),
            measured: Vec::with_capacity(n),
            bias_integrals: Vec::with_capacity(n),
            scale_integrals: Vec::with_capacity(n),
        };
        let mut orientation = So3::IDENTITY;
        let (mut by_bias, mut by_scale) = (Matrix3::zeros(), Matrix3::zeros());
        for (k, sample) in samples.iter().enumerate() {
            let next = samples.get(k + 1).unwrap_or(sample);
            let measured = 0.5 * (sample.rate + next.rate);
            let rate = measured + measured.component_mul(scale) - bias;
            path.orientations.push(orientation);
            path.rates.push(rate);
            path.measured.push(measured);
            path.bias_integrals.push(by_bias);
            path.scale_integrals.push(by_scale);
            let step = next.secs - sample.secs;
            let middle = (orientation * So3::exp(&(rate * (0.5 * step)))).matrix();
            by_bias += middle * step;
            by_scale += middle * Matrix3::from_diagonal(&measured) * step;
            orientation = orientation * So3::exp(&(rate * step));
        }
        path
    }

    /// The path at a time; outside of the samples the nearest rate continues.
    pub fn at(&self, secs: f64) -> PathPoint<'_> {
        let after = self.secs.partition_point(|s| *s <= secs);
        let k = after.saturating_sub(1).min(self.secs.len().saturating_sub(2));
        let step = secs - self.secs[k];
        let rate = self.rates[k];
        let rotation = (self.orientations[k] * So3::exp(&(rate * step))).matrix();
        PathPoint { path: self, sample: k, late: step, rotation, rate }
    }
}

impl PathPoint<'_> {
    /// ∫ R dt, s: minus the derivative of a left rotation by the bias.
    pub fn bias_integral(&self) -> Matrix3<f64> {
        let start = self.path.orientations[self.sample].matrix();
        self.path.bias_integrals[self.sample] + start * self.late
    }

    /// ∫ R diag(ω) dt: the derivative of a left rotation by the scales.
    pub fn scale_integral(&self) -> Matrix3<f64> {
        let start = self.path.orientations[self.sample].matrix();
        let measured = Matrix3::from_diagonal(&self.path.measured[self.sample]);
        self.path.scale_integrals[self.sample] + start * measured * self.late
    }
}
