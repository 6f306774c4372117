//! Orientation of the body over time, integrated from gyroscope samples.

use nalgebra::Vector3;
use vidar_core::{LieGroup, So3};

/// A gyroscope sample: seconds since a common origin, angular rate in body axes, rad/s.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RateSample {
    pub secs: f64,
    pub rate: Vector3<f64>,
}

/// first_from_body over time, for one value of the gyroscope bias.
#[derive(Debug)]
pub(crate) struct OrientationPath<'a> {
    samples: &'a [RateSample],
    bias: Vector3<f64>,
    /// first_from_body at each sample.
    orientations: Vec<So3>,
}

impl<'a> OrientationPath<'a> {
    /// Integrates `samples` (in the order of time, at least two) with the mean rate of neighbouring samples.
    pub fn new(samples: &'a [RateSample], bias: &Vector3<f64>) -> Self {
        let mut orientations = Vec::with_capacity(samples.len());
        let mut orientation = So3::IDENTITY;
        orientations.push(orientation);
        for pair in samples.windows(2) {
            let rate = 0.5 * (pair[0].rate + pair[1].rate) - bias;
            orientation = orientation * So3::exp(&(rate * (pair[1].secs - pair[0].secs)));
            orientations.push(orientation);
        }
        Self { samples, bias: *bias, orientations }
    }

    /// first_from_body at a time; outside of the samples the nearest rate continues.
    pub fn at(&self, secs: f64) -> So3 {
        let after = self.samples.partition_point(|s| s.secs <= secs);
        let k = after.saturating_sub(1).min(self.samples.len().saturating_sub(2));
        let (from, to) = (&self.samples[k], &self.samples[(k + 1).min(self.samples.len() - 1)]);
        let rate = 0.5 * (from.rate + to.rate) - self.bias;
        self.orientations[k] * So3::exp(&(rate * (secs - from.secs)))
    }
}
