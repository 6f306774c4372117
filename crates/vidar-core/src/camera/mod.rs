//! Camera models: how a point in the camera frame becomes a pixel, and back.
//!
//! Pixel (0, 0) is the centre of the top-left pixel. Each model's file gives its formula, parameter order and domain.

mod double_sphere;
mod equidistant;
mod fov;
mod lens;
mod parametric;
mod pinhole;
mod radtan;

pub use double_sphere::DoubleSphere;
pub use equidistant::Equidistant;
pub use fov::Fov;
pub use lens::LensMotion;
pub use parametric::{InvalidExample, ParametricCamera};
pub use pinhole::Pinhole;
pub use radtan::RadTan;

use nalgebra::{Matrix2x3, Matrix2xX, Vector2, Vector3};
use thiserror::Error;

/// A pixel position, sub-pixel, `x` right and `y` down.
pub type Pixel = Vector2<f64>;

/// Why parameters are not a valid camera.
#[derive(Clone, Debug, PartialEq, Error)]
#[non_exhaustive]
pub enum CameraError {
    /// A parameter is outside its domain.
    #[error("camera {parameter} must be {expected}, found {found}")]
    BadParameter {
        /// Which parameter.
        parameter: &'static str,
        /// Its domain.
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
    /// A list of parameters has the wrong length for its model.
    #[error("a {model} camera has {expected} parameters, found {found}")]
    WrongParameterCount {
        /// Name of the model.
        model: &'static str,
        /// Parameters that the model has.
        expected: usize,
        /// Parameters given.
        found: usize,
    },
    /// No distortion-free view fits inside the camera's field of view.
    #[error(
        "no distortion-free view of {width}x{height} fits this camera (tried focal lengths up to {max_focal_px:.0} px)"
    )]
    NoUndistortedView {
        /// Columns of the requested view.
        width: usize,
        /// Rows of the requested view.
        height: usize,
        /// Longest focal length tried.
        max_focal_px: f64,
    },
}

/// The pixel, or `None` when a coordinate overflowed.
fn finite(pixel: Pixel) -> Option<Pixel> {
    (pixel.x.is_finite() && pixel.y.is_finite()).then_some(pixel)
}

/// Any supported camera model.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
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

    /// The pixel and `d_pixel_d_parameters`, one column per entry of [`CameraModel::parameters`].
    pub fn project_with_parameter_jacobian(
        &self,
        point_in_camera: &Vector3<f64>,
    ) -> Option<(Pixel, Matrix2xX<f64>)> {
        each_model!(self, m => {
            let (pixel, jacobian) = m.project_with_parameter_jacobian(point_in_camera)?;
            Some((pixel, Matrix2xX::from_column_slice(jacobian.as_slice())))
        })
    }

    /// The intrinsic parameters in the order of [`CameraModel::parameter_names`].
    pub fn parameters(&self) -> Vec<f64> {
        each_model!(self, m => m.parameters().to_vec())
    }

    /// Where the optical axis meets the image.
    pub fn principal_point(&self) -> Pixel {
        each_model!(self, m => {
            let parameters = m.parameters();
            Pixel::new(parameters[2], parameters[3])
        })
    }

    /// Focal lengths in x and y, px.
    pub fn focal_lengths(&self) -> Vector2<f64> {
        each_model!(self, m => {
            let parameters = m.parameters();
            Vector2::new(parameters[0], parameters[1])
        })
    }

    /// This camera with focal lengths `exp(log_focal)` times as long.
    ///
    /// # Errors
    /// They are not those of a camera.
    pub fn with_longer_focal(&self, log_focal: f64) -> Result<Self, CameraError> {
        let mut parameters = self.parameters();
        parameters[..2].iter_mut().for_each(|focal| *focal *= log_focal.exp());
        self.with_parameters(&parameters)
    }

    /// Names of the intrinsic parameters, fx, fy, cx, cy first.
    pub fn parameter_names(&self) -> &'static [&'static str] {
        match self {
            Self::Pinhole(_) => &Pinhole::PARAMETER_NAMES,
            Self::RadTan(_) => &RadTan::PARAMETER_NAMES,
            Self::Equidistant(_) => &Equidistant::PARAMETER_NAMES,
            Self::DoubleSphere(_) => &DoubleSphere::PARAMETER_NAMES,
            Self::Fov(_) => &Fov::PARAMETER_NAMES,
        }
    }

    /// A camera of the same model and size with other parameters.
    pub fn with_parameters(&self, parameters: &[f64]) -> Result<Self, CameraError> {
        self.with_parameters_and_size(parameters, self.width(), self.height())
    }

    /// A camera of the same model with other parameters, for images of `width` × `height`.
    pub fn with_parameters_and_size(
        &self,
        parameters: &[f64],
        width: usize,
        height: usize,
    ) -> Result<Self, CameraError> {
        fn build<const N: usize, M: ParametricCamera<N>>(
            of: &CameraModel,
            parameters: &[f64],
            (width, height): (usize, usize),
        ) -> Result<M, CameraError> {
            let parameters = parameters.try_into().map_err(|_| CameraError::WrongParameterCount {
                model: of.name(),
                expected: N,
                found: parameters.len(),
            })?;
            M::from_parameters(parameters, width, height)
        }
        let size = (width, height);
        match self {
            Self::Pinhole(_) => build(self, parameters, size).map(Self::Pinhole),
            Self::RadTan(_) => build(self, parameters, size).map(Self::RadTan),
            Self::Equidistant(_) => build(self, parameters, size).map(Self::Equidistant),
            Self::DoubleSphere(_) => build(self, parameters, size).map(Self::DoubleSphere),
            Self::Fov(_) => build(self, parameters, size).map(Self::Fov),
        }
    }

    /// The examples of every model, from real data sets.
    pub fn examples() -> Vec<Self> {
        let mut all: Vec<Self> = Pinhole::examples().into_iter().map(Self::Pinhole).collect();
        all.extend(RadTan::examples().into_iter().map(Self::RadTan));
        all.extend(Equidistant::examples().into_iter().map(Self::Equidistant));
        all.extend(DoubleSphere::examples().into_iter().map(Self::DoubleSphere));
        all.extend(Fov::examples().into_iter().map(Self::Fov));
        all
    }

    /// Whether it is a pinhole, or has distortion coefficients that are all zero.
    pub fn is_undistorted(&self) -> bool {
        match self {
            Self::Pinhole(_) => true,
            Self::RadTan(_) => self.parameters().iter().skip(4).all(|k| *k == 0.0),
            Self::Equidistant(_) | Self::DoubleSphere(_) | Self::Fov(_) => false,
        }
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
