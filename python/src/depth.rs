//! Depth Anything 3: images in; depth, confidence and cameras out.

use crate::arrays;
use crate::call::interruptible;
use crate::error::raise;
use nalgebra::Matrix3;
use numpy::{PyArray1, PyArray3, PyArrayMethods, PyReadonlyArray2, PyReadonlyArray3};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use std::path::PathBuf;
use vidar::core::{Image, LieGroup, Se3};
use vidar::da3::pose::{from_edge, to_edge};
use vidar::da3::{Da3, Da3Options, Device, Hooks, InferOptions, Inputs, Precision, Prediction as Predicted};
use vidar::models::{self, ModelChoice};
use vidar::{Error, da3::Da3Error};

/// A Depth Anything 3 network.
///
/// DepthAnything3(model="da3-nano", *, model_dir=None, device="cpu", precision="auto"): `model` is a name of `vidar model list`;
/// "da3-nano" is built in, others are fetched with `vidar model pull`. `model_dir` is a folder with model.safetensors and
/// config.json. `device` is cpu, gpu, gpu:N or auto; `precision` is auto, f32 or bf16. Opening fetches nothing.
#[pyclass(frozen, module = "vidar")]
pub struct DepthAnything3 {
    network: Da3,
    choice: ModelChoice,
}

#[pymethods]
impl DepthAnything3 {
    #[new]
    #[pyo3(signature = (model = "da3-nano", *, model_dir = None, device = "cpu", precision = "auto"))]
    fn new(
        py: Python<'_>,
        model: &str,
        model_dir: Option<PathBuf>,
        device: &str,
        precision: &str,
    ) -> PyResult<Self> {
        let choice = match model_dir {
            Some(folder) => ModelChoice::Folder(folder),
            None => ModelChoice::named(model).map_err(raise)?,
        };
        let wrong = |error: String| PyValueError::new_err(error);
        let options = Da3Options {
            device: device.parse::<Device>().map_err(|e| wrong(e.to_string()))?,
            precision: precision.parse::<Precision>().map_err(|e| wrong(e.to_string()))?,
            // The dense head stays in 32 bits, as in the official program.
            head_precision: Some(Precision::F32),
            ..Da3Options::default()
        };
        let network = interruptible(py, None, |_, _| {
            models::locate(&choice, None, &models::store(true)?)?.open(&options)
        })?;
        Ok(Self { network, choice })
    }

    /// Its name.
    #[getter]
    fn name(&self) -> String {
        self.choice.name()
    }

    /// Whether it takes several views at once and predicts cameras.
    #[getter]
    fn is_any_view(&self) -> bool {
        self.network.is_any_view()
    }

    /// Kernels, precisions and device, in words.
    #[getter]
    fn compute(&self) -> String {
        self.network.describe_compute()
    }

    /// Predicts all images together.
    ///
    /// `images` is a list of uint8 arrays (H, W, 3) RGB or (H, W), or one array (N, H, W, 3). With known cameras give
    /// `world_from_camera` (N, 4, 4) and `intrinsics` (3, 3) or (N, 3, 3) in pixels of the images, pixel (0, 0) being the centre of
    /// the top-left pixel; depth is then in the unit of those poses. `process_size` is the longer side of the network's input,
    /// px; the default is the one that the network was trained for. The result is a DepthPrediction.
    #[pyo3(signature = (images, *, world_from_camera = None, intrinsics = None, process_size = None))]
    fn predict(
        &self,
        images: &Bound<'_, PyAny>,
        world_from_camera: Option<&Bound<'_, PyAny>>,
        intrinsics: Option<&Bound<'_, PyAny>>,
        process_size: Option<usize>,
    ) -> PyResult<DepthPrediction> {
        let py = images.py();
        let images = images.try_iter()?.map(|i| picture(&i?)).collect::<PyResult<Vec<_>>>()?;
        let poses = world_from_camera.map(|p| arrays::se3s("world_from_camera", p)).transpose()?;
        let camera_from_world: Option<Vec<_>> =
            poses.map(|all| all.iter().map(|p| p.inverse().matrix()).collect());
        let matrices = intrinsics.map(|k| edge_matrices(k, &images)).transpose()?;
        let mut options = InferOptions::default();
        options.preprocess.process_size_px =
            process_size.unwrap_or_else(|| models::process_size_px(&self.choice));
        let predicted = interruptible(py, None, |_, cancel| {
            let inputs = Inputs {
                images: &images,
                camera_from_world: camera_from_world.as_deref(),
                intrinsics: matrices.as_deref(),
            };
            let watch = |_| cancel.is_cancelled();
            let predicted = self.network.infer_with(&inputs, &options, &Hooks { watch: &watch, trace: None });
            predicted.map_err(|error| match error {
                Da3Error::Cancelled => Error::Interrupted { path: ".".into() },
                other => other.into(),
            })
        })?;
        DepthPrediction::of(py, predicted)
    }

