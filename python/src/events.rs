//! Sensor events as Python objects.

use crate::arrays;
use numpy::{AllowTypeChange, PyArray2, PyArrayLike1, ToPyArray};
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use vidar::core::{
    AngularRate, CameraId, FrameId, ImuSample as Sample, SensorEvent, SpecificForce, Timestamp,
};

/// One image with its time.
///
/// Frame(frame, time_ns, pixels, *, camera=0): `pixels` are uint8 or uint16 of shape (H, W), or uint8 of shape (H, W, 3), red
/// first (OpenCV's images are blue first: `pixels[..., ::-1]`). `time_ns` is the middle of the exposure, nanoseconds.
#[pyclass(frozen, module = "vidar")]
pub struct Frame {
    /// Its number in the sequence.
    #[pyo3(get)]
    frame: u32,
    /// Time, nanoseconds.
    #[pyo3(get)]
    time_ns: i64,
    /// Number of its camera.
    #[pyo3(get)]
    camera: u32,
    /// uint8 or uint16 (H, W), or uint8 RGB (H, W, 3).
    #[pyo3(get)]
    pixels: Py<PyAny>,
}

#[pymethods]
impl Frame {
    #[new]
    #[pyo3(signature = (frame, time_ns, pixels, *, camera = 0))]
    fn new(frame: u32, time_ns: i64, pixels: Py<PyAny>, camera: u32) -> Self {
        Self { frame, time_ns, camera, pixels }
    }

    /// Time, seconds (a Unix time keeps about 200 ns).
    #[getter]
    fn time(&self) -> f64 {
        Timestamp::from_nanos(self.time_ns).as_secs_f64()
    }

    fn __repr__(&self, py: Python<'_>) -> String {
        let shape = self.pixels.getattr(py, "shape").map(|s| s.to_string()).unwrap_or_default();
        format!(
            "Frame(frame={}, time_ns={}, camera={}, shape={shape})",
            self.frame, self.time_ns, self.camera
        )
    }
}

impl Frame {
    /// A frame whose pixels move to NumPy.
    pub fn of(py: Python<'_>, frame: vidar::core::Frame) -> PyResult<Self> {
        let pixels = arrays::pixels(py, frame.image)?;
        Ok(Self { frame: frame.id.0, time_ns: frame.time.nanos(), camera: frame.camera.0, pixels })
    }
}

/// One measurement of an IMU.
///
/// ImuSample(time_ns, gyro, accel): angular rate in rad/s and specific force in m/s², three numbers each, in the IMU's axes, as
/// measured: biases and gravity's reaction included.
#[pyclass(frozen, module = "vidar")]
pub struct ImuSample(Sample);

#[pymethods]
impl ImuSample {
    #[new]
    fn new(
        time_ns: i64,
        gyro: PyArrayLike1<'_, f64, AllowTypeChange>,
        accel: PyArrayLike1<'_, f64, AllowTypeChange>,
    ) -> PyResult<Self> {
        Ok(Self(Sample {
            time: Timestamp::from_nanos(time_ns),
            gyro: AngularRate(arrays::vector3("gyro", &gyro.as_array())?),
            accel: SpecificForce(arrays::vector3("accel", &accel.as_array())?),
        }))
    }

    /// Time, nanoseconds.
    #[getter]
    fn time_ns(&self) -> i64 {
        self.0.time.nanos()
    }

    /// Time, seconds.
    #[getter]
    fn time(&self) -> f64 {
        self.0.time.as_secs_f64()
    }

    /// Angular rate (3,), rad/s.
    #[getter]
    fn gyro<'py>(&self, py: Python<'py>) -> Bound<'py, PyAny> {
        self.0.gyro.0.as_slice().to_pyarray(py).into_any()
    }

    /// Specific force (3,), m/s².
    #[getter]
    fn accel<'py>(&self, py: Python<'py>) -> Bound<'py, PyAny> {
        self.0.accel.0.as_slice().to_pyarray(py).into_any()
    }

    fn __repr__(&self) -> String {
        let [w, a] = [self.0.gyro.0, self.0.accel.0];
        format!(
            "ImuSample(time_ns={}, gyro=[{}, {}, {}], accel=[{}, {}, {}])",
            self.time_ns(),
            w.x,
            w.y,
            w.z,
            a.x,
            a.y,
            a.z
        )
    }
}

/// One image of a depth camera.
#[pyclass(frozen, module = "vidar")]
pub struct DepthImage {
    /// Time, nanoseconds.
    #[pyo3(get)]
    time_ns: i64,
    /// Number of the camera that it is registered to.
    #[pyo3(get)]
    camera: u32,
    /// z-depth, float32 (H, W), metres, NaN where there is none.
    #[pyo3(get)]
    depth: Py<PyArray2<f32>>,
}

/// A reference pose, for evaluation only.
#[pyclass(frozen, module = "vidar")]
pub struct GroundTruth {
    /// Time, nanoseconds.
    #[pyo3(get)]
    time_ns: i64,
    /// Pose of the body, float64 (4, 4), metres.
    #[pyo3(get)]
    world_from_body: Py<PyArray2<f64>>,
}

/// The Python object of an event.
pub fn object(py: Python<'_>, event: SensorEvent) -> PyResult<Py<PyAny>> {
    Ok(match event {
        SensorEvent::Image(frame) => Py::new(py, Frame::of(py, frame)?)?.into_any(),
        SensorEvent::Imu(sample) => Py::new(py, ImuSample(sample))?.into_any(),
        SensorEvent::Depth { time, camera, depth } => {
            let depth = arrays::plane(py, depth.image().clone())?.unbind();
            Py::new(py, DepthImage { time_ns: time.nanos(), camera: camera.0, depth })?.into_any()
        }
        SensorEvent::GroundTruth { time, world_from_body } => {
            let world_from_body = arrays::matrix(py, &world_from_body.matrix())?.unbind();
            Py::new(py, GroundTruth { time_ns: time.nanos(), world_from_body })?.into_any()
        }
    })
}

/// The event of a Python object; `None` for what an odometry does not use.
pub fn event(object: &Bound<'_, PyAny>) -> PyResult<Option<SensorEvent>> {
    if let Ok(sample) = object.cast::<ImuSample>() {
        return Ok(Some(SensorEvent::Imu(sample.get().0)));
    }
    if let Ok(frame) = object.cast::<Frame>() {
        let frame = frame.get();
        return Ok(Some(SensorEvent::Image(vidar::core::Frame {
            id: FrameId(frame.frame),
            time: Timestamp::from_nanos(frame.time_ns),
            camera: CameraId(frame.camera),
            image: arrays::frame_image(frame.pixels.bind(object.py()))?,
        })));
    }
    if object.is_instance_of::<DepthImage>() || object.is_instance_of::<GroundTruth>() {
        return Ok(None);
    }
    let message = format!("an event must be a Frame or an ImuSample, found {}", object.get_type().name()?);
    Err(PyTypeError::new_err(message))
}
