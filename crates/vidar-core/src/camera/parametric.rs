//! The parameters of a camera model: names, order, derivatives, valid and invalid examples for tests.

use super::{CameraError, Pixel};
use nalgebra::{SMatrix, Vector3};

/// A camera model with `N` intrinsic parameters, in the order that its file's head gives.
///
/// The first four are always fx, fy, cx, cy.
pub trait ParametricCamera<const N: usize>: Sized + Copy {
    /// Names of the parameters, in order.
    const PARAMETER_NAMES: [&'static str; N];

    /// The parameters, in order.
    fn parameters(&self) -> [f64; N];

    /// The camera with these parameters and an image of `width` × `height`.
    fn from_parameters(parameters: &[f64; N], width: usize, height: usize) -> Result<Self, CameraError>;

    /// The pixel of a point and `d_pixel_d_parameters`, for self-calibration.
    ///
    /// `None` exactly where [`super::CameraModel::project`] is `None`.
    fn project_with_parameter_jacobian(
        &self,
        point_in_camera: &Vector3<f64>,
    ) -> Option<(Pixel, SMatrix<f64, 2, N>)>;

    /// Cameras of this model from real data sets.
    fn examples() -> Vec<Self>;

    /// Invalid parameters, each with the error it must give.
    fn invalid_examples() -> Vec<InvalidExample<N>>;
}

/// Arguments of [`ParametricCamera::from_parameters`] that must be rejected.
#[derive(Clone, Debug, PartialEq)]
pub struct InvalidExample<const N: usize> {
    /// The parameters.
    pub parameters: [f64; N],
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// What is wrong with them.
    pub expected: CameraError,
}

impl<const N: usize> InvalidExample<N> {
    /// `good` with the parameter at `index` replaced by `found`, which must be rejected as not `expected`.
    pub(super) fn of_parameter(
        good: [f64; N],
        index: usize,
        parameter: &'static str,
        expected: &'static str,
        found: f64,
    ) -> Self {
        let mut parameters = good;
        parameters[index] = found;
        let expected = CameraError::BadParameter { parameter, expected, found };
        Self { parameters, width: 640, height: 480, expected }
    }
}

/// The invalid focal lengths, principal points and sizes that every model must reject.
pub(super) fn invalid_intrinsics<const N: usize>(good: [f64; N]) -> Vec<InvalidExample<N>> {
    let names = ["fx", "fy", "cx", "cy"];
    let mut examples = Vec::new();
    for found in [0.0, -458.0, f64::NAN, f64::INFINITY] {
        for index in 0..2 {
            let expected = "finite and positive";
            examples.push(InvalidExample::of_parameter(good, index, names[index], expected, found));
        }
    }
    for found in [f64::NAN, f64::NEG_INFINITY] {
        for index in 2..4 {
            examples.push(InvalidExample::of_parameter(good, index, names[index], "finite", found));
        }
    }
    for (width, height) in [(0, 480), (640, 0), (65_536, 480), (640, usize::MAX)] {
        let expected = CameraError::BadSize { width, height };
        examples.push(InvalidExample { parameters: good, width, height, expected });
    }
    examples
}
