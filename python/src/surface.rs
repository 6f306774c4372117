//! Meshes and clouds, and the fusion of depth images.

use crate::arrays;
use crate::call::interruptible;
use crate::error::raise;
use crate::options::{Keywords, layered};
use numpy::{
    PyArray1, PyArray2, PyArrayMethods, PyReadonlyArray1, PyReadonlyArray2, PyReadonlyArray3,
    PyReadonlyArray4, PyUntypedArrayMethods,
};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyType};
use std::path::{Path, PathBuf};
use vidar::core::{
    AlignedView, Confidence, FrameId, MetricDepth, PointCloud as Cloud, Timestamp, TriangleMesh,
};
use vidar::export_formats as export;
use vidar::export_formats::Ply;
use vidar::fusion::TsdfVolume;
use vidar::{Error, Event};

type Rows<T> = Option<Py<PyArray2<T>>>;

/// A triangle mesh in metres, triangles counter-clockwise from the observed side.
///
/// Mesh(vertices, triangles, *, normals=None, colors=None, confidence=None): float32 (V, 3), uint32 (T, 3), float32 (V, 3), uint8
/// (V, 3) sRGB, float32 (V,) in 0…1.
#[pyclass(frozen, module = "vidar")]
pub struct Mesh {
    points: PointCloud,
    /// uint32 (T, 3): vertices of each triangle.
    #[pyo3(get)]
    triangles: Py<PyArray2<u32>>,
}

#[pymethods]
impl Mesh {
    #[new]
    #[pyo3(signature = (vertices, triangles, *, normals = None, colors = None, confidence = None))]
    fn new(
        vertices: Py<PyArray2<f32>>,
        triangles: Py<PyArray2<u32>>,
        normals: Rows<f32>,
        colors: Rows<u8>,
        confidence: Option<Py<PyArray1<f32>>>,
    ) -> Self {
        Self { points: PointCloud { positions: vertices, normals, colors, confidence }, triangles }
    }

    /// Reads a PLY file.
    #[classmethod]
    fn read(_class: &Bound<'_, PyType>, py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        let mesh = py.detach(|| read_ply(&path)).map_err(raise)?.into_mesh();
        Self::of(py, mesh)
    }

    /// Writes a PLY or GLB file, by the name's end.
    fn write(&self, py: Python<'_>, path: PathBuf) -> PyResult<()> {
        let mesh = self.mesh(py)?;
        let comments = ["VIDAR".to_owned()];
        let write: fn(&mut dyn std::io::Write, &TriangleMesh, &[String]) -> Result<(), export::ExportError> =
            match extension(&path).as_deref() {
                Some("ply") => |w, mesh, comments| export::write_ply_mesh(w, mesh, comments),
                Some("glb") => |w, mesh, comments| export::write_glb_mesh(w, mesh, comments),
                _ => return Err(PyValueError::new_err("the name must end in .ply or .glb")),
            };
        py.detach(|| export::atomic::write_atomically(&path, |w| write(w, &mesh, &comments))).map_err(raise)
    }

    /// float32 (V, 3), metres.
    #[getter]
    fn vertices(&self, py: Python<'_>) -> Py<PyArray2<f32>> {
        self.points.positions.clone_ref(py)
    }

    /// Unit normals, float32 (V, 3), or None.
    #[getter]
    fn normals(&self, py: Python<'_>) -> Rows<f32> {
        self.points.normals.as_ref().map(|a| a.clone_ref(py))
    }

    /// sRGB, uint8 (V, 3), or None.
    #[getter]
    fn colors(&self, py: Python<'_>) -> Rows<u8> {
        self.points.colors.as_ref().map(|a| a.clone_ref(py))
    }

    /// float32 (V,) in 0…1, or None.
    #[getter]
    fn confidence(&self, py: Python<'_>) -> Option<Py<PyArray1<f32>>> {
        self.points.confidence.as_ref().map(|a| a.clone_ref(py))
    }

    fn __repr__(&self, py: Python<'_>) -> String {
        let (v, t) = (self.points.positions.bind(py).shape()[0], self.triangles.bind(py).shape()[0]);
        format!("Mesh({v} vertices, {t} triangles)")
    }
}

impl Mesh {
    /// A mesh whose lists move to NumPy.
    pub fn of(py: Python<'_>, mesh: TriangleMesh) -> PyResult<Self> {
        let TriangleMesh { positions, normals, colors, confidences, triangles } = mesh;
        let points = PointCloud::of(py, Cloud { positions, normals, colors, confidences })?;
        Ok(Self { points, triangles: arrays::rows(py, triangles)?.unbind() })
    }

