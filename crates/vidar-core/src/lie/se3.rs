//! Rigid motions SE(3): `p_in_a = R · p_in_b + t`.

use super::{LieGroup, So3, hat, impl_group_ops, so3_left_jacobian, trig_quotients};
use nalgebra::{Matrix3, Matrix4, Matrix6, SMatrix, Vector3, Vector6};

/// A rigid motion `a_from_b`.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Se3 {
    /// Rotation part.
    pub rotation: So3,
    /// Translation part, metres: the origin of *b* seen from *a*.
    pub translation: Vector3<f64>,
}

impl Se3 {
    /// No motion.
    pub const IDENTITY: Self = Self { rotation: So3::IDENTITY, translation: Vector3::new(0.0, 0.0, 0.0) };

    /// From its parts.
    pub fn new(rotation: So3, translation: Vector3<f64>) -> Self {
        Self { rotation, translation }
    }

    /// A pure translation.
    pub fn from_translation(translation: Vector3<f64>) -> Self {
        Self { rotation: So3::IDENTITY, translation }
    }

    /// From a homogeneous matrix whose upper-left block is a rotation up to rounding (1e-3), else `None`.
    pub fn from_matrix(matrix: &Matrix4<f64>) -> Option<Self> {
        let rotation = So3::from_matrix(&matrix.fixed_view::<3, 3>(0, 0).into_owned())?;
        let translation: Vector3<f64> = matrix.fixed_view::<3, 1>(0, 3).into_owned();
        translation.iter().all(|v| v.is_finite()).then_some(Self { rotation, translation })
    }

    /// The 4×4 homogeneous matrix.
    pub fn matrix(&self) -> Matrix4<f64> {
        let mut m = Matrix4::identity();
        m.fixed_view_mut::<3, 3>(0, 0).copy_from(&self.rotation.matrix());
        m.fixed_view_mut::<3, 1>(0, 3).copy_from(&self.translation);
        m
    }

    /// Whether every part is finite.
    pub fn is_finite(&self) -> bool {
        self.rotation.is_finite() && self.translation.iter().all(|v| v.is_finite())
    }
}

/// Lower-left block `Q(ω, ρ)` of the left Jacobian (Barfoot, "State Estimation for Robotics", eq. 7.86).
fn jacobian_coupling(omega: &Vector3<f64>, rho: &Vector3<f64>) -> Matrix3<f64> {
    let [_, _, _, q3, q4, q5] = trig_quotients(omega.norm_squared());
    let (w, p) = (hat(omega), hat(rho));
    let (wp, pw) = (w * p, p * w);
    let wpw = w * pw;
    p * 0.5
        + (wp + pw + wpw) * q3
        + (w * wp + pw * w - wpw * 3.0) * q4
        + (wpw * w + w * wpw) * (0.5 * (q4 - 3.0 * q5))
}

impl LieGroup<6> for Se3 {
    fn identity() -> Self {
        Self::IDENTITY
    }

    fn exp(tangent: &Vector6<f64>) -> Self {
        let omega = tangent.fixed_rows::<3>(0).into_owned();
        let rho: Vector3<f64> = tangent.fixed_rows::<3>(3).into_owned();
        Self { rotation: So3::exp(&omega), translation: so3_left_jacobian(&omega) * rho }
    }

    fn log(&self) -> Vector6<f64> {
        let omega = self.rotation.log();
        // Jl⁻¹(ω) = Jr⁻¹(−ω); it exists because |ω| ≤ π.
        let inverse = So3::right_jacobian_inverse(&-omega).unwrap_or_else(Matrix3::identity);
        let rho = inverse * self.translation;
        let mut tangent = Vector6::zeros();
        tangent.fixed_rows_mut::<3>(0).copy_from(&omega);
        tangent.fixed_rows_mut::<3>(3).copy_from(&rho);
        tangent
    }

    fn inverse(&self) -> Self {
        let rotation = self.rotation.inverse();
        Self { rotation, translation: -(rotation * self.translation) }
    }

