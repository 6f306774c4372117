//! Rotations SO(3), stored as unit quaternions.

use super::{LieGroup, impl_group_ops};
use crate::procrustes::nearest_rotation;
use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};

/// A rotation: maps vectors of one frame into another.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct So3(UnitQuaternion<f64>);

/// Below this angle (rad) Taylor series replace quotients that lose digits.
const SMALL_ANGLE: f64 = 1e-4;

/// Cross-product matrix: `hat(a) b = a × b`.
pub(crate) fn hat(v: &Vector3<f64>) -> Matrix3<f64> {
    Matrix3::new(0.0, -v.z, v.y, v.z, 0.0, -v.x, -v.y, v.x, 0.0)
}

/// `φ_k(θ²) = Σₙ (−θ²)ⁿ/(2n+k)!` for k = 0…5: every quotient of sines and powers that the groups need.
///
/// φ₀ = cos θ, φ₁ = sin θ/θ, φ₂ = (1 − cos θ)/θ², φ₃ = (θ − sin θ)/θ³, and `φ_{k+2} = (1/k! − φ_k)/θ²`. Below one
/// radian the recursion runs down from series, where it adds digits; above, it runs up, where it loses few.
pub(crate) fn trig_quotients(theta2: f64) -> [f64; 6] {
    if theta2 < 1.0 {
        let series = |k: usize| {
            let (mut sum, mut term) = (0.0, 1.0 / [1.0, 1.0, 2.0, 6.0, 24.0, 120.0][k]);
            for n in 0..9 {
                sum += term;
                term *= -theta2 / ((2 * n + k + 1) * (2 * n + k + 2)) as f64;
            }
            sum
        };
        let (q5, q4) = (series(5), series(4));
        let (q3, q2) = (1.0 / 6.0 - theta2 * q5, 0.5 - theta2 * q4);
        [1.0 - theta2 * q2, 1.0 - theta2 * q3, q2, q3, q4, q5]
    } else {
        let theta = theta2.sqrt();
        let (sin, cos) = theta.sin_cos();
        let (q1, q2) = (sin / theta, (1.0 - cos) / theta2);
        let (q3, q4) = ((1.0 - q1) / theta2, (0.5 - q2) / theta2);
        [cos, q1, q2, q3, q4, (1.0 / 6.0 - q3) / theta2]
    }
}

/// `Jl(ω) = I + φ₂ ω^ + φ₃ ω^²` (Solà 2018, eq. 145).
pub(crate) fn left_jacobian(omega: &Vector3<f64>) -> Matrix3<f64> {
    let [_, _, q2, q3, ..] = trig_quotients(omega.norm_squared());
    let w = hat(omega);
    Matrix3::identity() + w * q2 + w * w * q3
}

impl So3 {
    /// No rotation.
    pub const IDENTITY: Self = Self(UnitQuaternion::new_unchecked(Quaternion::from_vector(
        nalgebra::Vector4::new(0.0, 0.0, 0.0, 1.0),
    )));

    /// From quaternion parts; the quaternion is normalised. `None` when it has no direction.
    pub fn from_quaternion(x: f64, y: f64, z: f64, w: f64) -> Option<Self> {
        let q = Quaternion::new(w, x, y, z);
        let norm = q.norm();
        (norm.is_finite() && norm > 1e-9).then(|| Self(UnitQuaternion::from_quaternion(q)))
    }

    /// From a matrix that is a rotation up to rounding; `None` when it is further than 1e-3 from one.
    ///
    /// The nearest rotation (polar factor) is taken, so text files with few digits are welcome.
    pub fn from_matrix(matrix: &Matrix3<f64>) -> Option<Self> {
        let deviation = (matrix.transpose() * matrix - Matrix3::identity()).amax();
        if !(deviation < 1e-3 && matrix.determinant() > 0.0) {
            return None;
        }
        let nearest = nearest_rotation(matrix)?.rotation;
        let rotation = nalgebra::Rotation3::from_matrix_unchecked(nearest);
        Some(Self(UnitQuaternion::from_rotation_matrix(&rotation)))
    }

    /// Rotation by `angle_rad` about `axis` (any length but zero; zero gives the identity).
    pub fn from_axis_angle(axis: &Vector3<f64>, angle_rad: f64) -> Self {
        match axis.try_normalize(1e-12) {
            Some(unit) => Self::exp(&(unit * angle_rad)),
            None => Self::IDENTITY,
        }
    }

    /// The 3×3 matrix.
    pub fn matrix(&self) -> Matrix3<f64> {
        self.0.to_rotation_matrix().into_inner()
    }

    /// `[x, y, z, w]` with w ≥ 0.
    pub fn quaternion_xyzw(&self) -> [f64; 4] {
        let q = self.0.quaternion();
        let sign = if q.w < 0.0 { -1.0 } else { 1.0 };
        [q.i * sign, q.j * sign, q.k * sign, q.w * sign]
    }

    /// Angle of the rotation, rad, in [0, π].
    pub fn angle_rad(&self) -> f64 {
        self.log().norm()
    }

    /// Whether every part is finite.
    pub fn is_finite(&self) -> bool {
        self.0.coords.iter().all(|c| c.is_finite())
    }
}

impl LieGroup<3> for So3 {
    fn identity() -> Self {
        Self::IDENTITY
    }

    fn exp(tangent: &Vector3<f64>) -> Self {
        let theta2 = tangent.norm_squared();
        let theta = theta2.sqrt();
        // sin(θ/2)/θ
        let k = if theta < SMALL_ANGLE { 0.5 - theta2 / 48.0 } else { (0.5 * theta).sin() / theta };
        let v = tangent * k;
        Self(UnitQuaternion::new_normalize(Quaternion::new((0.5 * theta).cos(), v.x, v.y, v.z)))
    }

