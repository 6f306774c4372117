//! Visual-inertial odometry: events in, one state per image out.

use crate::arrays;
use crate::call::interruptible;
use crate::error::raise;
use crate::events::event;
use crate::options::{Keywords, layered};
use crate::recording::Recording;
use crate::rig::{Camera, ImuNoise};
use numpy::{PyArray1, PyArray2, ToPyArray};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyType};
use std::sync::{Mutex, PoisonError};
use vidar::core::{CameraId, Rig};
use vidar::odometry_stage::{Odometry as Machine, OdometryOutput, Status, Tracking};

/// Visual-inertial odometry of one camera and one IMU, live: push Frame and ImuSample objects in the order of time.
///
/// Odometry(camera, imu=None, **settings): `camera` is a Camera, `imu` an ImuNoise; without one the poses are up to scale.
/// preset, config and settings ({"odometry.max_landmarks": 200}) are those of the command line.
#[pyclass(frozen, module = "vidar")]
pub struct Odometry(Mutex<Machine>);

#[pymethods]
impl Odometry {
    #[new]
    #[pyo3(signature = (camera, imu = None, **settings))]
    fn new(
        py: Python<'_>,
        camera: Camera,
        imu: Option<ImuNoise>,
        settings: Option<&Bound<'_, PyDict>>,
    ) -> PyResult<Self> {
        let keywords = Keywords::new(py, "Odometry", settings)?;
        let layered = layered(&keywords)?;
        keywords.finish()?;
        let config = layered.build().map_err(raise)?;
        let rig = Rig { cameras: vec![camera.0], imu: imu.map(|noise| noise.0) };
        Machine::new(&rig, CameraId(0), &config.odometry).map(|m| Self(Mutex::new(m))).map_err(raise)
    }

    /// The odometry of a recording, as `vidar odometry` makes it: with the recording's own rig, which is calibrated and
    /// synchronised first where the recording does not state it. Push the recording's events to it.
    #[classmethod]
    #[pyo3(signature = (recording, **settings))]
    fn of(
        _class: &Bound<'_, PyType>,
        py: Python<'_>,
        recording: &Recording,
        settings: Option<&Bound<'_, PyDict>>,
    ) -> PyResult<Self> {
        let keywords = Keywords::new(py, "Odometry.of", settings)?;
        let layered = layered(&keywords)?;
        keywords.finish()?;
        let mut config = layered.build().map_err(raise)?;
        let mut dataset = (*recording.0).clone();
        let machine = interruptible(py, None, |events, cancel| {
            vidar::odometry::prepare(&mut dataset, &mut config, events, cancel)?;
            Ok(Machine::new(&dataset.rig, dataset.camera, &config.odometry)?)
        })?;
        Ok(Self(Mutex::new(machine)))
    }

    /// Takes a Frame or an ImuSample; returns the State after the oldest image that waited for it, or None.
    ///
    /// An image is worked on when IMU samples past its time have come, so the state may belong to an earlier image. Depth
    /// images and ground truth are ignored.
    fn push(&self, py: Python<'_>, event: &Bound<'_, PyAny>) -> PyResult<Option<State>> {
        let Some(event) = self::event(event)? else { return Ok(None) };
        let output = py.detach(|| self.machine().push(event));
        Ok(output.map_err(raise)?.map(State))
    }

    /// Works on the images that still wait; their States.
    fn finish(&self, py: Python<'_>) -> Vec<State> {
        py.detach(|| self.machine().finish()).into_iter().map(State).collect()
    }

    /// What was taken and left out so far: images, imu_samples, images_out_of_order, imu_samples_rejected, images_repeated,
    /// imu_gaps.
    #[getter]
    fn counts<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let counts = self.machine().counts();
        let dict = PyDict::new(py);
        for (name, count) in [
            ("images", counts.images),
            ("imu_samples", counts.imu_samples),
            ("images_out_of_order", counts.images_out_of_order),
            ("imu_samples_rejected", counts.imu_samples_rejected),
            ("images_repeated", counts.images_repeated),
            ("imu_gaps", counts.imu_gaps),
        ] {
            dict.set_item(name, count)?;
        }
        Ok(dict)
    }
}

impl Odometry {
    fn machine(&self) -> std::sync::MutexGuard<'_, Machine> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// What is known after one image. Arrays are None where there is no state.
#[pyclass(frozen, module = "vidar")]
pub struct State(OdometryOutput);

impl State {
    fn tracking(&self) -> Option<&Tracking> {
        self.0.tracking()
    }
}

#[pymethods]
impl State {
    /// Number of the image.
    #[getter]
    fn frame(&self) -> u32 {
        self.0.frame_id.0
    }

