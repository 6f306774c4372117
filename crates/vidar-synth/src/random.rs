//! Random streams: one per purpose and index, so that no thread's work changes another's numbers.

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// What random numbers are drawn for.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Purpose {
    Furniture,
    Imu,
    Exposure,
    /// Sensor noise of one frame.
    Frame(usize),
    /// Points on one face.
    Scan(usize),
}

/// The stream of `purpose` under `seed`.
pub(crate) fn stream(seed: u64, purpose: Purpose) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let (kind, index) = match purpose {
        Purpose::Furniture => (1, 0),
        Purpose::Imu => (2, 0),
        Purpose::Exposure => (3, 0),
        Purpose::Frame(k) => (4, k as u64),
        Purpose::Scan(k) => (5, k as u64),
    };
    rng.set_stream((kind << 48) | index);
    rng
}

/// Standard normal numbers by Box and Muller's transform, two at a time.
pub(crate) struct Gaussian<R> {
    rng: R,
    spare: Option<f64>,
}

impl<R: Rng> Gaussian<R> {
    pub(crate) fn new(rng: R) -> Self {
        Self { rng, spare: None }
    }

    pub(crate) fn next(&mut self) -> f64 {
        if let Some(value) = self.spare.take() {
            return value;
        }
        // 1 − x keeps the logarithm's argument away from zero.
        let radius = (-2.0 * (1.0 - self.rng.random::<f64>()).ln()).sqrt();
        let (sin, cos) = (2.0 * std::f64::consts::PI * self.rng.random::<f64>()).sin_cos();
        self.spare = Some(radius * sin);
        radius * cos
    }

    /// A number in 0…1, 1 excluded.
    pub(crate) fn uniform(&mut self) -> f64 {
        self.rng.random()
    }

    pub(crate) fn vector(&mut self) -> nalgebra::Vector3<f64> {
        nalgebra::Vector3::new(self.next(), self.next(), self.next())
    }
}
