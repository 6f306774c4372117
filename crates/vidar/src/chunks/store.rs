//! One chunk's prediction as a file, and back.

use super::arrays::{
    MASKS, POSE_STD, SHAPES, pack_masks, pack_pose_std, pack_shapes, unpack_masks, unpack_pose_std,
    unpack_shapes,
};
use crate::engine::PredictionId;
use crate::error::Error;
use crate::run_folder::pretty;
use nalgebra::{Matrix3, Matrix4};
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::{BufReader, Write};
use std::path::{Path, PathBuf};
use vidar_core::model::ChunkFrame;
use vidar_core::{
    ChunkId, Confidence, FrameId, GeometryPrediction, Image, LieGroup, RelativeDepth, Se3, Timestamp,
    ViewGeometry,
};
use vidar_da3::pose::{from_edge, to_edge};
use vidar_export::ExportError;
use vidar_export::official::{NpyArray, NpyData, NpzLimits, Packing, read_npz, write_npz_arrays_with};
use vidar_stereo::PoseStd;

/// Schema of a chunk's `json`.
pub(super) const CHUNK_SCHEMA: &str = "vidar.chunk/1";
const FORMAT: &str = "chunk npz";
/// Most bytes that one view of a prediction may hold: 2048 x 2048 pixels of 16 bytes each.
const VIEW_BYTES: u64 = 64 << 20;
/// What the names of loops' files begin with.
const LOOP: &str = "loop-";

/// A chunk as it lies on disk.
#[derive(Clone, Debug)]
pub struct StoredChunk {
    /// The model's prediction; no views where it failed.
    pub prediction: GeometryPrediction,
    /// When each view was taken.
    pub times: Vec<Timestamp>,
    /// Each view's image at the depth's size; empty where there are none.
    pub colors: Vec<Image<[u8; 3]>>,
    /// Each view's descriptor for place recognition; empty where images serve.
    pub descriptors: Vec<Vec<f32>>,
    /// Each view's depth by another model, in any unit, for what the prediction leaves empty; empty where there is none.
    pub shapes: Vec<Option<Image<f32>>>,
    /// What the pose of each view is known to, where the images corrected it; else empty.
    pub pose_std: Vec<PoseStd>,
    /// What of each view is not to be used, `true` there, at the depth's size; empty where all of all views is used.
    pub masks: Vec<Option<Image<bool>>>,
    /// Why there is no prediction.
    pub failure: Option<String>,
}

impl StoredChunk {
    /// A prediction alone.
    pub fn of(prediction: GeometryPrediction) -> Self {
        Self {
            prediction,
            times: Vec::new(),
            colors: Vec::new(),
            descriptors: Vec::new(),
            shapes: Vec::new(),
            pose_std: Vec::new(),
            masks: Vec::new(),
            failure: None,
        }
    }
}

/// `000003.json`.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct Sidecar {
    pub schema: String,
    /// The chunk; of a loop the later one.
    pub id: u32,
    /// The earlier chunk, where it is the prediction of a loop.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub earlier: Option<u32>,
    pub frame: ChunkFrame,
    pub frames: Vec<u32>,
    pub times_ns: Vec<i64>,
    /// What it was made of; another key means another prediction.
    #[serde(default)]
    pub key: String,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub failure: Option<String>,
}

/// A folder of chunks.
#[derive(Clone, Debug)]
pub struct ChunkStore {
    folder: PathBuf,
}

impl ChunkStore {
    /// The chunks in `folder`, which is made when the first one is written.
    pub fn new(folder: PathBuf) -> Self {
        Self { folder }
    }

    /// The folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Writes a chunk, whole or not at all.
    pub fn write(&self, id: PredictionId, chunk: &StoredChunk, key: &str) -> Result<u64, Error> {
        std::fs::create_dir_all(&self.folder).map_err(|e| Error::io("create", &self.folder, e))?;
        let mut bytes = 0;
        if !chunk.prediction.views.is_empty() {
            let packed = pack(chunk)?;
            vidar_export::atomic::write_file_atomically(&self.path(id, "npz"), &packed)?;
            bytes = packed.len() as u64;
        }
        let sidecar = Sidecar {
            schema: CHUNK_SCHEMA.to_owned(),
            id: match id {
                PredictionId::Chunk(chunk) | PredictionId::Loop { later: chunk, .. } => chunk.0,
            },
            earlier: match id {
                PredictionId::Loop { earlier, .. } => Some(earlier.0),
                PredictionId::Chunk(_) => None,
            },
            frame: chunk.prediction.frame,
            frames: chunk.prediction.views.iter().map(|v| v.frame_id.0).collect(),
            times_ns: chunk.times.iter().map(|t| t.nanos()).collect(),
            key: key.to_owned(),
            failure: chunk.failure.clone(),
        };
        vidar_export::atomic::write_file_atomically(&self.path(id, "json"), &pretty(&sidecar)?)?;
        Ok(bytes)
    }