    /// Time of the image, nanoseconds.
    #[getter]
    fn time_ns(&self) -> i64 {
        self.0.time.nanos()
    }

    /// Time of the image, s.
    #[getter]
    fn time(&self) -> f64 {
        self.0.time.as_secs_f64()
    }

    /// "waiting", "tracking" or "lost".
    #[getter]
    fn status(&self) -> &'static str {
        match &self.0.status {
            Status::Waiting(_) => "waiting",
            Status::Tracking(_) => "tracking",
            Status::Lost(_) => "lost",
        }
    }

    /// "ok", "scale-converging", "scale-unknown", "low-features", "degraded", "suspect" or "lost".
    #[getter]
    fn health(&self) -> &'static str {
        self.0.health().as_str()
    }

    /// Whether lengths are metres and images support the state.
    #[getter]
    fn is_metric(&self) -> bool {
        self.0.health().is_metric()
    }

    /// What is missing for a start, or why the state was lost; None while tracking.
    #[getter]
    fn reason(&self) -> Option<String> {
        match &self.0.status {
            Status::Waiting(failure) => Some(failure.to_string()),
            Status::Tracking(_) => None,
            Status::Lost(reason) => Some(reason.to_string()),
        }
    }

    /// Counts worlds: poses of different segments cannot be compared.
    #[getter]
    fn segment(&self) -> Option<u32> {
        self.tracking().map(|t| t.segment)
    }

    /// Pose of the body (IMU), float64 (4, 4), metres; z is up.
    #[getter]
    fn world_from_body<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyArray2<f64>>>> {
        self.tracking().map(|t| arrays::matrix(py, &t.state.world_from_body.matrix())).transpose()
    }

    /// Velocity in the world, float64 (3,), m/s.
    #[getter]
    fn velocity<'py>(&self, py: Python<'py>) -> Option<Bound<'py, PyArray1<f64>>> {
        self.tracking().map(|t| t.state.velocity_in_world.as_slice().to_pyarray(py))
    }

    /// Bias of the gyroscope, float64 (3,), rad/s.
    #[getter]
    fn gyro_bias<'py>(&self, py: Python<'py>) -> Option<Bound<'py, PyArray1<f64>>> {
        self.tracking().map(|t| t.state.gyro_bias.as_slice().to_pyarray(py))
    }

    /// Bias of the accelerometer, float64 (3,), m/s².
    #[getter]
    fn accel_bias<'py>(&self, py: Python<'py>) -> Option<Bound<'py, PyArray1<f64>>> {
        self.tracking().map(|t| t.state.accel_bias.as_slice().to_pyarray(py))
    }

    /// Covariance, float64 (15, 15), relative to the first pose of the segment: rotation in the body (rad), position in the
    /// world (m), velocity in the world (m/s), gyroscope bias (rad/s), accelerometer bias (m/s²), three numbers each.
    #[getter]
    fn covariance<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyArray2<f64>>>> {
        self.tracking().map(|t| arrays::matrix(py, &t.covariance)).transpose()
    }

    /// Standard deviation of ln(scale); infinite while lengths are not metres.
    #[getter]
    fn scale_std(&self) -> Option<f64> {
        self.tracking().map(|t| t.scale_std)
    }

    /// Whether the image became a keyframe.
    #[getter]
    fn is_keyframe(&self) -> bool {
        self.tracking().is_some_and(|t| t.keyframe.is_some())
    }

    /// Landmarks in the image, float64 (N, 4): pixel x, pixel y, inverse z-depth (1/m), its standard deviation.
    #[getter]
    fn landmarks<'py>(&self, py: Python<'py>) -> PyResult<Option<Bound<'py, PyArray2<f64>>>> {
        use numpy::PyArrayMethods;
        let Some(tracking) = self.tracking() else { return Ok(None) };
        let rows = tracking.landmarks.iter();
        let data: Vec<f64> =
            rows.flat_map(|l| [l.pixel.x, l.pixel.y, l.inverse_depth, l.inverse_depth_std]).collect();
        PyArray1::from_vec(py, data).reshape([tracking.landmarks.len(), 4]).map(Some)
    }

    fn __repr__(&self) -> String {
        format!("State(frame={}, time_ns={}, health={:?})", self.frame(), self.time_ns(), self.health())
    }
}