    fn compose(&self, other: &Self) -> Self {
        Self {
            rotation: self.rotation * other.rotation,
            translation: self.rotation * other.translation + self.translation,
        }
    }

    fn act(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * *point + self.translation
    }

    fn adjoint(&self) -> Matrix6<f64> {
        let r = self.rotation.matrix();
        let mut m = Matrix6::zeros();
        m.fixed_view_mut::<3, 3>(0, 0).copy_from(&r);
        m.fixed_view_mut::<3, 3>(3, 0).copy_from(&(hat(&self.translation) * r));
        m.fixed_view_mut::<3, 3>(3, 3).copy_from(&r);
        m
    }

    fn left_jacobian(tangent: &Vector6<f64>) -> Matrix6<f64> {
        let omega = tangent.fixed_rows::<3>(0).into_owned();
        let j = so3_left_jacobian(&omega);
        let mut m = Matrix6::zeros();
        m.fixed_view_mut::<3, 3>(0, 0).copy_from(&j);
        m.fixed_view_mut::<3, 3>(3, 0)
            .copy_from(&jacobian_coupling(&omega, &tangent.fixed_rows::<3>(3).into_owned()));
        m.fixed_view_mut::<3, 3>(3, 3).copy_from(&j);
        m
    }

    fn right_jacobian_inverse(tangent: &Vector6<f64>) -> Option<Matrix6<f64>> {
        // Block lower triangular [A 0; B A] has the inverse [A⁻¹ 0; −A⁻¹ B A⁻¹ A⁻¹].
        let omega = tangent.fixed_rows::<3>(0).into_owned();
        let a_inv = So3::right_jacobian_inverse(&omega)?;
        let b = jacobian_coupling(&-omega, &-tangent.fixed_rows::<3>(3).into_owned());
        let mut m = Matrix6::zeros();
        m.fixed_view_mut::<3, 3>(0, 0).copy_from(&a_inv);
        m.fixed_view_mut::<3, 3>(3, 3).copy_from(&a_inv);
        m.fixed_view_mut::<3, 3>(3, 0).copy_from(&(-(a_inv * b * a_inv)));
        Some(m)
    }

    fn d_act_d_perturbation(&self, point: &Vector3<f64>) -> SMatrix<f64, 3, 6> {
        let r = self.rotation.matrix();
        let mut m = SMatrix::<f64, 3, 6>::zeros();
        m.fixed_view_mut::<3, 3>(0, 0).copy_from(&(-r * hat(point)));
        m.fixed_view_mut::<3, 3>(0, 3).copy_from(&r);
        m
    }
}

impl_group_ops!(Se3);

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lie::left_jacobian_by_doubling;

    /// `ad` with `[ω, ρ]`: the derivative of the adjoint at the identity.
    fn ad(tangent: &Vector6<f64>) -> Matrix6<f64> {
        let w = hat(&tangent.fixed_rows::<3>(0).into_owned());
        let r = hat(&tangent.fixed_rows::<3>(3).into_owned());
        let mut m = Matrix6::zeros();
        m.fixed_view_mut::<3, 3>(0, 0).copy_from(&w);
        m.fixed_view_mut::<3, 3>(3, 0).copy_from(&r);
        m.fixed_view_mut::<3, 3>(3, 3).copy_from(&w);
        m
    }

    #[test]
    fn closed_form_jacobian_agrees_with_series_and_doubling() {
        let axis = Vector3::new(0.6, -0.64, 0.48);
        for angle in [0.0, 1e-12, 1e-8, 1e-4, 1e-2, 0.3, 0.999, 1.001, 2.0, std::f64::consts::PI, 6.0] {
            for size in [0.0, 1e-3, 1.0, 1e3] {
                let w = axis * angle;
                let tangent = Vector6::new(w.x, w.y, w.z, 0.3 * size, -size, 0.7 * size);
                let expected = left_jacobian_by_doubling::<6, Se3>(&tangent, ad);
                let error = (Se3::left_jacobian(&tangent) - expected).amax() / expected.amax();
                assert!(error < 5e-15, "angle {angle}, translation {size}: {error:.2e}");
            }
        }
    }
}
