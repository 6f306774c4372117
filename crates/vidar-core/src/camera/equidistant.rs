//! Equidistant fisheye (Kannala-Brandt). Parameters [fx, fy, cx, cy, k1, k2, k3, k4].
//!
//! With r = √(X² + Y²), θ = atan2(r, Z), θd = θ·(1 + k1·θ² + k2·θ⁴ + k3·θ⁶ + k4·θ⁸):
//! u = fx·θd·X/r + cx, v = fy·θd·Y/r + cy. Domain: any direction whose θ lies where θd grows, θ < π; so points
//! beside and behind the camera project too.
//! Reference: Kannala, Brandt, PAMI 2006; OpenCV's and Kalibr's four-term form.

use super::parametric::invalid_intrinsics;
use super::{CameraError, InvalidExample, ParametricCamera, Pinhole, Pixel, finite};
use nalgebra::{Matrix2x3, RowVector3, SMatrix, Vector2, Vector3};
use std::f64::consts::PI;

/// Intermediate values of a projection.
struct Direction {
    r: f64,
    norm2: f64,
    theta: f64,
    /// dθd/dθ.
    slope: f64,
    /// θd/r.
    g: f64,
    on_axis: bool,
}

/// Equidistant fisheye with four terms.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
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
        let mut camera = Self { pinhole, distortion, max_theta: PI };
        let grows = |theta: f64| camera.radius(theta).1 > 0.0;
        // A fine scan finds the first fold and bisection its place; the slope has degree eight and no closed root.
        let at = |step: u32| PI * f64::from(step) / 4096.0;
        if let Some(first) = (1..=4096).find(|&step| !grows(at(step))) {
            let (mut low, mut high) = (at(first - 1), at(first));
            for _ in 0..50 {
                let mid = 0.5 * (low + high);
                if grows(mid) { low = mid } else { high = mid }
            }
            camera.max_theta = low;
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

    /// What a projection needs: r, |p|², θ and the factor g = θd/r; `None` outside the domain.
    fn direction(&self, p: &Vector3<f64>) -> Option<Direction> {
        let r = (p.x * p.x + p.y * p.y).sqrt();
        let norm2 = r * r + p.z * p.z;
        if !(norm2 > super::pinhole::MIN_Z * super::pinhole::MIN_Z && norm2.is_finite()) {
            return None;
        }
        let theta = r.atan2(p.z);
        // On the axis θd/r has the limit 1/Z in front, and none behind.
        let on_axis = r < 1e-8 * norm2.sqrt();
        if theta >= self.max_theta || (on_axis && p.z < 0.0) {
            return None;
        }
        let (theta_d, slope) = self.radius(theta);
        let g = if on_axis { 1.0 / p.z } else { theta_d / r };
        Some(Direction { r, norm2, theta, slope, g, on_axis })
    }

    fn pixel_of(&self, p: &Vector3<f64>, g: f64) -> Option<Pixel> {
        let k = &self.pinhole;
        finite(Vector2::new(k.fx * g * p.x + k.cx, k.fy * g * p.y + k.cy))
    }

    /// See [`super::CameraModel::project`].
    pub fn project(&self, p: &Vector3<f64>) -> Option<Pixel> {
        self.pixel_of(p, self.direction(p)?.g)
    }

    /// See [`super::CameraModel::project_with_jacobian`].
    pub fn project_with_jacobian(&self, p: &Vector3<f64>) -> Option<(Pixel, Matrix2x3<f64>)> {
        let Direction { r, norm2, slope, g, on_axis, .. } = self.direction(p)?;
        let pixel = self.pixel_of(p, g)?;
        let d_g = if on_axis {
            RowVector3::new(0.0, 0.0, -g / p.z)
        } else {
            // ∂θ/∂(X,Y,Z) = [X Z/(r n²), Y Z/(r n²), −r/n²].
            let d_theta = RowVector3::new(p.x * p.z / (r * norm2), p.y * p.z / (r * norm2), -r / norm2);
            let d_r = RowVector3::new(p.x / r, p.y / r, 0.0);
            d_theta * (slope / r) - d_r * (g / r)
        };
        let (fx, fy) = (self.pinhole.fx, self.pinhole.fy);
        let mut jacobian = Matrix2x3::zeros();
        jacobian.set_row(0, &((d_g * p.x + RowVector3::new(g, 0.0, 0.0)) * fx));
        jacobian.set_row(1, &((d_g * p.y + RowVector3::new(0.0, g, 0.0)) * fy));
        Some((pixel, jacobian))
    }

    /// See [`super::CameraModel::unproject`]. Newton's method on θ safeguarded by bisection.
    pub fn unproject(&self, pixel: &Pixel) -> Option<Vector3<f64>> {
        let k = &self.pinhole;
        let m = Vector2::new((pixel.x - k.cx) / k.fx, (pixel.y - k.cy) / k.fy);
        let theta_d = m.norm();
        if !(theta_d.is_finite() && theta_d < self.radius(self.max_theta).0) {
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

impl ParametricCamera<8> for Equidistant {
    const PARAMETER_NAMES: [&'static str; 8] = ["fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"];

    fn parameters(&self) -> [f64; 8] {
        let ([fx, fy, cx, cy], [k1, k2, k3, k4]) = (self.pinhole.parameters(), self.distortion);
        [fx, fy, cx, cy, k1, k2, k3, k4]
    }

    fn from_parameters(parameters: &[f64; 8], width: usize, height: usize) -> Result<Self, CameraError> {
        let [fx, fy, cx, cy, k1, k2, k3, k4] = *parameters;
        Self::new(Pinhole::new(fx, fy, cx, cy, width, height)?, [k1, k2, k3, k4])
    }

    fn project_with_parameter_jacobian(&self, p: &Vector3<f64>) -> Option<(Pixel, SMatrix<f64, 2, 8>)> {
        let Direction { r, theta, g, on_axis, .. } = self.direction(p)?;
        let pixel = self.pixel_of(p, g)?;
        let (fx, fy) = (self.pinhole.fx, self.pinhole.fy);
        let mut jacobian = SMatrix::<f64, 2, 8>::zeros();
        (jacobian[(0, 0)], jacobian[(1, 1)]) = (g * p.x, g * p.y);
        (jacobian[(0, 2)], jacobian[(1, 3)]) = (1.0, 1.0);
        // ∂θd/∂kᵢ = θ^(2i+1).
        let mut power = theta;
        for i in 0..4 {
            power *= theta * theta;
            let share = if on_axis { 0.0 } else { power / r };
            (jacobian[(0, 4 + i)], jacobian[(1, 4 + i)]) = (fx * p.x * share, fy * p.y * share);
        }
        Some((pixel, jacobian))
    }

    fn examples() -> Vec<Self> {
        let make = |p: &[f64; 8], width, height| Self::from_parameters(p, width, height).ok();
        [
            // TUM-VI, 512x512.
            make(
                &[
                    190.97847715128717,
                    190.9733070521226,
                    254.93170605935475,
                    256.8974428996504,
                    0.0034823894022493434,
                    0.0007150348452162257,
                    -0.0020532361418706202,
                    0.00020293673591811182,
                ],
                512,
                512,
            ),
            // No distortion at all, and one that folds before 180 degrees.
            make(&[200.0, 210.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0], 640, 480),
            make(&[380.0, 380.0, 320.0, 240.0, -0.05, -0.01, 0.0, 0.0], 640, 480),
        ]
        .into_iter()
        .flatten()
        .collect()
    }

    fn invalid_examples() -> Vec<InvalidExample<8>> {
        let good = [191.0, 191.0, 255.0, 257.0, 0.003, 0.0007, -0.002, 0.0002];
        let mut examples = invalid_intrinsics(good);
        for (index, found) in [(4, f64::NAN), (5, f64::INFINITY), (6, f64::NAN), (7, f64::NEG_INFINITY)] {
            examples.push(InvalidExample::of_parameter(good, index, "distortion", "finite", found));
        }
        examples
    }
}
