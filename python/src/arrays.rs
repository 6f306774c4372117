//! NumPy arrays to VIDAR's types and back. What leaves is moved, not copied; what enters is copied once, because the
//! libraries own what they work on.

use nalgebra::{Matrix3, Matrix4, SMatrix, Vector3};
use numpy::ndarray::{ArrayView1, ArrayView2, ArrayView3};
use numpy::{
    AllowTypeChange, Element, PyArray1, PyArray2, PyArray3, PyArrayLike2, PyArrayLike3, PyArrayMethods,
    PyReadonlyArray2, PyReadonlyArray3,
};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use vidar::core::{CameraModel, FrameImage, Image, Pinhole, Se3};

/// An exception of an argument of the wrong shape.
pub fn shape_error(what: &str, expected: &str, found: &[usize]) -> PyErr {
    PyValueError::new_err(format!("{what} must have shape {expected}, found {found:?}"))
}

/// A rigid motion from a 4×4 (or 3×4) matrix.
pub fn se3(what: &str, matrix: &ArrayView2<'_, f64>) -> PyResult<Se3> {
    let (rows, columns) = matrix.dim();
    if !(3..=4).contains(&rows) || columns != 4 {
        return Err(shape_error(what, "(4, 4)", matrix.shape()));
    }
    let full = Matrix4::from_fn(|r, c| match r < 3 {
        true => matrix[[r, c]],
        false => f64::from(u8::from(c == 3)),
    });
    Se3::from_matrix(&full).ok_or_else(|| {
        PyValueError::new_err(format!("{what} is not a rigid motion: its rotation must be orthonormal"))
    })
}

/// Rigid motions from an array (N, 4, 4).
pub fn se3s(what: &str, value: &Bound<'_, PyAny>) -> PyResult<Vec<Se3>> {
    let array: PyArrayLike3<'_, f64, AllowTypeChange> = value
        .extract()
        .map_err(|_| PyTypeError::new_err(format!("{what} must be numbers of shape (N, 4, 4)")))?;
    array.as_array().outer_iter().map(|m| se3(what, &m)).collect()
}

/// A square matrix from an array.
pub fn matrix3(what: &str, matrix: &ArrayView2<'_, f64>) -> PyResult<Matrix3<f64>> {
    match matrix.dim() {
        (3, 3) => Ok(Matrix3::from_fn(|r, c| matrix[[r, c]])),
        _ => Err(shape_error(what, "(3, 3)", matrix.shape())),
    }
}

/// Pinhole cameras from one 3×3 matrix or `n` of them, for images of `width` × `height`.
pub fn pinholes(
    value: &Bound<'_, PyAny>,
    n: usize,
    (width, height): (usize, usize),
) -> PyResult<Vec<Pinhole>> {
    let pinhole = |k: &ArrayView2<'_, f64>| {
        let k = matrix3("intrinsics", k)?;
        let pinhole = Pinhole::new(k[(0, 0)], k[(1, 1)], k[(0, 2)], k[(1, 2)], width, height);
        pinhole.map_err(crate::error::raise)
    };
    if let Ok(one) = value.extract::<PyArrayLike2<'_, f64, AllowTypeChange>>() {
        return Ok(vec![pinhole(&one.as_array())?; n]);
    }
    let all: PyArrayLike3<'_, f64, AllowTypeChange> = value
        .extract()
        .map_err(|_| PyTypeError::new_err("intrinsics must be numbers of shape (3, 3) or (N, 3, 3)"))?;
    let all = all.as_array();
    if all.dim().0 != n {
        return Err(shape_error("intrinsics", &format!("(3, 3) or ({n}, 3, 3)"), all.shape()));
    }
    all.outer_iter().map(|k| pinhole(&k)).collect()
}

/// Three numbers.
pub fn vector3(what: &str, vector: &ArrayView1<'_, f64>) -> PyResult<Vector3<f64>> {
    match vector.as_standard_layout().as_slice() {
        Some(&[x, y, z]) => Ok(Vector3::new(x, y, z)),
        _ => Err(shape_error(what, "(3,)", vector.shape())),
    }
}

/// Points (N, 3) in any float type.
pub fn points(what: &str, value: &Bound<'_, PyAny>) -> PyResult<Vec<Vector3<f64>>> {
    let wrong = || PyTypeError::new_err(format!("{what} must be numbers of shape (N, 3)"));
    let array: PyArrayLike2<'_, f64, AllowTypeChange> = value.extract().map_err(|_| wrong())?;
    let array = array.as_array();
    if array.dim().1 != 3 {
        return Err(shape_error(what, "(N, 3)", array.shape()));
    }
    Ok(array.outer_iter().map(|p| Vector3::new(p[0], p[1], p[2])).collect())
}

