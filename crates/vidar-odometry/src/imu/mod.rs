//! IMU measurements between images: buffer, preintegration, propagation with covariance.
//!
//! The error state of a [`NavState`] has 15 dimensions in the order rotation (body side), position (world), velocity
//! (world), gyroscope bias, accelerometer bias: `R ← R · Exp(δθ)`, `p ← p + δp`, `v ← v + δv`, `b ← b + δb`
//! (Forster, Carlone, Dellaert, Scaramuzza, "On-manifold preintegration", TRO 2017). The first six are called its
//! *pose*, the last nine its *motion*.

mod buffer;
mod model;
mod preintegration;
mod propagate;

pub use buffer::{BufferError, Gap, ImuBuffer};
pub use model::{Bias, ImuModel, StepNoise};
pub use preintegration::Preintegration;
pub(crate) use preintegration::Rates;
pub use propagate::{Propagated, propagate};

use nalgebra::{Matrix3, SMatrix, SVector, Vector3};
use vidar_core::{LieGroup, Se3, So3};

/// 15×15 matrix in the order of the error state.
pub type Matrix15 = SMatrix<f64, 15, 15>;

/// 15-vector in the order of the error state.
pub type Vector15 = SVector<f64, 15>;

/// What the body does at one instant, and what its IMU adds to the truth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NavState {
    /// Pose of the body (IMU) in the world, z up.
    pub world_from_body: Se3,
    /// Velocity of the body's origin in the world, m/s.
    pub velocity: Vector3<f64>,
    /// Biases of the IMU.
    pub bias: Bias,
}

impl NavState {
    /// At rest at the world's origin, without biases.
    pub const REST: Self =
        Self { world_from_body: Se3::IDENTITY, velocity: Vector3::new(0.0, 0.0, 0.0), bias: Bias::ZERO };

    /// The state in a world that differs by a turn about the vertical and a shift.
    pub fn moved(&self, to_from_own: &Se3) -> Self {
        Self {
            world_from_body: *to_from_own * self.world_from_body,
            velocity: to_from_own.rotation.act(&self.velocity),
            bias: self.bias,
        }
    }

    /// The state moved by an error-state vector.
    pub fn plus(&self, delta: &Vector15) -> Self {
        let part = |at: usize| Vector3::new(delta[at], delta[at + 1], delta[at + 2]);
        Self {
            world_from_body: Se3::new(
                self.world_from_body.rotation * So3::exp(&part(0)),
                self.world_from_body.translation + part(3),
            ),
            velocity: self.velocity + part(6),
            bias: Bias { gyro: self.bias.gyro + part(9), accel: self.bias.accel + part(12) },
        }
    }

    /// The error-state vector δ with `other.plus(δ) = self`.
    pub fn minus(&self, other: &Self) -> Vector15 {
        let mut delta = Vector15::zeros();
        let turn = other.world_from_body.rotation.inverse() * self.world_from_body.rotation;
        delta.fixed_rows_mut::<3>(0).copy_from(&turn.log());
        delta
            .fixed_rows_mut::<3>(3)
            .copy_from(&(self.world_from_body.translation - other.world_from_body.translation));
        delta.fixed_rows_mut::<3>(6).copy_from(&(self.velocity - other.velocity));
        delta.fixed_rows_mut::<3>(9).copy_from(&(self.bias.gyro - other.bias.gyro));
        delta.fixed_rows_mut::<3>(12).copy_from(&(self.bias.accel - other.bias.accel));
        delta
    }

    /// Whether every part is finite.
    pub fn is_finite(&self) -> bool {
        let finite = |v: &Vector3<f64>| v.iter().all(|x| x.is_finite());
        self.world_from_body.is_finite()
            && finite(&self.velocity)
            && finite(&self.bias.gyro)
            && finite(&self.bias.accel)
    }
}

/// Cross-product matrix: `hat(a) b = a × b`.
pub(crate) fn hat(v: &Vector3<f64>) -> Matrix3<f64> {
    Matrix3::new(0.0, -v.z, v.y, v.z, 0.0, -v.x, -v.y, v.x, 0.0)
}

#[cfg(test)]
mod tests;