    fn __repr__(&self) -> String {
        format!("DepthAnything3({:?})", self.name())
    }
}

fn picture(value: &Bound<'_, PyAny>) -> PyResult<Image<[u8; 3]>> {
    if let Ok(color) = value.extract::<PyReadonlyArray3<'_, u8>>() {
        return arrays::rgb("an image", &color.as_array());
    }
    if let Ok(gray) = value.extract::<PyReadonlyArray2<'_, u8>>() {
        return Ok(arrays::image(&gray.as_array())?.map(|&g| [g; 3]));
    }
    Err(PyTypeError::new_err("images must be uint8 of shape (H, W, 3) or (H, W)"))
}

/// Intrinsics with their origin at the edge of the top-left pixel, as the network takes them.
fn edge_matrices(value: &Bound<'_, PyAny>, images: &[Image<[u8; 3]>]) -> PyResult<Vec<Matrix3<f64>>> {
    let size = images.first().map_or((1, 1), |i| (i.width(), i.height()));
    // The size takes no part in the matrix.
    Ok(arrays::pinholes(value, images.len(), size)?.iter().map(to_edge).collect())
}

/// Depth, confidence and cameras of N views at the processed size h × w.
#[pyclass(frozen, module = "vidar")]
pub struct DepthPrediction {
    /// z-depth, float32 (N, h, w): metres where `is_metric`, the unit of the given poses where there were any, else the network's own
    /// unit (one unknown factor for all views).
    #[pyo3(get)]
    depth: Py<PyArray3<f32>>,
    /// float32 (N, h, w), at least 1, without upper bound; only comparisons mean something. None for networks of single views.
    #[pyo3(get)]
    confidence: Option<Py<PyArray3<f32>>>,
    /// float64 (N, 4, 4), in the unit of depth; the given poses where there were any. None for networks of single views.
    #[pyo3(get)]
    world_from_camera: Option<Py<PyArray3<f64>>>,
    /// float64 (N, 3, 3) in processed pixels, pixel (0, 0) being the centre of the top-left pixel; or None.
    #[pyo3(get)]
    intrinsics: Option<Py<PyArray3<f64>>>,
    /// The processed images, uint8 (N, h, w, 3).
    #[pyo3(get)]
    images: Py<PyAny>,
    /// Whether the network itself predicts metres.
    #[pyo3(get)]
    is_metric: bool,
}

impl DepthPrediction {
    fn of(py: Python<'_>, predicted: Predicted) -> PyResult<Self> {
        let (n, width, height) = (predicted.images.len(), predicted.width(), predicted.height());
        let wrong = || PyValueError::new_err("the network predicted a camera that is none");
        let world_from_camera = match &predicted.camera_from_world {
            Some(all) => {
                let poses = all.iter().map(|m| Some(Se3::from_matrix(m)?.inverse().matrix()));
                let poses: Vec<_> = poses.collect::<Option<_>>().ok_or_else(wrong)?;
                Some(arrays::matrices(py, &poses)?.unbind())
            }
            None => None,
        };
        let intrinsics = match &predicted.intrinsics {
            Some(all) => {
                let cameras = all.iter().map(|k| Some(from_edge(k, width, height)?.matrix()));
                let cameras: Vec<_> = cameras.collect::<Option<_>>().ok_or_else(wrong)?;
                Some(arrays::matrices(py, &cameras)?.unbind())
            }
            None => None,
        };
        let mut images = Vec::with_capacity(n * width * height * 3);
        predicted.images.iter().for_each(|i| images.extend_from_slice(i.data().as_flattened()));
        let images = PyArray1::from_vec(py, images).reshape([n, height, width, 3])?;
        let confidence = predicted.confidence.map(|c| arrays::stack(py, c)).transpose()?;
        Ok(Self {
            depth: arrays::stack(py, predicted.depth)?.unbind(),
            confidence: confidence.map(Bound::unbind),
            world_from_camera,
            intrinsics,
            images: images.into_any().unbind(),
            is_metric: predicted.is_metric,
        })
    }
}
