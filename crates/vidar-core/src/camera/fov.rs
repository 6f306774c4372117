//! Field-of-view model (Devernay, Faugeras 2001). Parameters [fx, fy, cx, cy, ω].
//!
//! With r = √(X² + Y²): rd = atan2(2·r·tan(ω/2), Z)/ω, u = fx·rd·X/r + cx, v = fy·rd·Y/r + cy.
//! Domain: 0.0001 < ω < π (a smaller ω is a pinhole), Z > 0.

use super::parametric::invalid_intrinsics;
use super::{CameraError, InvalidExample, ParametricCamera, Pinhole, Pixel, finite};
use nalgebra::{Matrix2x3, RowVector3, SMatrix, Vector2, Vector3};

/// Intermediate values of a projection.
struct Radius {
    r: f64,
    /// 2·tan(ω/2).
    c: f64,
    /// rd/r.
    g: f64,
    on_axis: bool,
}

/// Field-of-view camera.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
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

    /// r and the factor g = rd/r; `None` outside the domain. On the axis the factor has the limit c/(ω Z).
    fn radius(&self, p: &Vector3<f64>) -> Option<Radius> {
        let r = (p.x * p.x + p.y * p.y).sqrt();
        if !(p.z > super::pinhole::MIN_Z && p.z.is_finite() && r.is_finite()) {
            return None;
        }
        let c = 2.0 * (0.5 * self.omega).tan();
        let on_axis = r < 1e-8 * p.z;
        let g = if on_axis { c / p.z } else { (c * r).atan2(p.z) / r } / self.omega;
        Some(Radius { r, c, g, on_axis })
    }

    fn pixel_of(&self, p: &Vector3<f64>, g: f64) -> Option<Pixel> {
        let k = &self.pinhole;
        finite(Vector2::new(k.fx * g * p.x + k.cx, k.fy * g * p.y + k.cy))
    }

    /// See [`super::CameraModel::project`].
    pub fn project(&self, p: &Vector3<f64>) -> Option<Pixel> {
        self.pixel_of(p, self.radius(p)?.g)
    }

    /// See [`super::CameraModel::project_with_jacobian`].
    pub fn project_with_jacobian(&self, p: &Vector3<f64>) -> Option<(Pixel, Matrix2x3<f64>)> {
        let Radius { r, c, g, on_axis } = self.radius(p)?;
        let pixel = self.pixel_of(p, g)?;
        let d_g = if on_axis {
            RowVector3::new(0.0, 0.0, -g / p.z)
        } else {
            let denominator = self.omega * (c * c * r * r + p.z * p.z);
            let d_rd_d_r = c * p.z / denominator;
            let d_rd_d_z = -c * r / denominator;
            let d_r = RowVector3::new(p.x / r, p.y / r, 0.0);
            d_r * ((d_rd_d_r - g) / r) + RowVector3::new(0.0, 0.0, d_rd_d_z / r)
        };
        let (fx, fy) = (self.pinhole.fx, self.pinhole.fy);
        let mut jacobian = Matrix2x3::zeros();
        jacobian.set_row(0, &((d_g * p.x + RowVector3::new(g, 0.0, 0.0)) * fx));
        jacobian.set_row(1, &((d_g * p.y + RowVector3::new(0.0, g, 0.0)) * fy));
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
        let direction = Vector3::new(m.x / rd * r, m.y / rd * r, 1.0).normalize();
        (direction.z > super::pinhole::MIN_Z).then_some(direction)
    }
}

impl ParametricCamera<5> for Fov {
    const PARAMETER_NAMES: [&'static str; 5] = ["fx", "fy", "cx", "cy", "omega"];

    fn parameters(&self) -> [f64; 5] {
        let [fx, fy, cx, cy] = self.pinhole.parameters();
        [fx, fy, cx, cy, self.omega]
    }

    fn from_parameters(parameters: &[f64; 5], width: usize, height: usize) -> Result<Self, CameraError> {
        let [fx, fy, cx, cy, omega] = *parameters;
        Self::new(Pinhole::new(fx, fy, cx, cy, width, height)?, omega)
    }

    fn project_with_parameter_jacobian(&self, p: &Vector3<f64>) -> Option<(Pixel, SMatrix<f64, 2, 5>)> {
        let Radius { r, c, g, .. } = self.radius(p)?;
        let pixel = self.pixel_of(p, g)?;
        // dc/dω = 1/cos²(ω/2) = 1 + c²/4; the atan2's part by c is Z·r/(c²r² + Z²), here over r.
        let d_angle = (1.0 + 0.25 * c * c) * p.z / (c * c * r * r + p.z * p.z);
        let d_g_d_omega = (d_angle - g) / self.omega;
        let (fx, fy) = (self.pinhole.fx, self.pinhole.fy);
        #[rustfmt::skip]
        let jacobian = SMatrix::<f64, 2, 5>::from_row_slice(&[
            g * p.x, 0.0, 1.0, 0.0, fx * p.x * d_g_d_omega,
            0.0, g * p.y, 0.0, 1.0, fy * p.y * d_g_d_omega,
        ]);
        Some((pixel, jacobian))
    }

    fn examples() -> Vec<Self> {
        let make = |p: &[f64; 5], width, height| Self::from_parameters(p, width, height).ok();
        [
            // TUM monoVO, wide lens, 1280x1024.
            make(&[685.7207, 685.6365, 630.8581, 511.9185, 0.897966326944875], 1280, 1024),
            make(&[300.0, 320.0, 330.0, 250.0, 2.0], 640, 480),
            make(&[300.0, 300.0, 320.0, 240.0, 0.01], 640, 480),
        ]
        .into_iter()
        .flatten()
        .collect()
    }

    fn invalid_examples() -> Vec<InvalidExample<5>> {
        let good = [685.0, 685.0, 630.0, 511.0, 0.9];
        let mut examples = invalid_intrinsics(good);
        for found in [0.0, -0.9, std::f64::consts::PI, f64::NAN] {
            examples.push(InvalidExample::of_parameter(good, 4, "omega", "in (0.0001, pi)", found));
        }
        examples
    }
}
