//! A recording: what is in it, and its sensor events in the order of time.

use crate::call::interruptible;
use crate::error::raise;
use crate::events::{Frame, object};
use crate::options::{INPUT_FLAGS, Keywords, flags, layered, open_options};
use crate::rig::Camera;
use crate::trajectory::Trajectory;
use numpy::{PyArray1, ToPyArray};
use pyo3::exceptions::PyIndexError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use pythonize::pythonize;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, PoisonError};
use vidar::core::Timestamp;
use vidar::dataset::{CalibrationSource, EventCursor};

/// A recording, opened: a bag, a video, or a folder in any layout that `vidar run` reads. Images stay on disk until asked for.
///
/// Recording(path, **options) takes the input options of the command line: format, camera, calibration (a path or a list),
/// topics, camera_model ("pinhole:fx,fy,cx,cy"), trajectory, trajectory_format, trajectory_body, imu (a path or a list), timestamps,
/// time_unit, depth_intrinsics (fx, fy, cx, cy), depth_scale, color_from_depth (4, 4), decoder, start and end (s), stride; and preset,
/// config and settings.
///
/// Iterating gives Frame, ImuSample, DepthImage and GroundTruth objects in the order of time.
#[pyclass(frozen, module = "vidar")]
pub struct Recording(pub Arc<vidar::dataset::Recording>);

#[pymethods]
impl Recording {
    #[new]
    #[pyo3(signature = (path, **options))]
    fn new(py: Python<'_>, path: PathBuf, options: Option<&Bound<'_, PyDict>>) -> PyResult<Self> {
        let keywords = Keywords::new(py, "Recording", options)?;
        let mut layered = layered(&keywords)?;
        flags(&keywords, &mut layered, &INPUT_FLAGS)?;
        let open = open_options(&keywords, &layered)?;
        keywords.finish()?;
        let config = layered.build().map_err(raise)?;
        let dataset = interruptible(py, None, |_, _| vidar::input::open_dataset(&path, &open, &config))?;
        Ok(Self(Arc::new(dataset)))
    }

    /// Its name.
    #[getter]
    fn name(&self) -> &str {
        &self.0.name
    }

    /// Its layout: "euroc", "bag", "video", ….
    #[getter]
    fn kind(&self) -> &str {
        self.0.kind.name()
    }

    /// Why this layout was chosen.
    #[getter]
    fn reason(&self) -> &str {
        &self.0.reason
    }

