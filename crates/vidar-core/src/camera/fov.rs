//! Field-of-view model (Devernay, Faugeras 2001). Parameters [fx, fy, cx, cy, ω].
//!
//! With r = √(X² + Y²): rd = atan2(2·r·tan(ω/2), Z)/ω, u = fx·rd·X/r + cx, v = fy·rd·Y/r + cy.
//! Domain: 0 < ω < π, Z > 0.

use super::{CameraError, Pinhole, Pixel};
use nalgebra::{Matrix2x3, RowVector3, Vector2, Vector3};

/// Field-of-view camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fov {
    /// Focal lengths, principal point, size.
    pub pinhole: Pinhole,
    /// Opening ω, rad.
    pub omega: f64,
}

impl Fov {
    /// Checks the domain of ω.
    pub fn new(pinhole: Pinhole, omega: f64) -> Result<Self, CameraError> {
        if !(omega > 1e-4 && omega < std::f64::consts::PI) {
            let expected = "in (0.0001, pi)";
            return Err(CameraError::BadParameter { parameter: "omega", expected, found: omega });
        }
        Ok(Self { pinhole, omega })
    }

    /// See [`super::CameraModel::project`].
    pub fn project(&self, p: &Vector3<f64>) -> Option<Pixel> {
        self.project_with_jacobian(p).map(|(pixel, _)| pixel)
    }

    /// See [`super::CameraModel::project_with_jacobian`].
    pub fn project_with_jacobian(&self, p: &Vector3<f64>) -> Option<(Pixel, Matrix2x3<f64>)> {
        if !(p.z > super::pinhole::MIN_Z && p.iter().all(|v| v.is_finite())) {
            return None;
        }
        let k = &self.pinhole;
        let c = 2.0 * (0.5 * self.omega).tan();
        let r2 = p.x * p.x + p.y * p.y;
        let r = r2.sqrt();
        let near_axis = r < 1e-8 * p.z;
        let rd = (c * r).atan2(p.z) / self.omega;
        // g = rd/r; on the axis its limit is c/(ω Z).
        let g = if near_axis { c / (self.omega * p.z) } else { rd / r };
        let pixel = Vector2::new(k.fx * g * p.x + k.cx, k.fy * g * p.y + k.cy);
        let d_g = if near_axis {
            RowVector3::new(0.0, 0.0, -g / p.z)
        } else {
            let denominator = self.omega * (c * c * r2 + p.z * p.z);
            let d_rd_d_r = c * p.z / denominator;
            let d_rd_d_z = -c * r / denominator;
            let d_r = RowVector3::new(p.x / r, p.y / r, 0.0);
            d_r * (d_rd_d_r / r - rd / r2) + RowVector3::new(0.0, 0.0, d_rd_d_z / r)
        };
        let mut jacobian = Matrix2x3::zeros();
        jacobian.set_row(0, &((d_g * p.x + RowVector3::new(g, 0.0, 0.0)) * k.fx));
        jacobian.set_row(1, &((d_g * p.y + RowVector3::new(0.0, g, 0.0)) * k.fy));
        Some((pixel, jacobian))
    }

    /// See [`super::CameraModel::unproject`].
    pub fn unproject(&self, pixel: &Pixel) -> Option<Vector3<f64>> {
        let k = &self.pinhole;
        let m = Vector2::new((pixel.x - k.cx) / k.fx, (pixel.y - k.cy) / k.fy);
        let rd = m.norm();
        let angle = rd * self.omega;
        if !(angle < std::f64::consts::FRAC_PI_2) {
            return None;
        }
        if rd < 1e-12 {
            return Some(Vector3::z());
        }
        let r = angle.tan() / (2.0 * (0.5 * self.omega).tan());
        Some(Vector3::new(m.x / rd * r, m.y / rd * r, 1.0).normalize())
    }
}
