//! Pinhole: `u = fx·X/Z + cx`, `v = fy·Y/Z + cy`, for Z > 0. Parameters [fx, fy, cx, cy].

use super::{CameraError, Pixel};
use nalgebra::{Matrix2x3, Matrix3, Vector2, Vector3};

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
        (p.z > MIN_Z).then(|| Vector2::new(self.fx * p.x / p.z + self.cx, self.fy * p.y / p.z + self.cy))
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
        ray.iter().all(|v| v.is_finite()).then(|| ray.normalize())
    }

    /// The direction of pixel `(x, y)` with z = 1, so that a point is `ray · depth`.
    pub fn ray(&self, x: f64, y: f64) -> Vector3<f64> {
        Vector3::new((x - self.cx) / self.fx, (y - self.cy) / self.fy, 1.0)
    }
}
