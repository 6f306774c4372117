//! Similarities Sim(3): `p_in_a = s · R · p_in_b + t` (paper, section III-E).

use super::{LieGroup, Se3, So3, hat, impl_group_ops, left_jacobian_by_doubling};
use nalgebra::{Matrix3, SMatrix, SVector, Vector3};

/// A similarity `a_from_b`; `scale` is units of *a* per unit of *b*.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sim3 {
    /// Rotation part.
    pub rotation: So3,
    /// Translation part, in units of *a*.
    pub translation: Vector3<f64>,
    /// Scale, positive.
    pub scale: f64,
}

type Tangent = SVector<f64, 7>;
type Matrix7 = SMatrix<f64, 7, 7>;

impl Sim3 {
    /// No change.
    pub const IDENTITY: Self =
        Self { rotation: So3::IDENTITY, translation: Vector3::new(0.0, 0.0, 0.0), scale: 1.0 };

    /// From its parts; `None` unless the scale is finite and positive.
    pub fn new(rotation: So3, translation: Vector3<f64>, scale: f64) -> Option<Self> {
        (scale.is_finite() && scale > 0.0).then_some(Self { rotation, translation, scale })
    }

    /// A rigid motion as a similarity of scale 1.
    pub fn from_se3(motion: &Se3) -> Self {
        Self { rotation: motion.rotation, translation: motion.translation, scale: 1.0 }
    }

    /// The pose of a camera of frame *b* in frame *a*: the scale goes into the camera's translation.
    pub fn transform_pose(&self, b_from_camera: &Se3) -> Se3 {
        Se3 {
            rotation: self.rotation * b_from_camera.rotation,
            translation: self.act(&b_from_camera.translation),
        }
    }

    /// Whether every part is finite and the scale positive.
    pub fn is_finite(&self) -> bool {
        self.rotation.is_finite()
            && self.translation.iter().all(|v| v.is_finite())
            && self.scale.is_finite()
            && self.scale > 0.0
    }
}

/// `W = ∫₀¹ exp(τσ) exp(τ ω^) dτ = a I + b ω^ + c ω^²`, so that `t = W ρ` (Strasdat 2012).
fn translation_factor(omega: &Vector3<f64>, sigma: f64) -> Matrix3<f64> {
    let theta2 = omega.norm_squared();
    let theta = theta2.sqrt();
    let w = hat(omega);
    // a = ∫ e^{τσ} dτ, which exp_m1 keeps exact for small σ.
    let a = if sigma.abs() < 1e-8 { 1.0 + 0.5 * sigma } else { sigma.exp_m1() / sigma };
    let (b, c) = if theta < 0.3 {
        small_angle_factors(theta2, sigma)
    } else {
        // p = ∫ e^{τσ} sin(τθ) dτ, q = ∫ e^{τσ} cos(τθ) dτ; θ > 0 keeps the denominator away from zero.
        let e = sigma.exp();
        let d = sigma * sigma + theta2;
        let (sin, cos) = theta.sin_cos();
        let p = (e * (sigma * sin - theta * cos) + theta) / d;
        let q = (e * (sigma * cos + theta * sin) - sigma) / d;
        (p / theta, (a - q) / theta2)
    };
    Matrix3::identity() * a + w * b + w * w * c
}

/// Series in θ² of `b = ∫ e^{τσ} sin(τθ)/θ dτ` and `c = ∫ e^{τσ} (1 − cos τθ)/θ² dτ`, for θ < 0.3.
fn small_angle_factors(theta2: f64, sigma: f64) -> (f64, f64) {
    let (mut b, mut c) = (0.0, 0.0);
    // (−θ²)ʲ/(2j+1)!; the sixth term is below the last digit at θ = 0.3.
    let mut coefficient = 1.0;
    for j in 0..6 {
        let odd = 2 * j + 1;
        b += coefficient * exponential_moment(odd, sigma);
        coefficient /= (odd + 1) as f64;
        c += coefficient * exponential_moment(odd + 1, sigma);
        coefficient *= -theta2 / (odd + 2) as f64;
        if coefficient == 0.0 {
            break;
        }
    }
    (b, c)
}

/// `∫₀¹ τⁿ e^{τσ} dτ`, by series whose terms are all positive, so that no digit is lost.
fn exponential_moment(n: usize, sigma: f64) -> f64 {
    let mut sum = 0.0;
    // Terms fall once k exceeds |σ|; the cap only ends the loop for a σ that is not a number or absurd.
    if sigma >= 0.0 {
        // Σ σᵏ/(k! (n+k+1)).
        let mut power = 1.0;
        for k in 0..2000 {
            let term = power / (n + k + 1) as f64;
            sum += term;
            if term < 1e-17 * sum {
                break;
            }
            power *= sigma / (k + 1) as f64;
        }
        sum
    } else {
        // e^σ Σ (−σ)ᵏ/((n+1)(n+2)…(n+k+1)), by repeated integration by parts.
        let mut term = 1.0 / (n + 1) as f64;
        for k in 0..2000 {
            sum += term;
            if term < 1e-17 * sum {
                break;
            }
            term *= -sigma / (n + k + 2) as f64;
        }
        sum * sigma.exp()
    }
}