    /// The chunk with that number, if it is there and was made of what `key` stands for.
    ///
    /// A file that a power cut left half written is as good as none: the chunk is predicted again.
    pub fn find(&self, id: PredictionId, key: &str) -> Option<StoredChunk> {
        let sidecar = self.sidecar(id).ok()?.filter(|s| s.key == key)?;
        load(&self.path(id, "npz"), id, &sidecar).ok()
    }

    /// The chunk with that number.
    pub fn read(&self, id: PredictionId) -> Result<StoredChunk, Error> {
        let missing = || Error::io("read", &self.path(id, "json"), std::io::ErrorKind::NotFound.into());
        load(&self.path(id, "npz"), id, &self.sidecar(id)?.ok_or_else(missing)?)
    }

    /// Removes every chunk, and the folder where nothing else lies in it.
    pub fn remove_all(&self) {
        // What cannot be removed is only left behind.
        for path in self.files() {
            let _ = std::fs::remove_file(path);
        }
        let _ = std::fs::remove_dir(&self.folder);
    }

    /// The files of every chunk, in no order.
    pub fn files(&self) -> Vec<PathBuf> {
        let ours = |p: &PathBuf| {
            let is_number = |s: &str| s.parse::<u32>().is_ok() || s.starts_with(LOOP);
            p.file_stem().and_then(|s| s.to_str()).is_some_and(is_number)
                && p.extension().is_some_and(|e| e == "npz" || e == "json")
        };
        let entries = std::fs::read_dir(&self.folder).into_iter().flatten();
        entries.filter_map(|e| Some(e.ok()?.path())).filter(ours).collect()
    }

    /// The files of a chunk that is there, the one that makes it valid last.
    pub fn files_of(&self, id: PredictionId) -> Vec<PathBuf> {
        ["npz", "json"].map(|e| self.path(id, e)).into_iter().filter(|p| p.is_file()).collect()
    }

    fn path(&self, id: PredictionId, extension: &str) -> PathBuf {
        self.folder.join(match id {
            PredictionId::Chunk(chunk) => format!("{:06}.{extension}", chunk.0),
            PredictionId::Loop { later, earlier } => {
                format!("{LOOP}{:06}-{:06}.{extension}", later.0, earlier.0)
            }
        })
    }

    fn sidecar(&self, id: PredictionId) -> Result<Option<Sidecar>, Error> {
        read_sidecar(&self.path(id, "json"))
    }
}

/// Whether a file is of the prediction of a loop.
pub(super) fn is_loop(path: &Path) -> bool {
    path.file_name().and_then(|n| n.to_str()).is_some_and(|n| n.starts_with(LOOP))
}

/// A sidecar; `None` where there is no such file.
pub(super) fn read_sidecar(path: &Path) -> Result<Option<Sidecar>, Error> {
    let bytes = match crate::system::read_up_to(path, crate::system::MAX_JSON_BYTES) {
        Ok(bytes) => bytes,
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Ok(None),
        Err(e) => return Err(Error::io("read", path, e)),
    };
    let bad = |reason: String| Error::NotARecording { path: path.to_owned(), reason };
    let sidecar: Sidecar = serde_json::from_slice(&bytes).map_err(|e| bad(e.to_string()))?;
    if sidecar.schema != CHUNK_SCHEMA {
        return Err(bad(format!("its schema is {:?}, expected {CHUNK_SCHEMA:?}", sidecar.schema)));
    }
    if sidecar.frames.len() != sidecar.times_ns.len() {
        return Err(bad(format!("{} frames, {} times", sidecar.frames.len(), sidecar.times_ns.len())));
    }
    Ok(Some(sidecar))
}

/// The chunk that a sidecar describes.
pub(super) fn load(npz: &Path, id: PredictionId, sidecar: &Sidecar) -> Result<StoredChunk, Error> {
    let ids: Vec<FrameId> = sidecar.frames.iter().copied().map(FrameId).collect();
    let mut chunk = match ids.is_empty() {
        true => empty(id, sidecar),
        false => read_views(npz, &ids, id.model_number(), sidecar.frame, 1.0)?,
    };
    chunk.times = sidecar.times_ns.iter().copied().map(Timestamp::from_nanos).collect();
    chunk.failure = sidecar.failure.clone();
    Ok(chunk)
}

fn empty(id: PredictionId, sidecar: &Sidecar) -> StoredChunk {
    let chunk_id = id.model_number();
    StoredChunk::of(GeometryPrediction { chunk_id, frame: sidecar.frame, views: Vec::new() })
}