    /// The sensors, one dict each: what, count, start_secs, length_secs, rate_hz (median, or None), longest_gap_secs.
    #[getter]
    fn streams<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        Ok(pythonize(py, &vidar::inspect::streams(&self.0))?)
    }

    /// From the first to the last image or IMU sample, s.
    #[getter]
    fn duration(&self) -> f64 {
        let times = |first: Option<Timestamp>, last: Option<Timestamp>| first.zip(last);
        let images = times(self.0.images.first().map(|i| i.time), self.0.images.last().map(|i| i.time));
        let imu = times(self.0.imu.first().map(|s| s.time), self.0.imu.last().map(|s| s.time));
        let both = [images, imu].into_iter().flatten().reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)));
        both.map_or(0.0, |(first, last)| (last - first).as_secs_f64())
    }

    /// Number of the camera whose images are read.
    #[getter]
    fn camera(&self) -> u32 {
        self.0.camera.0
    }

    /// The cameras of the rig.
    #[getter]
    fn cameras(&self) -> Vec<Camera> {
        self.0.rig.cameras.iter().cloned().map(Camera).collect()
    }

    /// Noise of the IMU as a dict (see ImuNoise's arguments), or None where there is no IMU.
    #[getter]
    fn imu_noise<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        Ok(pythonize(py, &self.0.rig.imu)?)
    }

    /// Where the camera's model comes from: a file, "topic …", "flags", "dataset default", "recording" or "guessed".
    #[getter]
    fn calibration(&self) -> String {
        match &self.0.calibration {
            CalibrationSource::File(path) => path.display().to_string(),
            CalibrationSource::Topic(name) => format!("topic {name}"),
            CalibrationSource::Flags => "flags".into(),
            CalibrationSource::DatasetDefault => "dataset default".into(),
            CalibrationSource::Recording => "recording".into(),
            CalibrationSource::Guessed => "guessed".into(),
        }
    }

    /// Readout time of the rolling shutter, s, where the calibration states it.
    #[getter]
    fn readout(&self) -> Option<f64> {
        self.0.readout.map(|r| r.as_secs_f64())
    }

    /// Times of the images, int64 (N,), nanoseconds.
    #[getter]
    fn image_times_ns<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<i64>> {
        let times: Vec<i64> = self.0.images.iter().map(|i| i.time.nanos()).collect();
        PyArray1::from_vec(py, times)
    }

    /// All IMU samples at once: (times_ns int64 (N,), gyro float64 (N, 3) rad/s, accel float64 (N, 3) m/s²).
    #[getter]
    #[allow(clippy::type_complexity)] // three arrays
    fn imu<'py>(
        &self,
        py: Python<'py>,
    ) -> PyResult<(Bound<'py, PyArray1<i64>>, Bound<'py, PyAny>, Bound<'py, PyAny>)> {
        let times: Vec<i64> = self.0.imu.iter().map(|s| s.time.nanos()).collect();
        let gyro = self.0.imu.iter().map(|s| s.gyro.0.into()).collect();
        let accel = self.0.imu.iter().map(|s| s.accel.0.into()).collect();
        let rows = |v: Vec<[f64; 3]>| crate::arrays::rows(py, v).map(Bound::into_any);
        Ok((times.to_pyarray(py), rows(gyro)?, rows(accel)?))
    }

    /// Reference poses, or None.
    #[getter]
    fn ground_truth(&self) -> Option<Trajectory> {
        self.0.ground_truth.clone().map(Trajectory)
    }

    /// The metric trajectory that was given or is part of the recording, or None.
    #[getter]
    fn trajectory(&self) -> Option<Trajectory> {
        self.0.external_trajectory.as_ref().map(|t| Trajectory(t.trajectory.clone()))
    }

    /// A cloud of the scene to compare a map with (PLY), or None.
    #[getter]
    fn reference_cloud(&self) -> Option<PathBuf> {
        self.0.reference_cloud.clone()
    }

    /// What was found wrong, one dict each: severity, kind, message, place, hint.
    #[getter]
    fn warnings<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        Ok(pythonize(py, &self.0.warnings)?)
    }

    /// Image number `index` of those that are read, as a Frame.
    fn image(&self, py: Python<'_>, index: usize) -> PyResult<Frame> {
        let entry = self
            .0
            .images
            .get(index)
            .ok_or_else(|| PyIndexError::new_err(format!("image {index} of {}", self.0.images.len())))?;
        let image = py.detach(|| self.0.load_image(entry)).map_err(raise)?;
        let (id, time, camera) = (entry.frame_id, entry.time, entry.camera);
        Frame::of(py, vidar::core::Frame { id, time, camera, image })
    }

    fn __iter__(&self) -> EventIterator {
        EventIterator { dataset: self.0.clone(), cursor: Mutex::default() }
    }

    fn __repr__(&self) -> String {
        let (images, imu) = (self.0.images.len(), self.0.imu.len());
        format!("Recording({:?}, kind={:?}, {images} images, {imu} IMU samples)", self.0.name, self.kind())
    }
}

/// The events of a recording.
#[pyclass(frozen, module = "vidar")]
pub struct EventIterator {
    dataset: Arc<vidar::dataset::Recording>,
    cursor: Mutex<EventCursor>,
}

#[pymethods]
impl EventIterator {
    fn __iter__(slf: PyRef<'_, Self>) -> PyRef<'_, Self> {
        slf
    }

    fn __next__(&self, py: Python<'_>) -> PyResult<Option<Py<PyAny>>> {
        let next = py.detach(|| {
            let mut cursor = self.cursor.lock().unwrap_or_else(PoisonError::into_inner);
            self.dataset.next_event(&mut cursor)
        });
        next.transpose().map_err(raise)?.map(|event| object(py, event)).transpose()
    }
}
