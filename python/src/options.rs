//! Keyword arguments as the options and settings of the command line.

use crate::arrays::se3;
use crate::error::raise;
use numpy::{AllowTypeChange, PyArrayLike2};
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::path::PathBuf;
use toml::Value;
use vidar::Layered;
use vidar::config::Origin;
use vidar::core::CameraId;
use vidar::dataset::{CameraFlag, OpenOptions, TrajectoryReadOptions, body_named, decoder_named, read_times};

/// Keyword arguments, taken one by one.
pub struct Keywords<'py> {
    function: &'static str,
    left: Bound<'py, PyDict>,
}

impl<'py> Keywords<'py> {
    /// The keyword arguments of `function`.
    pub fn new(
        py: Python<'py>,
        function: &'static str,
        keywords: Option<&Bound<'py, PyDict>>,
    ) -> PyResult<Self> {
        let left = keywords.map_or_else(|| Ok(PyDict::new(py)), |k| k.copy())?;
        Ok(Self { function, left })
    }

    /// The argument of that name; `None` where it is not given, or given as `None`.
    pub fn take<T: for<'a> FromPyObject<'a, 'py>>(&self, name: &str) -> PyResult<Option<T>> {
        let Some(value) = self.left.get_item(name)? else { return Ok(None) };
        self.left.del_item(name)?;
        if value.is_none() {
            return Ok(None);
        }
        value.extract::<T>().map(Some).map_err(|error| {
            let error: PyErr = error.into();
            let message = format!("{}(): argument {name:?}: {}", self.function, error.value(self.left.py()));
            PyTypeError::new_err(message)
        })
    }

    /// One value, or a list of them.
    fn take_some<T: for<'a> FromPyObject<'a, 'py>>(&self, name: &str) -> PyResult<Vec<T>> {
        let Some(value) = self.take::<Bound<'py, PyAny>>(name)? else { return Ok(Vec::new()) };
        match value.extract::<T>() {
            Ok(one) => Ok(vec![one]),
            Err(_) => value.try_iter()?.map(|item| item?.extract().map_err(Into::into)).collect(),
        }
    }

    /// Refuses what was not taken.
    pub fn finish(self) -> PyResult<()> {
        match self.left.keys().iter().next() {
            Some(name) => {
                let message =
                    format!("{}() got an unexpected keyword argument {}", self.function, name.repr()?);
                Err(PyTypeError::new_err(message))
            }
            None => Ok(()),
        }
    }
}

/// `preset`, `config` and `settings`: the layers of the command line, the environment between file and settings.
pub fn layered(keywords: &Keywords<'_>) -> PyResult<Layered> {
    let mut layered = Layered::defaults().map_err(raise)?;
    if let Some(name) = keywords.take::<String>("preset")? {
        layered.preset(&name).map_err(raise)?;
    }
    if let Some(path) = keywords.take::<PathBuf>("config")? {
        layered.file(&path).map_err(raise)?;
    }
    let variables = std::env::vars_os();
    let named = variables.filter_map(|(k, v)| Some((k.into_string().ok()?, v.into_string().ok()?)));
    layered.environment(named).map_err(raise)?;
    if let Some(settings) = keywords.take::<Bound<'_, PyDict>>("settings")? {
        for (key, value) in settings {
            let value: Value = pythonize::depythonize(&value)?;
            layered.value(&key.extract::<String>()?, value, Origin::Set).map_err(raise)?;
        }
    }
    Ok(layered)
}

/// Options that are settings, too.
pub fn flags(
    keywords: &Keywords<'_>,
    layered: &mut Layered,
    flags: &[(&str, &str, &'static str)],
) -> PyResult<()> {
    for &(name, key, flag) in flags {
        if let Some(value) = keywords.take::<Bound<'_, PyAny>>(name)? {
            let plain = if value.hasattr("__fspath__")? { value.call_method0("__fspath__")? } else { value };
            let value: Value = pythonize::depythonize(&plain)?;
            layered.value(key, value, Origin::Flag(flag)).map_err(raise)?;
        }
    }
    Ok(())
}

/// The part of the recording that is read.
pub const INPUT_FLAGS: [(&str, &str, &str); 4] = [
    ("start", "input.start_secs", "--start"),
    ("end", "input.end_secs", "--end"),
    ("camera", "input.camera", "--camera"),
    ("stride", "input.stride", "--stride"),
];

/// How a recording is read.
pub fn open_options(keywords: &Keywords<'_>, layered: &Layered) -> PyResult<OpenOptions> {
    let text = |name: &str| keywords.take::<String>(name);
    let mut options = OpenOptions {
        calibration: keywords.take_some("calibration")?,
        trajectory: keywords.take("trajectory")?,
        imu: keywords.take_some("imu")?,
        timestamps: keywords.take("timestamps")?,
        depth_scale: keywords.take("depth_scale")?,
        depth_intrinsics: keywords.take("depth_intrinsics")?,
        camera: CameraId(layered.build().map_err(raise)?.input.camera),
        ..OpenOptions::default()
    };
    let topics = keywords.take_some::<String>("topics")?;
    options.topics = topics.iter().map(|t| t.parse()).collect::<Result<_, _>>().map_err(raise)?;
    options.format = text("format")?.map(|t| t.parse()).transpose().map_err(raise)?;
    options.time_unit = text("time_unit")?.map(|t| t.parse()).transpose().map_err(raise)?;
    options.trajectory_format = text("trajectory_format")?.map(|t| t.parse()).transpose().map_err(raise)?;
    options.trajectory_body = text("trajectory_body")?.map(|t| body_named(&t)).transpose().map_err(raise)?;
    options.decoder =
        text("decoder")?.map(|t| decoder_named(&t)).transpose().map_err(raise)?.unwrap_or_default();
    let camera = text("camera_model")?.map(|t| t.parse::<CameraFlag>()).transpose().map_err(raise)?;
    options.camera_model = camera.map(|flag| flag.0);
    if let Some(matrix) = keywords.take::<Bound<'_, PyAny>>("color_from_depth")? {
        let matrix: PyArrayLike2<'_, f64, AllowTypeChange> = matrix.extract()?;
        options.color_from_depth = Some(se3("color_from_depth", &matrix.as_array())?);
    }
    Ok(options)
}

/// How a trajectory file is read.
pub fn trajectory_options(keywords: &Keywords<'_>) -> PyResult<TrajectoryReadOptions> {
    let text = |name: &str| keywords.take::<String>(name);
    let time_unit = text("time_unit")?.map(|t| t.parse()).transpose().map_err(raise)?;
    let times = keywords.take::<PathBuf>("timestamps")?;
    Ok(TrajectoryReadOptions {
        format: text("trajectory_format")?.map(|t| t.parse()).transpose().map_err(raise)?,
        body: text("trajectory_body")?.map(|t| body_named(&t)).transpose().map_err(raise)?,
        time_unit,
        times: times.map(|file| read_times(&file, time_unit)).transpose().map_err(raise)?,
    })
}