fn pack(chunk: &StoredChunk) -> Result<Vec<u8>, Error> {
    let views = &chunk.prediction.views;
    let n = views.len();
    let (width, height) = views.first().map_or((0, 0), |v| (v.intrinsics.width, v.intrinsics.height));
    let plane = vec![n, height, width];
    let floats = |image: fn(&ViewGeometry) -> &Image<f32>| {
        NpyData::F32(views.iter().flat_map(|v| image(v).data()).copied().collect())
    };
    let depth = NpyArray::new(plane.clone(), floats(|v| v.depth.image()))?;
    let confidence = NpyArray::new(plane, floats(|v| v.confidence.image()))?;
    let extrinsics = views.iter().flat_map(|v| rows(&v.chunk_from_camera.inverse().matrix())).collect();
    let extrinsics = NpyArray::new(vec![n, 3, 4], NpyData::F64(extrinsics))?;
    let intrinsics = views.iter().flat_map(|v| {
        let k = to_edge(&v.intrinsics);
        [0, 1, 2].into_iter().flat_map(move |r| [0, 1, 2].map(|c| k[(r, c)]))
    });
    let intrinsics = NpyArray::new(vec![n, 3, 3], NpyData::F64(intrinsics.collect()))?;
    let mut arrays = vec![
        ("depth", &depth),
        ("probability", &confidence),
        ("extrinsics", &extrinsics),
        ("intrinsics", &intrinsics),
    ];
    let image;
    if chunk.colors.len() == n {
        let bytes = chunk.colors.iter().flat_map(|c| c.data().as_flattened()).copied().collect();
        image = NpyArray::new(vec![n, height, width, 3], NpyData::U8(bytes))?;
        arrays.push(("image", &image));
    }
    let descriptors;
    if let Some(first) = chunk.descriptors.first().filter(|_| chunk.descriptors.len() == n) {
        descriptors = NpyArray::new(vec![n, first.len()], NpyData::F32(chunk.descriptors.concat()))?;
        arrays.push(("place", &descriptors));
    }
    let shapes;
    if let Some(array) = pack_shapes(&chunk.shapes, n)? {
        shapes = array;
        arrays.push((SHAPES, &shapes));
    }
    let pose_std;
    if let Some(array) = pack_pose_std(&chunk.pose_std, n)? {
        pose_std = array;
        arrays.push((POSE_STD, &pose_std));
    }
    let masks;
    if let Some(array) = pack_masks(&chunk.masks, [n, height, width])? {
        masks = array;
        arrays.push((MASKS, &masks));
    }
    let mut packed = std::io::Cursor::new(Vec::new());
    write_npz_arrays_with(&mut packed, &arrays, Packing::Stored)?;
    packed.flush().map_err(|e| Error::io("pack", Path::new(FORMAT), e))?;
    Ok(packed.into_inner())
}

fn rows(m: &Matrix4<f64>) -> Vec<f64> {
    (0..3).flat_map(|r| (0..4).map(move |c| m[(r, c)])).collect()
}

