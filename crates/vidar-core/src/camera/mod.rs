//! Camera models: how a point in the camera frame becomes a pixel, and back.
//!
//! Pixel (0, 0) is the centre of the top-left pixel. Each model's file gives its formula, parameter order and domain.

mod double_sphere;
mod equidistant;
mod fov;
mod pinhole;
mod radtan;

pub use double_sphere::DoubleSphere;
pub use equidistant::Equidistant;
pub use fov::Fov;
pub use pinhole::Pinhole;
pub use radtan::RadTan;

use nalgebra::{Matrix2x3, Vector2, Vector3};
use thiserror::Error;

/// A pixel position, sub-pixel, `x` right and `y` down.
pub type Pixel = Vector2<f64>;

/// Why numbers are not a camera.
#[derive(Clone, Debug, PartialEq, Error)]
#[non_exhaustive]
pub enum CameraError {
    /// A parameter is outside its domain.
    #[error("camera {parameter} must be {expected}, found {found}")]
    BadParameter {
        /// Which parameter.
        parameter: &'static str,
        /// What it must be.
        expected: &'static str,
        /// The value found.
        found: f64,
    },
    /// The image size is zero or absurd.
    #[error("image size must be 1 to 65535 in each direction, found {width}x{height}")]
    BadSize {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
    },
}

/// Any camera that VIDAR knows.
#[derive(Clone, Debug, PartialEq)]
pub enum CameraModel {
    /// No distortion.
    Pinhole(Pinhole),
    /// Radial-tangential (Brown-Conrady, OpenCV's first four).
    RadTan(RadTan),
    /// Equidistant fisheye (Kannala-Brandt with four terms, OpenCV fisheye).
    Equidistant(Equidistant),
    /// Double sphere (Usenko 2018).
    DoubleSphere(DoubleSphere),
    /// Field of view (Devernay-Faugeras 2001, PTAM's ATAN).
    Fov(Fov),
}

macro_rules! each_model {
    ($self:ident, $m:ident => $e:expr) => {
        match $self {
            CameraModel::Pinhole($m) => $e,
            CameraModel::RadTan($m) => $e,
            CameraModel::Equidistant($m) => $e,
            CameraModel::DoubleSphere($m) => $e,
            CameraModel::Fov($m) => $e,
        }
    };
}

impl CameraModel {
    /// The pixel of a point in the camera frame; `None` where the model does not hold for that direction.
    ///
    /// The pixel may lie outside the image: see [`CameraModel::contains`].
    pub fn project(&self, point_in_camera: &Vector3<f64>) -> Option<Pixel> {
        each_model!(self, m => m.project(point_in_camera))
    }

    /// The pixel and its derivative by the point.
    pub fn project_with_jacobian(&self, point_in_camera: &Vector3<f64>) -> Option<(Pixel, Matrix2x3<f64>)> {
        each_model!(self, m => m.project_with_jacobian(point_in_camera))
    }

    /// The unit direction in the camera frame that projects to `pixel`; `None` where there is none.
    pub fn unproject(&self, pixel: &Pixel) -> Option<Vector3<f64>> {
        each_model!(self, m => m.unproject(pixel))
    }

    /// Columns of the image.
    pub fn width(&self) -> usize {
        self.intrinsics().width
    }

    /// Rows of the image.
    pub fn height(&self) -> usize {
        self.intrinsics().height
    }

    /// The focal lengths, principal point and size; distortion left out.
    pub fn intrinsics(&self) -> &Pinhole {
        match self {
            Self::Pinhole(m) => m,
            Self::RadTan(m) => &m.pinhole,
            Self::Equidistant(m) => &m.pinhole,
            Self::DoubleSphere(m) => &m.pinhole,
            Self::Fov(m) => &m.pinhole,
        }
    }

    /// Whether `pixel` lies on the image, `margin_px` away from its border.
    pub fn contains(&self, pixel: &Pixel, margin_px: f64) -> bool {
        let (w, h) = (self.width() as f64, self.height() as f64);
        pixel.x >= margin_px - 0.5
            && pixel.y >= margin_px - 0.5
            && pixel.x <= w - 0.5 - margin_px
            && pixel.y <= h - 0.5 - margin_px
    }

    /// The model's name as EuRoC and Kalibr files write the pair of projection and distortion.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Pinhole(_) => "pinhole",
            Self::RadTan(_) => "pinhole-radtan",
            Self::Equidistant(_) => "pinhole-equidistant",
            Self::DoubleSphere(_) => "double-sphere",
            Self::Fov(_) => "fov",
        }
    }
}
