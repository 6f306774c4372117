//! A recording to a run folder, and a run folder read back.

use crate::arrays;
use crate::call::interruptible;
use crate::error::raise;
use crate::options::{INPUT_FLAGS, Keywords, flags, layered, open_options};
use crate::surface::{Mesh, PointCloud, read_ply};
use crate::trajectory::Trajectory;
use numpy::PyArray2;
use pyo3::exceptions::{PyIndexError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use pythonize::pythonize;
use serde_json::Value;
use std::path::{Path, PathBuf};
use vidar::dataset::{TrajectoryReadOptions, read_trajectory};
use vidar::export::{ExportOptions, export_run, read_views};
use vidar::export_formats::read_depth_png;
use vidar::run_folder::{OutputLocation, StoredView, read_json};
use vidar::{Error, RunRequest};

/// Options of `run` that are settings, too.
const MODEL_FLAGS: [(&str, &str, &str); 5] = [
    ("geometry", "geometry.source", "--geometry"),
    ("mode", "coupling.mode", "--mode"),
    ("model_dir", "model.dir", "--model-dir"),
    ("device", "model.device", "--device"),
    ("map", "input.map", "--map"),
];

/// Maps a recording, as `vidar run` does: odometry, depth, alignment, fusion, evaluation, files. Returns the Run.
///
/// `output` is the run folder; the default is runs/NAME/TIME/. `force` renames an existing folder, `resume` goes on in it. Input
/// options are those of Recording; geometry, mode, model_dir, device and map are the options of the command line, as are
/// preset, config and settings ({"fusion.voxel_size_m": 0.03}). `reference` is a cloud (PLY) to compare the map with; `mcap` is a file to
/// write for Foxglove and Rerun.
///
/// `progress` is called with a dict per event, the objects of `--progress json`. Ctrl-C and an exception of `progress` stop the
/// run: what was mapped is fused and written, then the exception is raised.
#[pyfunction]
#[pyo3(signature = (path, output = None, *, reference = None, mcap = None, force = false, resume = false, progress = None, **options))]
#[allow(clippy::too_many_arguments)] // keyword arguments of a function of Python
pub fn run(
    py: Python<'_>,
    path: PathBuf,
    output: Option<PathBuf>,
    reference: Option<PathBuf>,
    mcap: Option<PathBuf>,
    force: bool,
    resume: bool,
    progress: Option<Py<PyAny>>,
    options: Option<&Bound<'_, PyDict>>,
) -> PyResult<Run> {
    let keywords = Keywords::new(py, "run", options)?;
    let mut layered = layered(&keywords)?;
    flags(&keywords, &mut layered, &INPUT_FLAGS)?;
    flags(&keywords, &mut layered, &MODEL_FLAGS)?;
    let open = open_options(&keywords, &layered)?;
    keywords.finish()?;
    let place = match (output, resume, force) {
        (Some(path), true, false) => OutputLocation::Resumed { path },
        (Some(path), false, force) => OutputLocation::Exact { path, force },
        (None, false, _) => OutputLocation::Dated { base: ".".into(), name: vidar::input::name_of(&path) },
        _ => return Err(PyValueError::new_err("resume needs an output folder and excludes force")),
    };
    let given = options.map_or_else(String::new, |o| format!(", **{o}"));
    let command = vec!["python".into(), format!("vidar.run({path:?}{given})")];
    let request = RunRequest { path, open, layered, reference, place, mcap, command };
    let folder = interruptible(py, progress, |events, cancel| {
        vidar::run(&request, events, cancel).map(|outcome| outcome.folder)
    })?;
    read_run(folder)
}

/// Reads the folder of a run: numbers, trajectory, mesh.
#[pyfunction]
pub fn read_run(folder: PathBuf) -> PyResult<Run> {
    let manifest = read_json(&folder, "manifest.json").map_err(raise)?;
    Ok(Run { folder, manifest })
}

/// A finished run. Files are read when asked for.
#[pyclass(frozen, module = "vidar")]
pub struct Run {
    /// The folder.
    #[pyo3(get)]
    folder: PathBuf,
    manifest: Value,
}

#[pymethods]
impl Run {
    /// manifest.json as a dict: version, command, hashes, seconds per stage, result, warnings, artifacts.
    #[getter]
    fn manifest<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        Ok(pythonize(py, &self.manifest)?)
    }

    /// Exit status: 0 done, 3 finished but degraded, 130 interrupted; None of a run that was killed.
    #[getter]
    fn exit_status(&self) -> Option<i64> {
        self.manifest["exit"].as_i64()
    }

    /// eval/metrics.json as a dict: verdict, scale, scores, evaluation and what the map was compared with.
    #[getter]
    fn metrics<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let metrics: Value = read_json(&self.folder, "eval/metrics.json").map_err(raise)?;
        Ok(pythonize(py, &metrics)?)
    }

    /// Scores by name; empty where there was nothing to compare with.
    #[getter]
    fn scores<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let metrics: Value = read_json(&self.folder, "eval/metrics.json").map_err(raise)?;
        Ok(pythonize(py, &metrics["scores"])?)
    }

    /// Metric poses of the camera at all images, or None where there were none.
    #[getter]
    fn trajectory(&self, py: Python<'_>) -> PyResult<Option<Trajectory>> {
        self.poses(py, "trajectory/metric_camera.tum")
    }

    /// Poses of the keyframes as they were fused, or None.
    #[getter]
    fn keyframes(&self, py: Python<'_>) -> PyResult<Option<Trajectory>> {
        self.poses(py, "trajectory/keyframes_camera.tum")
    }

    /// The surface.
    #[getter]
    fn mesh(&self, py: Python<'_>) -> PyResult<Mesh> {
        let ply = py.detach(|| read_ply(&self.folder.join("map/mesh.ply"))).map_err(raise)?;
        Mesh::of(py, ply.into_mesh())
    }

    /// The points.
    #[getter]
    fn points(&self, py: Python<'_>) -> PyResult<PointCloud> {
        let ply = py.detach(|| read_ply(&self.folder.join("map/points.ply"))).map_err(raise)?;
        PointCloud::of(py, ply.cloud)
    }

    /// The keyframes with depth.
    #[getter]
    fn views(&self) -> PyResult<Vec<View>> {
        let views = read_views(&self.folder).map_err(raise)?;
        Ok(views.into_iter().map(|view| View { folder: self.folder.clone(), view }).collect())
    }

    /// Writes it for another program: "colmap", "colmap-text", "nerfstudio", "tum", "kitti", "euroc", "ply", "glb", "textured-glb"
    /// or "mcap"; returns the files made.
    #[pyo3(signature = (to, output, *, tracks = false, input_size = false, texture_px = None))]
    fn export(
        &self,
        py: Python<'_>,
        to: &str,
        output: PathBuf,
        tracks: bool,
        input_size: bool,
        texture_px: Option<usize>,
    ) -> PyResult<Vec<PathBuf>> {
        let target = to.parse().map_err(PyValueError::new_err)?;
        let options = ExportOptions { tracks, input_size, texture_px };
        interruptible(py, None, |_, _| export_run(&self.folder, target, options, &output))
    }

    fn __repr__(&self) -> String {
        format!("Run({:?})", self.folder.display().to_string())
    }
}

