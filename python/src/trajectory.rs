//! Trajectories and their alignment.

use crate::arrays;
use crate::error::raise;
use crate::options::{Keywords, trajectory_options};
use nalgebra::Vector3;
use numpy::{AllowTypeChange, PyArray1, PyArray2, PyArray3, PyArrayLike1, PyArrayMethods};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyType};
use std::path::PathBuf;
use vidar::core::{
    LieGroup, Sim3, StampedPose, Timestamp, Trajectory as Poses, umeyama_se3, umeyama_sim3,
    umeyama_sim3_weighted,
};
use vidar::dataset::{body_named, read_trajectory};
use vidar::eval::EvalError;
use vidar::export_formats as export;

/// Poses of one body of the rig, strictly increasing in time.
///
/// Trajectory(times_ns, world_from_body, *, body="imu"): int64 (N,) nanoseconds and float64 (N, 4, 4), metres; `body` is "imu",
/// "camera0", "camera1", ….
#[pyclass(frozen, module = "vidar", from_py_object)]
#[derive(Clone)]
pub struct Trajectory(pub Poses);

#[pymethods]
impl Trajectory {
    #[new]
    #[pyo3(signature = (times_ns, world_from_body, *, body = "imu"))]
    fn new(
        times_ns: PyArrayLike1<'_, i64>,
        world_from_body: &Bound<'_, PyAny>,
        body: &str,
    ) -> PyResult<Self> {
        let poses = arrays::se3s("world_from_body", world_from_body)?;
        let times = times_ns.as_array();
        if times.len() != poses.len() {
            return Err(PyValueError::new_err(format!("{} times for {} poses", times.len(), poses.len())));
        }
        let stamped = times.iter().zip(poses).map(|(&nanos, world_from_body)| StampedPose {
            time: Timestamp::from_nanos(nanos),
            world_from_body,
        });
        let body = body_named(body).map_err(raise)?;
        Poses::new(body, stamped.collect()).map(Self).map_err(raise)
    }

    /// Reads a TUM, EuRoC csv or KITTI file. Options: trajectory_format, trajectory_body, time_unit, timestamps.
    #[classmethod]
    #[pyo3(signature = (path, **options))]
    fn read(
        _class: &Bound<'_, PyType>,
        py: Python<'_>,
        path: PathBuf,
        options: Option<&Bound<'_, PyDict>>,
    ) -> PyResult<Self> {
        let keywords = Keywords::new(py, "Trajectory.read", options)?;
        let reading = trajectory_options(&keywords)?;
        keywords.finish()?;
        py.detach(|| read_trajectory(&path, &reading)).map(|(poses, _)| Self(poses)).map_err(raise)
    }

    /// Writes it as "tum" (the default), "euroc" or "kitti" (which holds no times).
    #[pyo3(signature = (path, format = "tum"))]
    fn write(&self, py: Python<'_>, path: PathBuf, format: &str) -> PyResult<()> {
        let write: fn(&mut dyn std::io::Write, &Poses) -> Result<(), export::ExportError> = match format {
            "tum" => |w, t| export::write_tum(w, t, "VIDAR"),
            "euroc" => |w, t| export::write_euroc_csv(w, t, "VIDAR"),
            "kitti" => |w, t| export::write_kitti(w, t),
            other => {
                return Err(PyValueError::new_err(format!(
                    "format must be tum, euroc or kitti, found {other:?}"
                )));
            }
        };
        py.detach(|| export::atomic::write_atomically(&path, |w| write(w, &self.0))).map_err(raise)
    }

    /// Whose poses they are: "body" (the IMU), "camera0", ….
    #[getter]
    fn body(&self) -> String {
        self.0.body().to_string()
    }

    /// Times, int64 (N,), nanoseconds.
    #[getter]
    fn times_ns<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<i64>> {
        PyArray1::from_vec(py, self.0.poses().iter().map(|p| p.time.nanos()).collect())
    }

    /// Poses, float64 (N, 4, 4), metres.
    #[getter]
    fn world_from_body<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray3<f64>>> {
        let all: Vec<_> = self.0.poses().iter().map(|p| p.world_from_body.matrix()).collect();
        arrays::matrices(py, &all)
    }

    /// Positions, float64 (N, 3), metres.
    #[getter]
    fn positions<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        arrays::rows(py, self.0.poses().iter().map(|p| p.world_from_body.translation.into()).collect())
    }

    /// Unit quaternions, float64 (N, 4), x, y, z, w.
    #[getter]
    fn quaternions_xyzw<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let poses = self.0.poses().iter();
        let all: Vec<[f64; 4]> = poses.map(|p| p.world_from_body.rotation.quaternion_xyzw()).collect();
        let n = all.len();
        PyArray1::from_vec(py, all.into_flattened()).reshape([n, 4])
    }

    /// Length of the path, metres.
    #[getter]
    fn length(&self) -> f64 {
        self.0.path_length_m()
    }

    fn __len__(&self) -> usize {
        self.0.len()
    }

    fn __repr__(&self) -> String {
        format!("Trajectory({} poses of {}, {:.2} m)", self.0.len(), self.0.body(), self.0.path_length_m())
    }
}