    /// A copy for the libraries.
    pub fn mesh(&self, py: Python<'_>) -> PyResult<TriangleMesh> {
        let Cloud { positions, normals, colors, confidences } = self.points.cloud(py)?;
        let triangles = arrays::triplets("triangles", &self.triangles.bind(py).try_readonly()?)?;
        let mesh = TriangleMesh { positions, normals, colors, confidences, triangles };
        match mesh.is_consistent() {
            true => Ok(mesh),
            false => {
                Err(PyValueError::new_err("attributes must be one per vertex, triangles must name vertices"))
            }
        }
    }
}

/// Points in metres.
///
/// PointCloud(positions, *, normals=None, colors=None, confidence=None): float32 (N, 3), float32 (N, 3), uint8 (N, 3) sRGB,
/// float32 (N,) in 0…1.
#[pyclass(frozen, module = "vidar")]
pub struct PointCloud {
    /// float32 (N, 3), metres.
    #[pyo3(get)]
    positions: Py<PyArray2<f32>>,
    /// Unit normals, float32 (N, 3), or None.
    #[pyo3(get)]
    normals: Rows<f32>,
    /// sRGB, uint8 (N, 3), or None.
    #[pyo3(get)]
    colors: Rows<u8>,
    /// float32 (N,) in 0…1, or None.
    #[pyo3(get)]
    confidence: Option<Py<PyArray1<f32>>>,
}

#[pymethods]
impl PointCloud {
    #[new]
    #[pyo3(signature = (positions, *, normals = None, colors = None, confidence = None))]
    fn new(
        positions: Py<PyArray2<f32>>,
        normals: Rows<f32>,
        colors: Rows<u8>,
        confidence: Option<Py<PyArray1<f32>>>,
    ) -> Self {
        Self { positions, normals, colors, confidence }
    }

    /// Reads a PLY file.
    #[classmethod]
    fn read(_class: &Bound<'_, PyType>, py: Python<'_>, path: PathBuf) -> PyResult<Self> {
        let cloud = py.detach(|| read_ply(&path)).map_err(raise)?.cloud;
        Self::of(py, cloud)
    }

    /// Writes a PLY file.
    fn write(&self, py: Python<'_>, path: PathBuf) -> PyResult<()> {
        let cloud = self.cloud(py)?;
        let comments = ["VIDAR".to_owned()];
        let write = |w: &mut dyn std::io::Write| export::write_ply_cloud(w, &cloud, &comments);
        py.detach(|| export::atomic::write_atomically(&path, write)).map_err(raise)
    }

    fn __len__(&self, py: Python<'_>) -> usize {
        self.positions.bind(py).shape()[0]
    }

    fn __repr__(&self, py: Python<'_>) -> String {
        format!("PointCloud({} points)", self.__len__(py))
    }
}

impl PointCloud {
    /// A cloud whose lists move to NumPy.
    pub fn of(py: Python<'_>, cloud: Cloud) -> PyResult<Self> {
        let Cloud { positions, normals, colors, confidences } = cloud;
        let (has_normals, has_colors) = (!normals.is_empty(), !colors.is_empty());
        let confidence = (!confidences.is_empty()).then(|| PyArray1::from_vec(py, confidences).unbind());
        Ok(Self {
            positions: arrays::rows(py, positions)?.unbind(),
            normals: has_normals.then(|| arrays::rows(py, normals).map(Bound::unbind)).transpose()?,
            colors: has_colors.then(|| arrays::rows(py, colors).map(Bound::unbind)).transpose()?,
            confidence,
        })
    }

    /// A copy for the libraries.
    pub fn cloud(&self, py: Python<'_>) -> PyResult<Cloud> {
        let positions = arrays::triplets("positions", &self.positions.bind(py).try_readonly()?)?;
        let normals = match &self.normals {
            Some(normals) => arrays::triplets("normals", &normals.bind(py).try_readonly()?)?,
            None => Vec::new(),
        };
        let colors = match &self.colors {
            Some(colors) => arrays::triplets("colors", &colors.bind(py).try_readonly()?)?,
            None => Vec::new(),
        };
        let confidences = match &self.confidence {
            Some(confidence) => {
                let confidence: PyReadonlyArray1<'_, f32> = confidence.bind(py).try_readonly()?;
                confidence.as_array().iter().copied().collect()
            }
            None => Vec::new(),
        };
        let cloud = Cloud { positions, normals, colors, confidences };
        match cloud.is_consistent() {
            true => Ok(cloud),
            false => Err(PyValueError::new_err("attributes must be one per point")),
        }
    }
}

fn extension(path: &Path) -> Option<String> {
    path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase())
}

/// A PLY file.
pub fn read_ply(path: &Path) -> Result<Ply, Error> {
    let bytes = vidar::system::read_up_to(path, vidar::system::MAX_CLOUD_BYTES);
    Ok(export::read_ply(&bytes.map_err(|e| Error::io("read", path, e))?)?)
}