    fn log(&self) -> Vector3<f64> {
        let q = self.0.quaternion();
        let sign = if q.w < 0.0 { -1.0 } else { 1.0 };
        let v = Vector3::new(q.i, q.j, q.k) * sign;
        let w = q.w * sign;
        let n2 = v.norm_squared();
        let n = n2.sqrt();
        // θ/sin(θ/2) = 2 atan2(n, w)/n; atan2 stays exact at π, where acos and asin do not.
        let k = if n < SMALL_ANGLE { 2.0 / w - 2.0 * n2 / (3.0 * w * w * w) } else { 2.0 * n.atan2(w) / n };
        v * k
    }

    fn inverse(&self) -> Self {
        Self(self.0.inverse())
    }

    fn compose(&self, other: &Self) -> Self {
        // Renormalising keeps long chains on the group.
        Self(UnitQuaternion::new_normalize(self.0.quaternion() * other.0.quaternion()))
    }

    fn act(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.0 * point
    }

    fn adjoint(&self) -> Matrix3<f64> {
        self.matrix()
    }

    fn left_jacobian(tangent: &Vector3<f64>) -> Matrix3<f64> {
        left_jacobian(tangent)
    }

    fn right_jacobian_inverse(tangent: &Vector3<f64>) -> Option<Matrix3<f64>> {
        // Jr⁻¹(ω) = I + ½ ω^ + (1/θ² − (1 + cos θ)/(2 θ sin θ)) ω^²
        let theta2 = tangent.norm_squared();
        let theta = theta2.sqrt();
        let c = if theta < 1e-3 {
            1.0 / 12.0 + theta2 / 720.0
        } else {
            let half = 0.5 * theta;
            let sin_half = half.sin();
            if sin_half.abs() < 1e-9 {
                return None;
            }
            // (1 + cos θ)/(2 θ sin θ) = cot(θ/2)/(2 θ)
            1.0 / theta2 - half.cos() / (sin_half * 2.0 * theta)
        };
        let w = hat(tangent);
        Some(Matrix3::identity() + w * 0.5 + w * w * c)
    }

    fn d_act_d_perturbation(&self, point: &Vector3<f64>) -> Matrix3<f64> {
        -self.matrix() * hat(point)
    }
}

impl_group_ops!(So3);

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::{FRAC_PI_2, PI};

    #[test]
    fn a_quarter_turn_about_z_takes_x_to_y() {
        let turn = So3::from_axis_angle(&(Vector3::z() * 7.0), FRAC_PI_2);
        assert!((turn * Vector3::x() - Vector3::y()).norm() < 1e-15);
        let half = 0.5_f64.sqrt();
        let q = turn.quaternion_xyzw();
        assert!((q[2] - half).abs() < 1e-15 && (q[3] - half).abs() < 1e-15, "{q:?}");
        assert!((turn.angle_rad() - FRAC_PI_2).abs() < 1e-15);
        assert_eq!(So3::from_axis_angle(&Vector3::zeros(), 1.0), So3::IDENTITY);
    }

    #[test]
    fn quaternions_are_normalised_and_their_sign_is_fixed() {
        let turn = So3::from_quaternion(0.0, 0.0, -2.0, -2.0).unwrap();
        assert!((turn * Vector3::x() - Vector3::y()).norm() < 1e-15);
        assert!(turn.quaternion_xyzw()[3] > 0.0);
        for bad in [[0.0; 4], [f64::NAN, 0.0, 0.0, 1.0], [f64::INFINITY, 0.0, 0.0, 1.0]] {
            assert!(So3::from_quaternion(bad[0], bad[1], bad[2], bad[3]).is_none(), "{bad:?}");
        }
    }

    #[test]
    fn matrices_with_few_digits_are_welcome_and_others_are_not() {
        let turn = So3::exp(&Vector3::new(0.4, -1.1, 2.0));
        let rounded = turn.matrix().map(|v| (v * 1e4).round() / 1e4);
        let found = So3::from_matrix(&rounded).unwrap();
        assert!((found.inverse() * turn).angle_rad() < 1e-4);
        assert!((found.matrix().determinant() - 1.0).abs() < 1e-14);
        let half_turn = So3::exp(&Vector3::new(0.0, PI, 0.0));
        assert!((So3::from_matrix(&half_turn.matrix()).unwrap().angle_rad() - PI).abs() < 1e-15);
        for bad in [
            Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, -1.0)),
            Matrix3::identity() * 1.01,
            Matrix3::zeros(),
            Matrix3::repeat(f64::NAN),
        ] {
            assert!(So3::from_matrix(&bad).is_none(), "{bad}");
        }
        for at in 0..9 {
            let mut bad = Matrix3::identity();
            bad[at] = f64::NAN;
            assert!(So3::from_matrix(&bad).is_none(), "{bad}");
        }
    }

    #[test]
    fn quotients_of_sines_agree_where_the_two_ways_meet() {
        let (below, above) = (trig_quotients(1.0 - 1e-15), trig_quotients(1.0));
        for k in 0..6 {
            assert!((below[k] - above[k]).abs() < 1e-14 * above[k].abs(), "k = {k}");
        }
        assert_eq!(trig_quotients(0.0), [1.0, 1.0, 0.5, 1.0 / 6.0, 1.0 / 24.0, 1.0 / 120.0]);
    }

    #[test]
    fn a_long_chain_stays_a_rotation() {
        let step = So3::exp(&Vector3::new(1e-3, 2e-3, -3e-3));
        let end = (0..100_000).fold(So3::IDENTITY, |at, _| at * step);
        assert!((end.matrix().determinant() - 1.0).abs() < 1e-14);
        assert!((end.matrix().transpose() * end.matrix() - Matrix3::identity()).amax() < 1e-14);
    }
}
