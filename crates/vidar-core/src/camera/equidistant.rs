//! Equidistant fisheye (Kannala-Brandt). Parameters [fx, fy, cx, cy, k1, k2, k3, k4].
//!
//! With r = √(X² + Y²), θ = atan2(r, Z), θd = θ·(1 + k1·θ² + k2·θ⁴ + k3·θ⁶ + k4·θ⁸):
//! u = fx·θd·X/r + cx, v = fy·θd·Y/r + cy. Domain: any direction whose θ lies where θd grows, θ < π.

use super::{CameraError, Pinhole, Pixel};
use nalgebra::{Matrix2x3, RowVector3, Vector2, Vector3};

/// Equidistant fisheye with four terms.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Equidistant {
    /// Focal lengths, principal point, size.
    pub pinhole: Pinhole,
    /// `[k1, k2, k3, k4]`.
    pub distortion: [f64; 4],
    /// Largest angle (rad) up to which θd grows.
    max_theta: f64,
}

impl Equidistant {
    /// Checks that the distortion is finite.
    pub fn new(pinhole: Pinhole, distortion: [f64; 4]) -> Result<Self, CameraError> {
        if let Some(&found) = distortion.iter().find(|d| !d.is_finite()) {
            return Err(CameraError::BadParameter { parameter: "distortion", expected: "finite", found });
        }
        let mut camera = Self { pinhole, distortion, max_theta: std::f64::consts::PI };
        // A fine scan finds the first fold; the polynomial has degree nine and no closed root.
        let steps = 4096;
        for i in 1..=steps {
            let theta = std::f64::consts::PI * f64::from(i) / f64::from(steps);
            if camera.radius(theta).1 <= 0.0 {
                camera.max_theta = std::f64::consts::PI * f64::from(i - 1) / f64::from(steps);
                break;
            }
        }
        Ok(camera)
    }

    /// θd and its derivative by θ.
    fn radius(&self, theta: f64) -> (f64, f64) {
        let [k1, k2, k3, k4] = self.distortion;
        let t2 = theta * theta;
        let value = theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))));
        let slope = 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)));
        (value, slope)
    }

    /// See [`super::CameraModel::project`].
    pub fn project(&self, p: &Vector3<f64>) -> Option<Pixel> {
        self.project_with_jacobian(p).map(|(pixel, _)| pixel)
    }

    /// See [`super::CameraModel::project_with_jacobian`].
    pub fn project_with_jacobian(&self, p: &Vector3<f64>) -> Option<(Pixel, Matrix2x3<f64>)> {
        let k = &self.pinhole;
        let r2 = p.x * p.x + p.y * p.y;
        let r = r2.sqrt();
        let norm2 = r2 + p.z * p.z;
        if !(norm2 > super::pinhole::MIN_Z * super::pinhole::MIN_Z && norm2.is_finite()) {
            return None;
        }
        let theta = r.atan2(p.z);
        if theta >= self.max_theta {
            return None;
        }
        let (theta_d, slope) = self.radius(theta);
        // g = θd/r; on the axis its limit is 1/Z.
        let near_axis = r < 1e-8 * norm2.sqrt();
        let g = if near_axis { 1.0 / p.z } else { theta_d / r };
        let pixel = Vector2::new(k.fx * g * p.x + k.cx, k.fy * g * p.y + k.cy);
        let d_g = if near_axis {
            RowVector3::new(0.0, 0.0, -g / p.z)
        } else {
            // ∂θ/∂(X,Y,Z) = [X Z/(r n²), Y Z/(r n²), −r/n²].
            let d_theta = RowVector3::new(p.x * p.z / (r * norm2), p.y * p.z / (r * norm2), -r / norm2);
            let d_r = RowVector3::new(p.x / r, p.y / r, 0.0);
            d_theta * (slope / r) - d_r * (theta_d / r2)
        };
        let mut jacobian = Matrix2x3::zeros();
        jacobian.set_row(0, &((d_g * p.x + RowVector3::new(g, 0.0, 0.0)) * k.fx));
        jacobian.set_row(1, &((d_g * p.y + RowVector3::new(0.0, g, 0.0)) * k.fy));
        Some((pixel, jacobian))
    }

    /// See [`super::CameraModel::unproject`]. Newton's method on θ with bisection as a guard.
    pub fn unproject(&self, pixel: &Pixel) -> Option<Vector3<f64>> {
        let k = &self.pinhole;
        let m = Vector2::new((pixel.x - k.cx) / k.fx, (pixel.y - k.cy) / k.fy);
        let theta_d = m.norm();
        if !(theta_d.is_finite() && theta_d <= self.radius(self.max_theta).0) {
            return None;
        }
        if theta_d < 1e-12 {
            return Some(Vector3::z());
        }
        let (mut low, mut high) = (0.0, self.max_theta);
        let mut theta = theta_d.min(0.9 * self.max_theta);
        for _ in 0..60 {
            let (value, slope) = self.radius(theta);
            let error = value - theta_d;
            if error > 0.0 {
                high = theta
            } else {
                low = theta
            }
            let newton = theta - error / slope;
            let next = if newton > low && newton < high { newton } else { 0.5 * (low + high) };
            let done = (next - theta).abs() < 1e-15;
            theta = next;
            if done {
                break;
            }
        }
        let (sin, cos) = theta.sin_cos();
        Some(Vector3::new(sin * m.x / theta_d, sin * m.y / theta_d, cos))
    }
}
