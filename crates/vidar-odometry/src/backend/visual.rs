//! The reprojection factor.
//!
//! A landmark is a unit bearing `b` in its host camera and an inverse distance ρ. In the target camera it lies along
//! `q = C_tᵀ (C_h b + ρ (c_h − c_t))`, with `C` the rotation world_from_camera and `c` the camera's place: well defined
//! at infinity (ρ = 0). Residual: `π(q) − u`. States are those of the images' true instants; clocks that are off are the
//! inertial factor's affair.

use super::products::{product, transposed_product};
use crate::imu::hat;
use nalgebra::{Matrix2, Matrix2x3, Matrix3, Matrix3x2, SMatrix, Vector2, Vector3};
use vidar_core::{CameraModel, Se3};

/// A frame's camera as the factor needs it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct CameraPose {
    /// world_from_body rotation.
    pub(crate) body_turn: Matrix3<f64>,
    /// Body's place in the world.
    pub(crate) body_at: Vector3<f64>,
    /// world_from_camera rotation.
    pub(crate) turn: Matrix3<f64>,
    /// Camera's place in the world.
    pub(crate) at: Vector3<f64>,
}

impl CameraPose {
    pub(crate) fn new(world_from_body: &Se3, body_from_camera: &Se3) -> Self {
        let camera = *world_from_body * *body_from_camera;
        Self {
            body_turn: world_from_body.rotation.matrix(),
            body_at: world_from_body.translation,
            turn: camera.rotation.matrix(),
            at: camera.translation,
        }
    }
}

/// Derivatives of a pixel by everything it depends on.
#[derive(Clone, Copy, Debug)]
pub(crate) struct VisualJacobians {
    /// The pixel itself.
    pub(crate) pixel: Vector2<f64>,
    pub(crate) by_host: SMatrix<f64, 2, 6>,
    pub(crate) by_target: SMatrix<f64, 2, 6>,
    /// Bearing in the basis of [`tangent_basis`], then inverse distance.
    pub(crate) by_landmark: SMatrix<f64, 2, 3>,
}

/// Direction of the landmark in the target camera, up to scale.
#[inline(always)]
pub(crate) fn direction(
    host: &CameraPose,
    target: &CameraPose,
    bearing: &Vector3<f64>,
    rho: f64,
) -> Vector3<f64> {
    transposed_product(&target.turn, &(product(&host.turn, bearing) + (host.at - target.at) * rho))
}

/// Derivatives of the pixel at the given places; `None` where the landmark does not project.
#[inline(always)]
pub(crate) fn jacobians(
    camera: &CameraModel,
    host: &CameraPose,
    target: &CameraPose,
    bearing: &Vector3<f64>,
    rho: f64,
) -> Option<VisualJacobians> {
    let (pixel, by_direction) = camera.project_with_jacobian(&direction(host, target, bearing, rho))?;
    // d_pixel_d_(point in world axes)
    let m: Matrix2x3<f64> = product(&by_direction, &target.turn.transpose());
    let far = product(&host.turn, bearing);
    let from_host_body = far + (host.at - host.body_at) * rho;
    let from_target_body = far + (host.at - target.body_at) * rho;
    let mut by_host = SMatrix::<f64, 2, 6>::zeros();
    let mut by_target = SMatrix::<f64, 2, 6>::zeros();
    by_host
        .fixed_view_mut::<2, 3>(0, 0)
        .copy_from(&product(&crossed(&m, &from_host_body, -1.0), &host.body_turn));
    by_host.fixed_view_mut::<2, 3>(0, 3).copy_from(&(m * rho));
    by_target
        .fixed_view_mut::<2, 3>(0, 0)
        .copy_from(&product(&crossed(&m, &from_target_body, 1.0), &target.body_turn));
    by_target.fixed_view_mut::<2, 3>(0, 3).copy_from(&(m * -rho));
    let mut by_landmark = SMatrix::<f64, 2, 3>::zeros();
    by_landmark
        .fixed_view_mut::<2, 2>(0, 0)
        .copy_from(&product(&product(&m, &host.turn), &tangent_basis(bearing)));
    by_landmark.fixed_view_mut::<2, 1>(0, 2).copy_from(&product(&m, &(host.at - target.at)));
    Some(VisualJacobians { pixel, by_host, by_target, by_landmark })
}

/// Derivative of the pixel by the camera's place on the body (rotation on its right side, translation).
pub(crate) fn by_body_from_camera(
    camera: &CameraModel,
    host: &CameraPose,
    target: &CameraPose,
    bearing: &Vector3<f64>,
    rho: f64,
) -> Option<SMatrix<f64, 2, 6>> {
    let q = direction(host, target, bearing, rho);
    let (_, by_direction) = camera.project_with_jacobian(&q)?;
    let m: Matrix2x3<f64> = by_direction * target.turn.transpose();
    let mut out = SMatrix::<f64, 2, 6>::zeros();
    out.fixed_view_mut::<2, 3>(0, 0).copy_from(&(by_direction * hat(&q) - m * host.turn * hat(bearing)));
    out.fixed_view_mut::<2, 3>(0, 3).copy_from(&(m * (host.body_turn - target.body_turn) * rho));
    Some(out)
}

/// `sign · m · hat(x)`, row by row.
#[inline(always)]
fn crossed(m: &Matrix2x3<f64>, x: &Vector3<f64>, sign: f64) -> Matrix2x3<f64> {
    let row = |k: usize| Vector3::new(m[(k, 0)], m[(k, 1)], m[(k, 2)]).cross(x) * sign;
    Matrix2x3::from_rows(&[row(0).transpose(), row(1).transpose()])
}

/// Two unit vectors orthogonal to `bearing` and to each other.
#[inline(always)]
pub(crate) fn tangent_basis(bearing: &Vector3<f64>) -> Matrix3x2<f64> {
    let axis = if bearing.z.abs() < 0.9 { Vector3::z() } else { Vector3::x() };
    let first = bearing.cross(&axis).normalize();
    Matrix3x2::from_columns(&[first, bearing.cross(&first)])
}

/// The bearing moved by a step in its tangent plane.
pub(crate) fn bearing_plus(bearing: &Vector3<f64>, step: &Vector2<f64>) -> Vector3<f64> {
    (bearing + tangent_basis(bearing) * step).normalize()
}

/// `W` with `Wᵀ W = Σ⁻¹` (lower triangular); `None` when `covariance` is not positive definite.
pub(crate) fn whitening(covariance: &Matrix2<f64>) -> Option<Matrix2<f64>> {
    let l11 = covariance[(0, 0)].sqrt();
    let l21 = covariance[(1, 0)] / l11;
    let rest = covariance[(1, 1)] - l21 * l21;
    if !(l11 > 0.0 && rest > 0.0 && l11.is_finite() && rest.is_finite()) {
        return None;
    }
    let l22 = rest.sqrt();
    Some(Matrix2::new(1.0 / l11, 0.0, -l21 / (l11 * l22), 1.0 / l22))
}