/// `ad` with `[ω, ρ, σ]`.
fn ad(tangent: &Tangent) -> Matrix7 {
    let w = hat(&tangent.fixed_rows::<3>(0).into_owned());
    let rho: Vector3<f64> = tangent.fixed_rows::<3>(3).into_owned();
    let mut m = Matrix7::zeros();
    m.fixed_view_mut::<3, 3>(0, 0).copy_from(&w);
    m.fixed_view_mut::<3, 3>(3, 0).copy_from(&hat(&rho));
    m.fixed_view_mut::<3, 3>(3, 3).copy_from(&(w + Matrix3::identity() * tangent[6]));
    m.fixed_view_mut::<3, 1>(3, 6).copy_from(&-rho);
    m
}

impl LieGroup<7> for Sim3 {
    fn identity() -> Self {
        Self::IDENTITY
    }

    fn exp(tangent: &Tangent) -> Self {
        let omega = tangent.fixed_rows::<3>(0).into_owned();
        let rho: Vector3<f64> = tangent.fixed_rows::<3>(3).into_owned();
        let sigma = tangent[6];
        Self {
            rotation: So3::exp(&omega),
            translation: translation_factor(&omega, sigma) * rho,
            scale: sigma.exp(),
        }
    }

    fn log(&self) -> Tangent {
        let omega = self.rotation.log();
        let sigma = self.scale.ln();
        let w = translation_factor(&omega, sigma);
        // W is invertible for every |ω| ≤ π.
        let rho = w.lu().solve(&self.translation).unwrap_or(self.translation);
        let mut tangent = Tangent::zeros();
        tangent.fixed_rows_mut::<3>(0).copy_from(&omega);
        tangent.fixed_rows_mut::<3>(3).copy_from(&rho);
        tangent[6] = sigma;
        tangent
    }

    fn inverse(&self) -> Self {
        let rotation = self.rotation.inverse();
        let scale = 1.0 / self.scale;
        Self { rotation, translation: -(rotation * self.translation) * scale, scale }
    }

    fn compose(&self, other: &Self) -> Self {
        Self {
            rotation: self.rotation * other.rotation,
            translation: self.act(&other.translation),
            scale: self.scale * other.scale,
        }
    }

    fn act(&self, point: &Vector3<f64>) -> Vector3<f64> {
        (self.rotation * *point) * self.scale + self.translation
    }

    fn adjoint(&self) -> Matrix7 {
        let r = self.rotation.matrix();
        let mut m = Matrix7::zeros();
        m.fixed_view_mut::<3, 3>(0, 0).copy_from(&r);
        m.fixed_view_mut::<3, 3>(3, 0).copy_from(&(hat(&self.translation) * r));
        m.fixed_view_mut::<3, 3>(3, 3).copy_from(&(r * self.scale));
        m.fixed_view_mut::<3, 1>(3, 6).copy_from(&-self.translation);
        m[(6, 6)] = 1.0;
        m
    }

    fn left_jacobian(tangent: &Tangent) -> Matrix7 {
        left_jacobian_by_doubling::<7, Self>(tangent, ad)
    }

    fn right_jacobian_inverse(tangent: &Tangent) -> Option<Matrix7> {
        // [A 0 0; B D c; 0 0 1] has the inverse [A⁻¹ 0 0; −D⁻¹ B A⁻¹  D⁻¹  −D⁻¹ c; 0 0 1].
        let a_inv = So3::right_jacobian_inverse(&tangent.fixed_rows::<3>(0).into_owned())?;
        let j = Self::right_jacobian(tangent);
        let d_inv = j.fixed_view::<3, 3>(3, 3).into_owned().try_inverse()?;
        let b = j.fixed_view::<3, 3>(3, 0).into_owned();
        let c = j.fixed_view::<3, 1>(3, 6).into_owned();
        let mut m = Matrix7::zeros();
        m.fixed_view_mut::<3, 3>(0, 0).copy_from(&a_inv);
        m.fixed_view_mut::<3, 3>(3, 0).copy_from(&-(d_inv * b * a_inv));
        m.fixed_view_mut::<3, 3>(3, 3).copy_from(&d_inv);
        m.fixed_view_mut::<3, 1>(3, 6).copy_from(&-(d_inv * c));
        m[(6, 6)] = 1.0;
        Some(m)
    }

    fn d_act_d_perturbation(&self, point: &Vector3<f64>) -> SMatrix<f64, 3, 7> {
        let sr = self.rotation.matrix() * self.scale;
        let mut m = SMatrix::<f64, 3, 7>::zeros();
        m.fixed_view_mut::<3, 3>(0, 0).copy_from(&(-sr * hat(point)));
        m.fixed_view_mut::<3, 3>(0, 3).copy_from(&sr);
        m.fixed_view_mut::<3, 1>(0, 6).copy_from(&(sr * point));
        m
    }
}

impl_group_ops!(Sim3);
