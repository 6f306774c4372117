//! Camera and IMU, as a calibration describes them.

use crate::arrays;
use crate::error::raise;
use numpy::{AllowTypeChange, PyArray2, PyArrayLike2};
use pyo3::prelude::*;
use std::collections::HashMap;
use vidar::core::{Duration, ImuNoise as Noise, RigCamera, Se3};
use vidar::dataset::{CameraFlag, with_size};

/// A camera on a rig.
///
/// Camera(model, width, height, *, body_from_camera=None, time_offset=0.0): `model` is what `--camera-model` takes, such as
/// "pinhole:fx,fy,cx,cy" or "radtan:fx,fy,cx,cy,k1,k2,p1,p2" (pixel (0, 0) is the centre of the top-left pixel).
/// `body_from_camera` (4, 4) maps points in the camera to the IMU's axes, metres; the default is the identity.
/// `time_offset` is t_imu − t_camera, s.
#[pyclass(frozen, module = "vidar", from_py_object)]
#[derive(Clone)]
pub struct Camera(pub RigCamera);

#[pymethods]
impl Camera {
    #[new]
    #[pyo3(signature = (model, width, height, *, body_from_camera = None, time_offset = 0.0))]
    fn new(
        model: &str,
        width: usize,
        height: usize,
        body_from_camera: Option<PyArrayLike2<'_, f64, AllowTypeChange>>,
        time_offset: f64,
    ) -> PyResult<Self> {
        let model = model.parse::<CameraFlag>().map_err(raise)?.0;
        let body_from_camera = match body_from_camera {
            Some(matrix) => arrays::se3("body_from_camera", &matrix.as_array())?,
            None => Se3::IDENTITY,
        };
        Ok(Self(RigCamera {
            model: with_size(&model, width, height).map_err(raise)?,
            body_from_camera,
            time_offset: Duration::from_secs_f64(time_offset),
            rate_hz: None,
        }))
    }

    /// The model as `--camera-model` takes it.
    #[getter]
    fn model(&self) -> String {
        CameraFlag(self.0.model.clone()).to_string()
    }

    /// Columns of its images.
    #[getter]
    fn width(&self) -> usize {
        self.0.model.width()
    }

    /// Rows of its images.
    #[getter]
    fn height(&self) -> usize {
        self.0.model.height()
    }

    /// Every parameter by name, fx, fy, cx, cy first; pixels.
    #[getter]
    fn parameters(&self) -> HashMap<&'static str, f64> {
        self.0.model.parameter_names().iter().copied().zip(self.0.model.parameters()).collect()
    }

    /// The linear part, float64 (3, 3), pixels.
    #[getter]
    fn matrix<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        arrays::matrix(py, &arrays::camera_matrix(&self.0.model))
    }

    /// Its pose on the body, float64 (4, 4), metres.
    #[getter]
    fn body_from_camera<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        arrays::matrix(py, &self.0.body_from_camera.matrix())
    }

    /// t_imu − t_camera, s.
    #[getter]
    fn time_offset(&self) -> f64 {
        self.0.time_offset.as_secs_f64()
    }

    fn __repr__(&self) -> String {
        format!("Camera({:?}, {}, {})", self.model(), self.width(), self.height())
    }
}

/// Noise of an IMU in continuous time, as Kalibr and EuRoC state it.
///
/// ImuNoise(gyro_noise_density, gyro_random_walk, accel_noise_density, accel_random_walk, rate_hz): rad/s/√Hz, rad/s²/√Hz,
/// m/s²/√Hz, m/s³/√Hz and Hz.
#[pyclass(frozen, module = "vidar", from_py_object)]
#[derive(Clone)]
pub struct ImuNoise(pub Noise);

#[pymethods]
impl ImuNoise {
    #[new]
    fn new(
        gyro_noise_density: f64,
        gyro_random_walk: f64,
        accel_noise_density: f64,
        accel_random_walk: f64,
        rate_hz: f64,
    ) -> Self {
        Self(Noise { gyro_noise_density, gyro_random_walk, accel_noise_density, accel_random_walk, rate_hz })
    }

    fn __repr__(&self) -> String {
        let n = &self.0;
        format!(
            "ImuNoise({}, {}, {}, {}, {})",
            n.gyro_noise_density, n.gyro_random_walk, n.accel_noise_density, n.accel_random_walk, n.rate_hz
        )
    }
}