/// The arrays of an `npz` as the views `ids`: ours, or the official program's of a chunk or of one frame.
///
/// `least_confidence` is what `conf` starts from: 1 as the head gives it, 0 as DA3-Streaming writes it.
pub(super) fn read_views(
    path: &Path,
    ids: &[FrameId],
    chunk_id: ChunkId,
    frame: ChunkFrame,
    least_confidence: f32,
) -> Result<StoredChunk, Error> {
    let file = File::open(path).map_err(|e| Error::io("read", path, e))?;
    // An archive of zeros unpacks to a thousand times its size: what the views may hold is known beforehand.
    let limits = NpzLimits { bytes: VIEW_BYTES * (ids.len() as u64 + 1), ..NpzLimits::default() };
    let mut arrays = read_npz(BufReader::new(file), limits).map_err(|e| at(path, e))?;
    let mut take = |names: &[&str]| names.iter().find_map(|name| arrays.remove(*name));
    let bad = |reason: String| Error::NotARecording { path: path.to_owned(), reason };
    let depth = take(&["depth"]).ok_or_else(|| bad("it has no array \"depth\"".into()))?;
    let (n, height, width) = match depth.shape[..] {
        [n, height, width] => (n, height, width),
        [height, width] => (1, height, width),
        _ => {
            return Err(bad(format!(
                "depth has the shape {:?}, expected [views, rows, columns]",
                depth.shape
            )));
        }
    };
    if n != ids.len() {
        return Err(bad(format!("it has {n} views, expected {}", ids.len())));
    }
    if width == 0 || height == 0 {
        return Err(bad("its depth has no pixels".into()));
    }
    let planes = |name: &str, array: NpyArray| -> Result<Vec<Image<f32>>, Error> {
        let values = array.into_f32().filter(|v| v.len() == n * width * height);
        let values =
            values.ok_or_else(|| bad(format!("{name} is no {n} images of {width}x{height} floats")))?;
        let image = |v: &[f32]| Image::from_vec(width, height, v.to_vec()).ok();
        values.chunks(width * height).map(image).collect::<Option<_>>().ok_or_else(|| bad(name.to_owned()))
    };
    let depth = planes("depth", depth)?;
    let confidence = match (take(&["probability"]), take(&["conf", "confidence"])) {
        (Some(ours), _) => planes("probability", ours)?,
        // The head's confidence is c = 1 + exp(l); 1 − 1/c is the logistic function of the same l.
        (None, Some(c)) => {
            let head = |c: &f32| (c + 1.0 - least_confidence).max(1.0);
            planes("conf", c)?.into_iter().map(|i| i.map(|c| 1.0 - 1.0 / head(c))).collect()
        }
        (None, None) => vec![Image::filled(width, height, 1.0); n],
    };
    let poses = match take(&["extrinsics", "exts"]) {
        Some(array) => matrices(array, n, 4).ok_or_else(|| bad("extrinsics are no 3x4 matrices".into()))?,
        None => vec![Matrix4::identity(); n],
    };
    let intrinsics = take(&["intrinsics", "ixts"]).and_then(|a| matrices(a, n, 3));
    let intrinsics = intrinsics.ok_or_else(|| bad("it has no intrinsics of 3x3".into()))?;
    let mut views = Vec::with_capacity(n);
    for (i, (depth, confidence)) in depth.into_iter().zip(confidence).enumerate() {
        let pose = Se3::from_matrix(&poses[i]).map(|p| p.inverse()).filter(Se3::is_finite);
        let k: Matrix3<f64> = intrinsics[i].fixed_view::<3, 3>(0, 0).into_owned();
        views.push(ViewGeometry {
            frame_id: ids[i],
            chunk_from_camera: pose.ok_or_else(|| bad(format!("the pose of view {i} is no motion")))?,
            intrinsics: from_edge(&k, width, height)
                .ok_or_else(|| bad(format!("the intrinsics of view {i} are not positive and finite")))?,
            depth: RelativeDepth::new(depth),
            confidence: Confidence::new(confidence),
        });
    }
    let colors = match take(&["image", "images"]).map(|a| a.data) {
        Some(NpyData::U8(bytes)) if bytes.len() == n * width * height * 3 => bytes
            .chunks(width * height * 3)
            .filter_map(|b| Image::from_vec(width, height, b.as_chunks::<3>().0.to_vec()).ok())
            .collect(),
        _ => Vec::new(),
    };
    let descriptors = match take(&["place"]) {
        Some(array) if array.shape.first() == Some(&n) && array.shape.len() == 2 => {
            let length = array.shape[1].max(1);
            array.into_f32().map_or_else(Vec::new, |v| v.chunks(length).map(<[f32]>::to_vec).collect())
        }
        _ => Vec::new(),
    };
    let shapes = take(&[SHAPES]).map_or_else(Vec::new, |array| unpack_shapes(array, n));
    let pose_std = take(&[POSE_STD]).map_or_else(Vec::new, |array| unpack_pose_std(array, n));
    let masks = take(&[MASKS]).map_or_else(Vec::new, |array| unpack_masks(array, [n, height, width]));
    let prediction = GeometryPrediction { chunk_id, frame, views };
    let times = vec![Timestamp::default(); n];
    Ok(StoredChunk { prediction, times, colors, descriptors, shapes, pose_std, masks, failure: None })
}

/// `n` matrices of three rows and `columns` columns; a fourth row is left out.
fn matrices(array: NpyArray, n: usize, columns: usize) -> Option<Vec<Matrix4<f64>>> {
    let values: Vec<f64> = match array.data {
        NpyData::F64(values) => values,
        NpyData::F32(values) => values.into_iter().map(f64::from).collect(),
        _ => return None,
    };
    let per = values.len().checked_div(n)?;
    if per * n != values.len() || !(per == 3 * columns || (columns == 4 && per == 16)) {
        return None;
    }
    let matrix = |v: &[f64]| {
        let mut m = Matrix4::identity();
        (0..3).for_each(|r| (0..columns).for_each(|c| m[(r, c)] = v[r * columns + c]));
        m
    };
    Some(values.chunks(per).map(matrix).collect())
}

fn at(path: &Path, error: ExportError) -> Error {
    Error::NotARecording { path: path.to_owned(), reason: error.to_string() }
}
