//! Scores: trajectories, clouds and meshes, runs.

use crate::call::interruptible;
use crate::error::raise;
use crate::options::{Keywords, layered, trajectory_options};
use crate::surface::evaluated;
use crate::trajectory::Trajectory;
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyString};
use pythonize::pythonize;
use std::collections::BTreeMap;
use std::path::PathBuf;
use vidar::evaluate::{EvalOutcome, evaluate_clouds, evaluate_files, evaluate_run, evaluate_trajectories};

/// Result of an evaluation.
#[pyclass(frozen, module = "vidar")]
pub struct Evaluation(EvalOutcome);

#[pymethods]
impl Evaluation {
    /// "trajectory", "surface" or "run".
    #[getter]
    fn kind(&self) -> &'static str {
        self.0.kind
    }

    /// Scores by name, as of `vidar eval --json`: ate, ate-sim3 (m), scale (|ln s|), f@0.05, p@0.05, r@0.05, chamfer (m), ….
    #[getter]
    fn scores(&self) -> BTreeMap<String, f64> {
        self.0.scores.clone()
    }

    /// The whole report, as of `vidar eval --json`.
    #[getter]
    fn report<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        Ok(pythonize(py, &self.0.report)?)
    }

    /// One dict each: severity, kind, message, place, hint.
    #[getter]
    fn warnings<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        Ok(pythonize(py, &self.0.warnings)?)
    }

    fn __str__(&self) -> String {
        let lines: Vec<String> = self.0.lines.iter().map(|(k, v)| format!("{k:<20} {v}")).collect();
        lines.join("\n")
    }

    fn __repr__(&self) -> String {
        format!("Evaluation({}, {:?})", self.0.kind, self.0.scores)
    }
}

/// Compares `estimate` with `truth`, by the protocols of `vidar eval`: two Trajectory objects (ATE under SE(3) and Sim(3), |ln s|),
/// two of Mesh, PointCloud or points (N, 3) in one world in metres (precision, recall, F, chamfer), or two paths of files.
/// `truth` may be left out where `estimate` is the folder of a run: its own scores.
///
/// Settings are those of `[eval]`; trajectory_format, trajectory_body, time_unit and timestamps are of files.
#[pyfunction]
#[pyo3(signature = (estimate, truth = None, **options))]
pub fn evaluate(
    estimate: &Bound<'_, PyAny>,
    truth: Option<&Bound<'_, PyAny>>,
    options: Option<&Bound<'_, PyDict>>,
) -> PyResult<Evaluation> {
    let py = estimate.py();
    let keywords = Keywords::new(py, "evaluate", options)?;
    let config = layered(&keywords)?.build().map_err(raise)?;
    let reading = trajectory_options(&keywords)?;
    keywords.finish()?;
    let is_path = |value: &Bound<'_, PyAny>| {
        value.is_instance_of::<PyString>() || value.hasattr("__fspath__").unwrap_or(false)
    };
    let Some(truth) = truth else {
        let run: PathBuf = estimate.extract()?;
        return evaluate_run(&run).map(Evaluation).map_err(raise);
    };
    if is_path(estimate) != is_path(truth) {
        return Err(PyTypeError::new_err(
            "compare two paths or two objects; Trajectory.read and Mesh.read read files",
        ));
    }
    let outcome = if is_path(estimate) {
        let (estimate, truth): (PathBuf, PathBuf) = (estimate.extract()?, truth.extract()?);
        interruptible(py, None, |_, _| evaluate_files(&estimate, &truth, &config, &reading))
    } else if let (Ok(estimate), Ok(truth)) =
        (estimate.extract::<Trajectory>(), truth.extract::<Trajectory>())
    {
        interruptible(py, None, |_, _| evaluate_trajectories(&estimate.0, &truth.0, &config))
    } else {
        let (estimate, truth) = (evaluated(estimate, &config)?, evaluated(truth, &config)?);
        interruptible(py, None, |_, _| evaluate_clouds(&estimate, &truth, &config))
    };
    outcome.map(Evaluation)
}
