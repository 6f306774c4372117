//! Double sphere (Usenko, Demmel, Cremers, 3DV 2018). Parameters [fx, fy, cx, cy, ξ, α].
//!
//! With d1 = |p|, z1 = ξ·d1 + Z, d2 = √(X² + Y² + z1²), n = α·d2 + (1 − α)·z1: u = fx·X/n + cx, v = fy·Y/n + cy.
//! Domain: α in [0, 1], ξ in (−1, 1] (beyond 1 two directions share a pixel), and the directions that the second
//! sphere maps one-to-one (`min_cosine`), which reach behind the camera.

use super::parametric::invalid_intrinsics;
use super::{CameraError, InvalidExample, ParametricCamera, Pinhole, Pixel, finite};
use nalgebra::{Matrix2x3, RowVector3, SMatrix, Vector2, Vector3};

/// Lengths along a projection.
struct Lengths {
    d1: f64,
    z1: f64,
    d2: f64,
    n: f64,
}

/// Double-sphere wide-angle camera.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
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
        if !(xi > -1.0 && xi <= 1.0) {
            return Err(CameraError::BadParameter { parameter: "xi", expected: "in (-1, 1]", found: xi });
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

    /// Smallest Z/|p| that projects.
    ///
    /// With β the angle at the second sphere's centre, the second stage is one-to-one for cos β > −w1 (eq. 44). The
    /// paper's eq. 43 turns that into a bound on Z by an expression that is exact only for ξ = 0 and for a strongly
    /// negative ξ lets the image fold; here the ray of cos β = −w1 is cut with the first sphere.
    fn min_cosine(&self) -> f64 {
        let (xi, alpha) = (self.xi, self.alpha);
        let w1 = if alpha <= 0.5 { alpha / (1.0 - alpha) } else { (1.0 - alpha) / alpha };
        let length = (1.0 - xi * xi * (1.0 - w1 * w1)).max(0.0).sqrt() - xi * w1;
        -w1 * length - xi
    }

    /// The lengths d1, z1, d2 and n of the head's formula; `None` outside the domain.
    fn lengths(&self, p: &Vector3<f64>) -> Option<Lengths> {
        let d1 = p.norm();
        if !(d1 > super::pinhole::MIN_Z && d1.is_finite() && p.z > self.min_cosine() * d1) {
            return None;
        }
        let z1 = self.xi * d1 + p.z;
        let d2 = (p.x * p.x + p.y * p.y + z1 * z1).sqrt();
        let (a, b) = (self.alpha * d2, (1.0 - self.alpha) * z1);
        // Behind the camera a and b nearly cancel: (a² − b²)/(a − b) without the difference of the large terms.
        let n = if z1 < 0.0 {
            let across = p.x * p.x + p.y * p.y;
            (self.alpha * self.alpha * across + (2.0 * self.alpha - 1.0) * z1 * z1) / (a - b)
        } else {
            a + b
        };
        (n > super::pinhole::MIN_Z * d1).then_some(Lengths { d1, z1, d2, n })
    }

    fn pixel_of(&self, p: &Vector3<f64>, n: f64) -> Option<Pixel> {
        let k = &self.pinhole;
        finite(Vector2::new(k.fx * p.x / n + k.cx, k.fy * p.y / n + k.cy))
    }

    /// See [`super::CameraModel::project`].
    pub fn project(&self, p: &Vector3<f64>) -> Option<Pixel> {
        self.pixel_of(p, self.lengths(p)?.n)
    }

    /// See [`super::CameraModel::project_with_jacobian`].
    pub fn project_with_jacobian(&self, p: &Vector3<f64>) -> Option<(Pixel, Matrix2x3<f64>)> {
        let Lengths { d1, z1, d2, n } = self.lengths(p)?;
        let pixel = self.pixel_of(p, n)?;
        let d_d1 = RowVector3::new(p.x, p.y, p.z) / d1;
        let d_z1 = d_d1 * self.xi + RowVector3::new(0.0, 0.0, 1.0);
        let d_d2 = (RowVector3::new(p.x, p.y, 0.0) + d_z1 * z1) / d2;
        let d_n = d_d2 * self.alpha + d_z1 * (1.0 - self.alpha);
        let (fx, fy) = (self.pinhole.fx, self.pinhole.fy);
        let mut jacobian = Matrix2x3::zeros();
        jacobian.set_row(0, &((RowVector3::new(1.0, 0.0, 0.0) - d_n * (p.x / n)) * (fx / n)));
        jacobian.set_row(1, &((RowVector3::new(0.0, 1.0, 0.0) - d_n * (p.y / n)) * (fy / n)));
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
        direction.try_normalize(1e-12).filter(|d| d.z > self.min_cosine())
    }
}