/// A similarity or rigid motion, p_in_target = scale · rotation · p_in_source + translation.
#[pyclass(frozen, module = "vidar")]
pub struct Alignment {
    target_from_source: Sim3,
    /// Pairs of points that it was fitted to.
    #[pyo3(get)]
    pairs: usize,
    /// Root mean square of the distances that are left, in units of the target.
    #[pyo3(get)]
    rmse: f64,
}

#[pymethods]
impl Alignment {
    /// Units of the target per unit of the source; 1 for a rigid motion.
    #[getter]
    fn scale(&self) -> f64 {
        self.target_from_source.scale
    }

    /// float64 (3, 3).
    #[getter]
    fn rotation<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        arrays::matrix(py, &self.target_from_source.rotation.matrix())
    }

    /// float64 (3,), in units of the target.
    #[getter]
    fn translation<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<f64>> {
        PyArray1::from_slice(py, self.target_from_source.translation.as_slice())
    }

    /// float64 (4, 4): [scale · rotation, translation; 0 0 0 1].
    #[getter]
    fn matrix<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let t = &self.target_from_source;
        let mut matrix = nalgebra::Matrix4::identity();
        matrix.fixed_view_mut::<3, 3>(0, 0).copy_from(&(t.rotation.matrix() * t.scale));
        matrix.fixed_view_mut::<3, 1>(0, 3).copy_from(&t.translation);
        arrays::matrix(py, &matrix)
    }

    /// Points (N, 3) of the source in the target, float64 (N, 3).
    fn apply<'py>(&self, points: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let py = points.py();
        let points = arrays::points("points", points)?;
        arrays::rows(py, points.iter().map(|p| self.target_from_source.act(p).into()).collect())
    }

    fn __repr__(&self) -> String {
        format!("Alignment(scale={}, rmse={}, pairs={})", self.scale(), self.rmse, self.pairs)
    }
}

/// The Sim(3) (or, without scale, SE(3)) that moves `source` onto `target` with least squares (Umeyama 1991).
///
/// Both are points (N, 3) in pairs, or both are Trajectory objects, whose positions are paired by time within
/// `max_time_difference` seconds, as evo does. `weights` (N,) are of the pairs of points, and need a scale.
#[pyfunction]
#[pyo3(signature = (source, target, *, scale = true, weights = None, max_time_difference = 0.01))]
pub fn align(
    source: &Bound<'_, PyAny>,
    target: &Bound<'_, PyAny>,
    scale: bool,
    weights: Option<PyArrayLike1<'_, f64, AllowTypeChange>>,
    max_time_difference: f64,
) -> PyResult<Alignment> {
    let (source, target) = match (source.extract::<Trajectory>(), target.extract::<Trajectory>()) {
        (Ok(source), Ok(target)) => paired(&source.0, &target.0, max_time_difference)?,
        _ => (arrays::points("source", source)?, arrays::points("target", target)?),
    };
    let fitted = match (&weights, scale) {
        (None, true) => umeyama_sim3(&source, &target),
        (None, false) => umeyama_se3(&source, &target).map(|t| Sim3::from_se3(&t)),
        (Some(weights), true) => {
            let weights: Vec<f64> = weights.as_array().iter().copied().collect();
            umeyama_sim3_weighted(&source, &target, &weights)
        }
        (Some(_), false) => return Err(PyValueError::new_err("weights need scale=True")),
    };
    let target_from_source = fitted.map_err(|error| raise(EvalError::from(error)))?;
    let squares = source.iter().zip(&target).map(|(s, t)| (t - target_from_source.act(s)).norm_squared());
    let rmse = (squares.sum::<f64>() / source.len() as f64).sqrt();
    Ok(Alignment { target_from_source, pairs: source.len(), rmse })
}

/// Positions of the poses of both at the same times.
type Paired = (Vec<Vector3<f64>>, Vec<Vector3<f64>>);

fn paired(source: &Poses, target: &Poses, max_difference_secs: f64) -> PyResult<Paired> {
    let limit = vidar::core::Duration::from_secs_f64(max_difference_secs);
    let pairs = vidar::eval::associate(source, target, limit).map_err(raise)?;
    let position = |t: &Poses, i: usize| t.poses()[i].world_from_body.translation;
    Ok(pairs.into_iter().map(|(s, t)| (position(source, s), position(target, t))).unzip())
}