/// Rows of three, copied row by row.
pub fn triplets<T: Element + Copy>(what: &str, array: &PyReadonlyArray2<'_, T>) -> PyResult<Vec<[T; 3]>> {
    let array = array.as_array();
    if array.dim().1 != 3 {
        return Err(shape_error(what, "(N, 3)", array.shape()));
    }
    Ok(array.outer_iter().map(|p| [p[0], p[1], p[2]]).collect())
}

/// An image from an array (H, W) or (H, W, 3).
pub fn frame_image(value: &Bound<'_, PyAny>) -> PyResult<FrameImage> {
    if let Ok(gray) = value.extract::<PyReadonlyArray2<'_, u8>>() {
        return image(&gray.as_array()).map(FrameImage::Gray8);
    }
    if let Ok(gray) = value.extract::<PyReadonlyArray2<'_, u16>>() {
        return image(&gray.as_array()).map(FrameImage::Gray16);
    }
    if let Ok(color) = value.extract::<PyReadonlyArray3<'_, u8>>() {
        return rgb("pixels", &color.as_array()).map(FrameImage::Rgb8);
    }
    Err(PyTypeError::new_err(
        "pixels must be uint8 or uint16 of shape (H, W), or uint8 RGB of shape (H, W, 3)",
    ))
}

/// An image of one channel.
pub fn image<T: Copy>(array: &ArrayView2<'_, T>) -> PyResult<Image<T>> {
    let (height, width) = array.dim();
    let data = match array.as_slice() {
        Some(pixels) => pixels.to_vec(),
        None => array.iter().copied().collect(),
    };
    Image::from_vec(width, height, data).map_err(|e| PyValueError::new_err(e.to_string()))
}

/// An image of three channels.
pub fn rgb(what: &str, array: &ArrayView3<'_, u8>) -> PyResult<Image<[u8; 3]>> {
    let (height, width, channels) = array.dim();
    if channels != 3 {
        return Err(shape_error(what, "(H, W, 3)", array.shape()));
    }
    let data = match array.as_slice() {
        Some(pixels) => pixels.as_chunks::<3>().0.to_vec(),
        None => array.rows().into_iter().map(|p| [p[0], p[1], p[2]]).collect(),
    };
    Image::from_vec(width, height, data).map_err(|e| PyValueError::new_err(e.to_string()))
}

/// Pixels as an array, moved.
pub fn pixels(py: Python<'_>, image: FrameImage) -> PyResult<Py<PyAny>> {
    let (width, height) = (image.width(), image.height());
    Ok(match image {
        FrameImage::Gray8(gray) => plane(py, gray)?.into_any(),
        FrameImage::Gray16(gray) => plane(py, gray)?.into_any(),
        FrameImage::Rgb8(color) => {
            let flat = PyArray1::from_vec(py, color.into_vec().into_flattened());
            flat.reshape([height, width, 3])?.into_any()
        }
    }
    .unbind())
}

/// One channel as an array (H, W), moved.
pub fn plane<T: Element>(py: Python<'_>, image: Image<T>) -> PyResult<Bound<'_, PyArray2<T>>> {
    let (width, height) = (image.width(), image.height());
    PyArray1::from_vec(py, image.into_vec()).reshape([height, width])
}

/// Images of one size as an array (N, H, W).
pub fn stack<T: Element + Copy>(py: Python<'_>, images: Vec<Image<T>>) -> PyResult<Bound<'_, PyArray3<T>>> {
    let n = images.len();
    let (width, height) = images.first().map_or((0, 0), |i| (i.width(), i.height()));
    let mut data = Vec::with_capacity(n * width * height);
    images.iter().for_each(|i| data.extend_from_slice(i.data()));
    PyArray1::from_vec(py, data).reshape([n, height, width])
}

/// Rows of three as an array (N, 3), moved.
pub fn rows<T: Element>(py: Python<'_>, triplets: Vec<[T; 3]>) -> PyResult<Bound<'_, PyArray2<T>>> {
    let n = triplets.len();
    PyArray1::from_vec(py, triplets.into_flattened()).reshape([n, 3])
}

/// A matrix of any size.
pub fn matrix<'py, const R: usize, const C: usize>(
    py: Python<'py>,
    matrix: &SMatrix<f64, R, C>,
) -> PyResult<Bound<'py, PyArray2<f64>>> {
    PyArray1::from_vec(py, matrix.transpose().as_slice().to_vec()).reshape([R, C])
}

/// Matrices of one size as an array (N, R, C).
pub fn matrices<'py, const R: usize, const C: usize>(
    py: Python<'py>,
    matrices: &[SMatrix<f64, R, C>],
) -> PyResult<Bound<'py, PyArray3<f64>>> {
    let data: Vec<f64> = matrices.iter().flat_map(|m| m.transpose().as_slice().to_vec()).collect();
    PyArray1::from_vec(py, data).reshape([matrices.len(), R, C])
}

/// The 3×3 matrix of the linear part of a camera.
pub fn camera_matrix(model: &CameraModel) -> Matrix3<f64> {
    model.intrinsics().matrix()
}