impl Run {
    fn poses(&self, py: Python<'_>, relative: &str) -> PyResult<Option<Trajectory>> {
        let path = self.folder.join(relative);
        if !path.is_file() {
            return Ok(None);
        }
        let read = py.detach(|| read_trajectory(&path, &TrajectoryReadOptions::default()));
        read.map(|(poses, _)| Some(Trajectory(poses))).map_err(raise)
    }
}

/// A keyframe of a run, undistorted.
#[pyclass(frozen, module = "vidar")]
pub struct View {
    folder: PathBuf,
    view: StoredView,
}

#[pymethods]
impl View {
    /// Number of the image.
    #[getter]
    fn frame(&self) -> u32 {
        self.view.frame
    }

    /// Its time, nanoseconds.
    #[getter]
    fn time_ns(&self) -> i64 {
        self.view.time_ns
    }

    /// Pose of the camera, float64 (4, 4), metres.
    #[getter]
    fn world_from_camera<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let rows = &self.view.world_from_camera;
        let last = [0.0, 0.0, 0.0, 1.0];
        arrays::matrix(py, &nalgebra::Matrix4::from_fn(|r, c| rows.get(r).unwrap_or(&last)[c]))
    }

    /// float64 (3, 3), pixel (0, 0) being the centre of the top-left pixel.
    #[getter]
    fn intrinsics<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        arrays::matrix(py, &self.view.intrinsics.matrix())
    }

    /// Columns and rows.
    #[getter]
    fn size(&self) -> (usize, usize) {
        (self.view.intrinsics.width, self.view.intrinsics.height)
    }

    /// The undistorted image's file, or None.
    #[getter]
    fn image_path(&self) -> Option<PathBuf> {
        self.view.image.as_ref().map(|name| self.folder.join(name))
    }

    /// z-depth, float32 (H, W), metres, NaN where there is none.
    #[getter]
    fn depth<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f32>>> {
        let missing = || PyIndexError::new_err("the run wrote no depth for this view (output.depth_png)");
        let name = self.view.depth.as_ref().ok_or_else(missing)?;
        let depth = py.detach(|| read_depth(&self.folder, name)).map_err(raise)?;
        arrays::plane(py, depth.image().clone())
    }

    fn __repr__(&self) -> String {
        format!("View(frame={}, time_ns={})", self.view.frame, self.view.time_ns)
    }
}

fn read_depth(run: &Path, name: &str) -> Result<vidar::core::MetricDepth, Error> {
    let sidecar: Value = read_json(run, "depth/depth.json")?;
    let path = run.join(name);
    let not_a_run =
        || Error::NotARun { path: run.to_owned(), reason: "depth/depth.json has no scale".into() };
    let scale = sidecar["scale"].as_f64().ok_or_else(not_a_run)?;
    let bytes = vidar::system::read_up_to(&path, vidar::system::MAX_CLOUD_BYTES);
    Ok(read_depth_png(&bytes.map_err(|e| Error::io("read", &path, e))?, scale)?)
}