/// Fuses depth images to a Mesh (a truncated signed distance field, Curless & Levoy 1996).
///
/// `depth` is float32 (N, H, W), z-depth in metres, NaN or 0 where there is none; `world_from_camera` (N, 4, 4), metres;
/// `intrinsics` (3, 3) or (N, 3, 3), pixel (0, 0) being the centre of the top-left pixel; `confidence` float32 (N, H, W) in 0…1;
/// `colors` uint8 (N, H, W, 3). Settings are those of `[fusion]`: settings={"fusion.voxel_size_m": 0.02}. `progress` is called
/// with a dict per view.
#[pyfunction]
#[pyo3(signature = (depth, world_from_camera, intrinsics, *, confidence = None, colors = None, progress = None, **settings))]
#[allow(clippy::too_many_arguments)] // keyword arguments of a function of Python
pub fn fuse(
    depth: PyReadonlyArray3<'_, f32>,
    world_from_camera: &Bound<'_, PyAny>,
    intrinsics: &Bound<'_, PyAny>,
    confidence: Option<PyReadonlyArray3<'_, f32>>,
    colors: Option<PyReadonlyArray4<'_, u8>>,
    progress: Option<Py<PyAny>>,
    settings: Option<&Bound<'_, PyDict>>,
) -> PyResult<Mesh> {
    let py = intrinsics.py();
    let keywords = Keywords::new(py, "fuse", settings)?;
    let config = layered(&keywords)?.build().map_err(raise)?.fusion;
    keywords.finish()?;
    let (n, height, width) = depth.as_array().dim();
    let same = |what: &str, shape: &[usize]| match shape[..3] == [n, height, width] {
        true => Ok(()),
        false => Err(arrays::shape_error(what, &format!("({n}, {height}, {width}) first"), shape)),
    };
    confidence.as_ref().map_or(Ok(()), |c| same("confidence", c.shape()))?;
    colors.as_ref().map_or(Ok(()), |c| same("colors", c.shape()))?;
    let poses = arrays::se3s("world_from_camera", world_from_camera)?;
    if poses.len() != n {
        return Err(PyValueError::new_err(format!("{} poses for {n} depth images", poses.len())));
    }
    let cameras = arrays::pinholes(intrinsics, n, (width, height))?;
    let views = (0..n).map(|i| {
        let depth = arrays::image(&depth.as_array().index_axis_move(numpy::ndarray::Axis(0), i))?;
        let confidence = match &confidence {
            Some(all) => {
                Confidence::new(arrays::image(&all.as_array().index_axis_move(numpy::ndarray::Axis(0), i))?)
            }
            None => Confidence::full(width, height),
        };
        let (id, time) = (FrameId(i as u32), Timestamp::from_nanos(i as i64));
        let view = AlignedView::new(id, time, poses[i], cameras[i], MetricDepth::new(depth), confidence);
        let view = view.map_err(|e| PyValueError::new_err(e.to_string()))?;
        match &colors {
            Some(all) => {
                let color =
                    arrays::rgb("colors", &all.as_array().index_axis_move(numpy::ndarray::Axis(0), i))?;
                view.with_color(color).map_err(|e| PyValueError::new_err(e.to_string()))
            }
            None => Ok(view),
        }
    });
    let views: Vec<AlignedView> = views.collect::<PyResult<_>>()?;
    let mesh = interruptible(py, progress, |events, cancel| {
        let mut volume = TsdfVolume::new(&config)?;
        for (done, view) in (1..).zip(&views) {
            if cancel.is_cancelled() {
                return Err(Error::Interrupted { path: ".".into() });
            }
            volume.integrate(view)?;
            events.emit(&Event::Progress { stage: "fuse", done, total: n });
        }
        Ok(volume.extract_mesh())
    })?;
    Mesh::of(py, mesh)
}

/// The points of a mesh, a cloud or an array (N, 3), for evaluation.
pub fn evaluated(value: &Bound<'_, PyAny>, config: &vidar::Config) -> PyResult<Cloud> {
    let py = value.py();
    if let Ok(mesh) = value.cast::<Mesh>() {
        let mesh = mesh.get().mesh(py)?;
        return py.detach(|| vidar::evaluate::evaluated_points(&mesh, config)).map_err(raise);
    }
    if let Ok(cloud) = value.cast::<PointCloud>() {
        return cloud.get().cloud(py);
    }
    if let Ok(points) = value.extract::<PyReadonlyArray2<'_, f32>>() {
        return arrays::triplets("points", &points).map(Cloud::from_positions);
    }
    let points = arrays::points("points", value).map_err(|_| {
        PyTypeError::new_err("expected a Trajectory, a Mesh, a PointCloud, points of shape (N, 3), or a path")
    })?;
    Ok(Cloud::from_positions(points.iter().map(|p| p.map(|v| v as f32).into()).collect()))
}
