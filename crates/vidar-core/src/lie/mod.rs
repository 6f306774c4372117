//! Lie groups SO(3), SE(3) and Sim(3) behind one trait.
//!
//! Tangent order is [rotation, translation, log-scale]; the perturbation is on the right:
//! `x ⊞ δ = x · exp(δ)`, `y ⊟ x = log(x⁻¹ · y)`.
//! References: Solà, Deray, Atchuthan, "A micro Lie theory", 2018; Barfoot, "State Estimation for Robotics", ch. 7;
//! Strasdat, "Local accuracy and global consistency", 2012 (Sim(3)).

mod se3;
mod sim3;
mod so3;

pub use se3::Se3;
pub use sim3::Sim3;
pub use so3::So3;
pub(crate) use so3::{hat, left_jacobian as so3_left_jacobian, trig_quotients};

use nalgebra::{SMatrix, SVector, Vector3};

/// A Lie group of transforms; `DOF` is the dimension of its tangent space.
pub trait LieGroup<const DOF: usize>: Copy + std::fmt::Debug {
    /// The identity.
    fn identity() -> Self;

    /// The exponential map of `tangent`.
    fn exp(tangent: &SVector<f64, DOF>) -> Self;

    /// The logarithm: the tangent with `exp(tangent) = self`, of rotation angle in [0, π].
    fn log(&self) -> SVector<f64, DOF>;

    /// `b_from_a` of an `a_from_b`.
    fn inverse(&self) -> Self;

    /// `self · other`: `a_from_c = a_from_b · b_from_c`.
    fn compose(&self, other: &Self) -> Self;

    /// Maps a point.
    fn act(&self, point: &Vector3<f64>) -> Vector3<f64>;

    /// `Ad` with `x · exp(δ) = exp(Ad_x δ) · x`.
    fn adjoint(&self) -> SMatrix<f64, DOF, DOF>;

    /// `Jl` with `exp(τ + δ) ≈ exp(Jl(τ) δ) · exp(τ)`.
    fn left_jacobian(tangent: &SVector<f64, DOF>) -> SMatrix<f64, DOF, DOF>;

    /// `Jr` with `exp(τ + δ) ≈ exp(τ) · exp(Jr(τ) δ)`.
    fn right_jacobian(tangent: &SVector<f64, DOF>) -> SMatrix<f64, DOF, DOF> {
        Self::left_jacobian(&-tangent)
    }

    /// `Jr⁻¹`, so that `log(x · exp(δ)) ≈ log(x) + Jr⁻¹(log x) δ`.
    ///
    /// `None` where it does not exist (rotation by a multiple of 2π other than zero).
    fn right_jacobian_inverse(tangent: &SVector<f64, DOF>) -> Option<SMatrix<f64, DOF, DOF>>;

    /// Derivative of `x.exp(δ) · p` by `δ` at zero.
    fn d_act_d_perturbation(&self, point: &Vector3<f64>) -> SMatrix<f64, 3, DOF>;

    /// `self · exp(δ)`.
    fn plus(&self, delta: &SVector<f64, DOF>) -> Self {
        self.compose(&Self::exp(delta))
    }

    /// `log(other⁻¹ · self)`: the δ with `other.plus(δ) = self`.
    fn minus(&self, other: &Self) -> SVector<f64, DOF> {
        other.inverse().compose(self).log()
    }

    /// The point a share `t` of the way from `self` (0) to `other` (1) along the geodesic.
    fn interpolate(&self, other: &Self, t: f64) -> Self {
        self.plus(&(other.minus(self) * t))
    }
}

/// Left Jacobian of any group from its `ad` matrix: series for a small tangent, then doubling.
///
/// `Jl(τ) = Σ adⁿ/(n+1)!` and `Jl(2τ) = ½ (I + Ad(exp τ)) Jl(τ)`, both exact.
pub(crate) fn left_jacobian_by_doubling<const DOF: usize, G: LieGroup<DOF>>(
    tangent: &SVector<f64, DOF>,
    ad: impl Fn(&SVector<f64, DOF>) -> SMatrix<f64, DOF, DOF>,
) -> SMatrix<f64, DOF, DOF> {
    let mut halvings = 0;
    let mut small = *tangent;
    // Translation enters the series linearly, so only the rest of the tangent decides the convergence.
    while halvings < 32 && linear_part_norm(&small) > 0.25 {
        small *= 0.5;
        halvings += 1;
    }
    let ad_small = ad(&small);
    let mut jacobian = SMatrix::identity();
    let mut term = SMatrix::identity();
    // 0.25¹²/13! lies below the last digit.
    for n in 1..13 {
        term = term * ad_small / f64::from(n + 1);
        jacobian += term;
    }
    for _ in 0..halvings {
        jacobian = (SMatrix::identity() + G::exp(&small).adjoint()) * jacobian * 0.5;
        small *= 2.0;
    }
    jacobian
}

fn linear_part_norm<const DOF: usize>(tangent: &SVector<f64, DOF>) -> f64 {
    (0..DOF).filter(|i| !(3..6).contains(i)).map(|i| tangent[i] * tangent[i]).sum::<f64>().sqrt()
}

macro_rules! impl_group_ops {
    ($group:ty) => {
        impl std::ops::Mul for $group {
            type Output = $group;
            fn mul(self, other: $group) -> $group {
                $crate::lie::LieGroup::compose(&self, &other)
            }
        }
        impl std::ops::Mul<nalgebra::Vector3<f64>> for $group {
            type Output = nalgebra::Vector3<f64>;
            fn mul(self, point: nalgebra::Vector3<f64>) -> nalgebra::Vector3<f64> {
                $crate::lie::LieGroup::act(&self, &point)
            }
        }
    };
}
pub(crate) use impl_group_ops;
