//! Pinhole: `u = fx·X/Z + cx`, `v = fy·Y/Z + cy`, for Z > 0. Parameters [fx, fy, cx, cy].

use super::parametric::invalid_intrinsics;
use super::{CameraError, InvalidExample, ParametricCamera, Pixel, finite};
use nalgebra::{Matrix2x3, Matrix2x4, Matrix3, Vector2, Vector3};

/// A distortion-free camera.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Pinhole {
    /// Focal length along x, pixels.
    pub fx: f64,
    /// Focal length along y, pixels.
    pub fy: f64,
    /// Principal point, x, pixels.
    pub cx: f64,
    /// Principal point, y, pixels.
    pub cy: f64,
    /// Columns of the image.
    pub width: usize,
    /// Rows of the image.
    pub height: usize,
}

/// Smallest z (m, or chunk units) in front of the camera that still projects.
pub(crate) const MIN_Z: f64 = 1e-9;

impl Pinhole {
    /// Checks the parameters: finite, focal lengths positive, size 1 to 65535.
    pub fn new(fx: f64, fy: f64, cx: f64, cy: f64, width: usize, height: usize) -> Result<Self, CameraError> {
        let size = 1..=65_535;
        if !size.contains(&width) || !size.contains(&height) {
            return Err(CameraError::BadSize { width, height });
        }
        for (parameter, found) in [("fx", fx), ("fy", fy)] {
            if !(found.is_finite() && found > 0.0) {
                return Err(CameraError::BadParameter { parameter, expected: "finite and positive", found });
            }
        }
        for (parameter, found) in [("cx", cx), ("cy", cy)] {
            if !found.is_finite() {
                return Err(CameraError::BadParameter { parameter, expected: "finite", found });
            }
        }
        Ok(Self { fx, fy, cx, cy, width, height })
    }

    /// `[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]`.
    pub fn matrix(&self) -> Matrix3<f64> {
        Matrix3::new(self.fx, 0.0, self.cx, 0.0, self.fy, self.cy, 0.0, 0.0, 1.0)
    }

    /// The intrinsics of the same view resized to `width` × `height`: `c' = (c + 0.5)·s − 0.5`.
    pub fn resized(&self, width: usize, height: usize) -> Result<Self, CameraError> {
        let (sx, sy) = (width as f64 / self.width as f64, height as f64 / self.height as f64);
        Self::new(
            self.fx * sx,
            self.fy * sy,
            (self.cx + 0.5) * sx - 0.5,
            (self.cy + 0.5) * sy - 0.5,
            width,
            height,
        )
    }

    /// The intrinsics of the view cut to `width` × `height` with its corner at `(left, top)`.
    pub fn cropped(&self, left: usize, top: usize, width: usize, height: usize) -> Result<Self, CameraError> {
        Self::new(self.fx, self.fy, self.cx - left as f64, self.cy - top as f64, width, height)
    }

    /// See [`super::CameraModel::project`].
    pub fn project(&self, p: &Vector3<f64>) -> Option<Pixel> {
        if !(p.z > MIN_Z && p.z.is_finite()) {
            return None;
        }
        finite(Vector2::new(self.fx * p.x / p.z + self.cx, self.fy * p.y / p.z + self.cy))
    }

    /// See [`super::CameraModel::project_with_jacobian`].
    pub fn project_with_jacobian(&self, p: &Vector3<f64>) -> Option<(Pixel, Matrix2x3<f64>)> {
        let pixel = self.project(p)?;
        let iz = 1.0 / p.z;
        let d_pixel_d_point = Matrix2x3::new(
            self.fx * iz,
            0.0,
            -self.fx * p.x * iz * iz,
            0.0,
            self.fy * iz,
            -self.fy * p.y * iz * iz,
        );
        Some((pixel, d_pixel_d_point))
    }

    /// See [`super::CameraModel::unproject`].
    pub fn unproject(&self, pixel: &Pixel) -> Option<Vector3<f64>> {
        let ray = self.ray(pixel.x, pixel.y);
        let norm = ray.norm();
        norm.is_finite().then(|| ray / norm)
    }

    /// The direction of pixel `(x, y)` with z = 1, so that a point is `ray · depth`.
    pub fn ray(&self, x: f64, y: f64) -> Vector3<f64> {
        Vector3::new((x - self.cx) / self.fx, (y - self.cy) / self.fy, 1.0)
    }
}

impl ParametricCamera<4> for Pinhole {
    const PARAMETER_NAMES: [&'static str; 4] = ["fx", "fy", "cx", "cy"];

    fn parameters(&self) -> [f64; 4] {
        [self.fx, self.fy, self.cx, self.cy]
    }

    fn from_parameters(parameters: &[f64; 4], width: usize, height: usize) -> Result<Self, CameraError> {
        let [fx, fy, cx, cy] = *parameters;
        Self::new(fx, fy, cx, cy, width, height)
    }

    fn project_with_parameter_jacobian(&self, p: &Vector3<f64>) -> Option<(Pixel, Matrix2x4<f64>)> {
        let pixel = self.project(p)?;
        let (x, y) = (p.x / p.z, p.y / p.z);
        Some((pixel, Matrix2x4::new(x, 0.0, 1.0, 0.0, 0.0, y, 0.0, 1.0)))
    }

    fn examples() -> Vec<Self> {
        vec![
            // TUM RGB-D fr3, already rectified.
            Self { fx: 535.4, fy: 539.2, cx: 320.1, cy: 247.6, width: 640, height: 480 },
            // 7-Scenes depth camera.
            Self { fx: 585.0, fy: 585.0, cx: 320.0, cy: 240.0, width: 640, height: 480 },
            // A corner cut out of a wide view: the principal point lies outside.
            Self { fx: 90.0, fy: 110.0, cx: -12.25, cy: 70.5, width: 33, height: 47 },
        ]
    }

    fn invalid_examples() -> Vec<InvalidExample<4>> {
        invalid_intrinsics([585.0, 585.0, 320.0, 240.0])
    }
}
