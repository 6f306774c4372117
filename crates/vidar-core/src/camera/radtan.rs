//! Radial-tangential distortion. Parameters [fx, fy, cx, cy, k1, k2, p1, p2].
//!
//! With x = X/Z, y = Y/Z, r² = x² + y², d = 1 + k1·r² + k2·r⁴:
//! x' = x·d + 2·p1·x·y + p2·(r² + 2x²), y' = y·d + p1·(r² + 2y²) + 2·p2·x·y, u = fx·x' + cx, v = fy·y' + cy.
//! Domain: Z > 0 and the radius inside which r·d grows; beyond it the polynomial folds back and means nothing.

use super::{CameraError, Pinhole, Pixel};
use nalgebra::{Matrix2, Matrix2x3, Vector2, Vector3};

/// Pinhole with radial-tangential distortion.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RadTan {
    /// Focal lengths, principal point, size.
    pub pinhole: Pinhole,
    /// `[k1, k2, p1, p2]`.
    pub distortion: [f64; 4],
    /// Largest r² (undistorted, normalised) where the radial polynomial still grows.
    max_r2: f64,
}

impl RadTan {
    /// Checks that the distortion is finite.
    pub fn new(pinhole: Pinhole, distortion: [f64; 4]) -> Result<Self, CameraError> {
        if let Some(&found) = distortion.iter().find(|d| !d.is_finite()) {
            return Err(CameraError::BadParameter { parameter: "distortion", expected: "finite", found });
        }
        Ok(Self { pinhole, distortion, max_r2: monotone_limit(distortion[0], distortion[1]) })
    }

    fn distort(&self, n: &Vector2<f64>) -> (Vector2<f64>, Matrix2<f64>) {
        let [k1, k2, p1, p2] = self.distortion;
        let (x, y) = (n.x, n.y);
        let r2 = x * x + y * y;
        let d = 1.0 + r2 * (k1 + k2 * r2);
        // Half of the derivative of d by r², times 2.
        let dd = 2.0 * (k1 + 2.0 * k2 * r2);
        let out = Vector2::new(
            x * d + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * d + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        );
        let jacobian = Matrix2::new(
            d + x * x * dd + 2.0 * p1 * y + 6.0 * p2 * x,
            x * y * dd + 2.0 * p1 * x + 2.0 * p2 * y,
            x * y * dd + 2.0 * p1 * x + 2.0 * p2 * y,
            d + y * y * dd + 6.0 * p1 * y + 2.0 * p2 * x,
        );
        (out, jacobian)
    }

    /// See [`super::CameraModel::project`].
    pub fn project(&self, p: &Vector3<f64>) -> Option<Pixel> {
        self.project_with_jacobian(p).map(|(pixel, _)| pixel)
    }

    /// See [`super::CameraModel::project_with_jacobian`].
    pub fn project_with_jacobian(&self, p: &Vector3<f64>) -> Option<(Pixel, Matrix2x3<f64>)> {
        if !(p.z > super::pinhole::MIN_Z) {
            return None;
        }
        let iz = 1.0 / p.z;
        let n = Vector2::new(p.x * iz, p.y * iz);
        if !(n.norm_squared() < self.max_r2) {
            return None;
        }
        let (distorted, d_distorted_d_n) = self.distort(&n);
        let k = &self.pinhole;
        let pixel = Vector2::new(k.fx * distorted.x + k.cx, k.fy * distorted.y + k.cy);
        let d_n_d_point = Matrix2x3::new(iz, 0.0, -n.x * iz, 0.0, iz, -n.y * iz);
        let d_pixel = Matrix2::new(k.fx, 0.0, 0.0, k.fy) * d_distorted_d_n * d_n_d_point;
        Some((pixel, d_pixel))
    }

    /// See [`super::CameraModel::unproject`]. Newton's method from the distorted point.
    pub fn unproject(&self, pixel: &Pixel) -> Option<Vector3<f64>> {
        let k = &self.pinhole;
        let target = Vector2::new((pixel.x - k.cx) / k.fx, (pixel.y - k.cy) / k.fy);
        let mut n = target;
        for _ in 0..30 {
            let (value, jacobian) = self.distort(&n);
            let error = value - target;
            let step = jacobian.try_inverse()? * error;
            n -= step;
            if step.norm_squared() < 1e-28 {
                break;
            }
        }
        let (value, _) = self.distort(&n);
        let converged = (value - target).norm() < 1e-9 && n.norm_squared() < self.max_r2;
        converged.then(|| Vector3::new(n.x, n.y, 1.0).normalize())
    }
}

/// Smallest positive root in r² of d(r·d)/dr = 1 + 3·k1·r² + 5·k2·r⁴, or infinity.
fn monotone_limit(k1: f64, k2: f64) -> f64 {
    let (a, b, c) = (5.0 * k2, 3.0 * k1, 1.0);
    if a.abs() < 1e-15 {
        return if b < 0.0 { -c / b } else { f64::INFINITY };
    }
    let discriminant = b * b - 4.0 * a * c;
    if discriminant < 0.0 {
        return f64::INFINITY;
    }
    let root = discriminant.sqrt();
    [(-b - root) / (2.0 * a), (-b + root) / (2.0 * a)]
        .into_iter()
        .filter(|&r2| r2 > 0.0)
        .fold(f64::INFINITY, f64::min)
}
