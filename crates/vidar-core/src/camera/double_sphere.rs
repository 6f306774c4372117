//! Double sphere (Usenko, Demmel, Cremers, 3DV 2018). Parameters [fx, fy, cx, cy, ξ, α].
//!
//! With d1 = |p|, z1 = ξ·d1 + Z, d2 = √(X² + Y² + z1²), n = α·d2 + (1 − α)·z1: u = fx·X/n + cx, v = fy·Y/n + cy.
//! Domain: α in [0, 1], ξ > −1, and Z > −w2·d1 (eq. 43–45 of the paper).

use super::{CameraError, Pinhole, Pixel};
use nalgebra::{Matrix2x3, RowVector3, Vector2, Vector3};

/// Double-sphere wide-angle camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DoubleSphere {
    /// Focal lengths, principal point, size.
    pub pinhole: Pinhole,
    /// Distance of the two spheres.
    pub xi: f64,
    /// Share of the second sphere.
    pub alpha: f64,
}

impl DoubleSphere {
    /// Checks the domain of ξ and α.
    pub fn new(pinhole: Pinhole, xi: f64, alpha: f64) -> Result<Self, CameraError> {
        if !(xi.is_finite() && xi > -1.0) {
            return Err(CameraError::BadParameter {
                parameter: "xi",
                expected: "finite and above -1",
                found: xi,
            });
        }
        if !(0.0..=1.0).contains(&alpha) {
            return Err(CameraError::BadParameter {
                parameter: "alpha",
                expected: "in [0, 1]",
                found: alpha,
            });
        }
        Ok(Self { pinhole, xi, alpha })
    }

    /// See [`super::CameraModel::project`].
    pub fn project(&self, p: &Vector3<f64>) -> Option<Pixel> {
        self.project_with_jacobian(p).map(|(pixel, _)| pixel)
    }

    /// See [`super::CameraModel::project_with_jacobian`].
    pub fn project_with_jacobian(&self, p: &Vector3<f64>) -> Option<(Pixel, Matrix2x3<f64>)> {
        let (k, xi, alpha) = (&self.pinhole, self.xi, self.alpha);
        let d1 = p.norm();
        if !(d1 > super::pinhole::MIN_Z && d1.is_finite()) {
            return None;
        }
        let w1 = if alpha <= 0.5 { alpha / (1.0 - alpha) } else { (1.0 - alpha) / alpha };
        let w2 = (w1 + xi) / (2.0 * w1 * xi + xi * xi + 1.0).sqrt();
        if p.z <= -w2 * d1 {
            return None;
        }
        let z1 = xi * d1 + p.z;
        let d2 = (p.x * p.x + p.y * p.y + z1 * z1).sqrt();
        let n = alpha * d2 + (1.0 - alpha) * z1;
        if !(n > super::pinhole::MIN_Z) {
            return None;
        }
        let pixel = Vector2::new(k.fx * p.x / n + k.cx, k.fy * p.y / n + k.cy);
        let d_d1 = RowVector3::new(p.x, p.y, p.z) / d1;
        let d_z1 = d_d1 * xi + RowVector3::new(0.0, 0.0, 1.0);
        let d_d2 = (RowVector3::new(p.x, p.y, 0.0) + d_z1 * z1) / d2;
        let d_n = d_d2 * alpha + d_z1 * (1.0 - alpha);
        let mut jacobian = Matrix2x3::zeros();
        jacobian.set_row(0, &((RowVector3::new(1.0, 0.0, 0.0) - d_n * (p.x / n)) * (k.fx / n)));
        jacobian.set_row(1, &((RowVector3::new(0.0, 1.0, 0.0) - d_n * (p.y / n)) * (k.fy / n)));
        Some((pixel, jacobian))
    }

    /// See [`super::CameraModel::unproject`] (eq. 46–49 of the paper).
    pub fn unproject(&self, pixel: &Pixel) -> Option<Vector3<f64>> {
        let (k, xi, alpha) = (&self.pinhole, self.xi, self.alpha);
        let mx = (pixel.x - k.cx) / k.fx;
        let my = (pixel.y - k.cy) / k.fy;
        let r2 = mx * mx + my * my;
        let inside = 1.0 - (2.0 * alpha - 1.0) * r2;
        if !(r2.is_finite() && inside >= 0.0) {
            return None;
        }
        let mz = (1.0 - alpha * alpha * r2) / (alpha * inside.sqrt() + 1.0 - alpha);
        let under_root = mz * mz + (1.0 - xi * xi) * r2;
        if under_root < 0.0 {
            return None;
        }
        let factor = (mz * xi + under_root.sqrt()) / (mz * mz + r2);
        let direction = Vector3::new(factor * mx, factor * my, factor * mz - xi);
        direction.try_normalize(1e-12)
    }
}