impl ParametricCamera<6> for DoubleSphere {
    const PARAMETER_NAMES: [&'static str; 6] = ["fx", "fy", "cx", "cy", "xi", "alpha"];

    fn parameters(&self) -> [f64; 6] {
        let [fx, fy, cx, cy] = self.pinhole.parameters();
        [fx, fy, cx, cy, self.xi, self.alpha]
    }

    fn from_parameters(parameters: &[f64; 6], width: usize, height: usize) -> Result<Self, CameraError> {
        let [fx, fy, cx, cy, xi, alpha] = *parameters;
        Self::new(Pinhole::new(fx, fy, cx, cy, width, height)?, xi, alpha)
    }

    fn project_with_parameter_jacobian(&self, p: &Vector3<f64>) -> Option<(Pixel, SMatrix<f64, 2, 6>)> {
        let Lengths { d1, z1, d2, n } = self.lengths(p)?;
        let pixel = self.pixel_of(p, n)?;
        let (x, y) = (p.x / n, p.y / n);
        let d_n_d_xi = d1 * (self.alpha * z1 / d2 + 1.0 - self.alpha);
        let d_n_d_alpha = d2 - z1;
        let (u, v) = (-self.pinhole.fx * x / n, -self.pinhole.fy * y / n);
        #[rustfmt::skip]
        let jacobian = SMatrix::<f64, 2, 6>::from_row_slice(&[
            x, 0.0, 1.0, 0.0, u * d_n_d_xi, u * d_n_d_alpha,
            0.0, y, 0.0, 1.0, v * d_n_d_xi, v * d_n_d_alpha,
        ]);
        Some((pixel, jacobian))
    }

    fn examples() -> Vec<Self> {
        let make = |p: &[f64; 6], width, height| Self::from_parameters(p, width, height).ok();
        [
            // EuRoC's and TUM-VI's lenses in this model: both have a negative ξ.
            make(&[349.756, 348.725, 365.894, 249.33, -0.24096, 0.567], 752, 480),
            make(&[158.286, 158.274, 254.961, 256.889, -0.17213, 0.59312], 512, 512),
            // A fisheye beyond 180 degrees with positive ξ, and the limits: α = 0, and ξ = 0 (unified model).
            make(&[313.0, 313.0, 638.66, 514.39, 0.5, 0.64], 1280, 1024),
            make(&[300.0, 305.0, 320.0, 240.0, 0.3, 0.0], 640, 480),
            make(&[300.0, 305.0, 320.0, 240.0, 0.0, 0.5], 640, 480),
        ]
        .into_iter()
        .flatten()
        .collect()
    }

    fn invalid_examples() -> Vec<InvalidExample<6>> {
        let good = [158.0, 158.0, 255.0, 257.0, -0.17, 0.59];
        let mut examples = invalid_intrinsics(good);
        for found in [-1.0, 1.01, f64::NAN, f64::INFINITY] {
            examples.push(InvalidExample::of_parameter(good, 4, "xi", "in (-1, 1]", found));
        }
        for found in [-0.01, 1.01, f64::NAN] {
            examples.push(InvalidExample::of_parameter(good, 5, "alpha", "in [0, 1]", found));
        }
        examples
    }
}
