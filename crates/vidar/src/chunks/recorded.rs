//! Predictions that another program, or an earlier run, left: `--geometry recorded:DIR`.
//!
//! | What lies in `DIR` | Written by | Frames |
//! |---|---|---|
//! | `000000.json` beside `000000.npz`, … | VIDAR (`output.keep_chunks`), or a converter of one's own | by their time |
//! | `results_output/frame_0.npz`, …, `camera_poses.txt` | the official DA3-Streaming | `frame_N` is the N-th image of the input |
//! | `*.npz` of several views | the official API's exports `npz` and `mini_npz`, one per chunk | in the order of names: the chunks that `geometry.chunk_keyframes` and `geometry.overlap_keyframes` cut the images into |
//!
//! "The N-th image" counts those that `input.start_secs`, `end_secs` and `stride` leave.

use super::store::{StoredChunk, is_loop, load, read_sidecar, read_views};
use crate::engine::PredictionId;
use crate::error::Error;
use nalgebra::Matrix4;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use vidar_align::streaming::chunk_ranges;
use vidar_core::model::ChunkFrame;
use vidar_core::{
    ChunkId, ChunkViews, FrameId, GeometryModel, GeometryPrediction, Image, ModelError, ModelInfo, Se3,
    Timestamp,
};
use vidar_dataset::ImageEntry;

/// How the source is named: `recorded:DIR`.
pub const RECORDED: &str = "recorded:";

/// Which images a recorded chunk is of.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RecordedChunk {
    /// Places in the list of images, ascending.
    pub images: Vec<usize>,
    files: Files,
}

#[derive(Clone, Debug, PartialEq, Eq)]
enum Files {
    /// One file of all views with a sidecar.
    Described { npz: PathBuf, json: PathBuf },
    /// One file of all views.
    Plain(PathBuf),
    /// One file per view.
    PerFrame(Vec<PathBuf>),
}

/// What was recorded of the images at hand.
#[derive(Clone, Debug)]
pub struct RecordedGeometry {
    folder: PathBuf,
    /// Its chunks, in order.
    pub chunks: Vec<RecordedChunk>,
    /// `world_from_camera` per image of DA3-Streaming.
    poses: Vec<Se3>,
}

impl RecordedGeometry {
    /// Looks into `folder` and finds the images that its files are of.
    pub fn open(folder: &Path, images: &[ImageEntry], chunk: usize, overlap: usize) -> Result<Self, Error> {
        let names = names(folder)?;
        let mut recording = Self { folder: folder.to_owned(), chunks: Vec::new(), poses: Vec::new() };
        let of = |extension: &str| -> Vec<PathBuf> {
            names.iter().filter(|n| n.extension().is_some_and(|e| e == extension)).cloned().collect()
        };
        let described: Vec<PathBuf> =
            of("json").into_iter().filter(|j| j.with_extension("npz").exists() && !is_loop(j)).collect();
        if !described.is_empty() {
            recording.chunks =
                described.into_iter().map(|json| described_chunk(json, images)).collect::<Result<_, _>>()?;
        } else if folder.join("results_output").is_dir() {
            let frames = frames(&folder.join("results_output"), images.len())?;
            recording.poses = streaming_poses(&folder.join("camera_poses.txt"))?;
            recording.chunks = cut(frames, chunk, overlap)?;
        } else {
            let ranges = ranges(images.len(), chunk, overlap)?;
            let files = of("npz");
            if files.len() > ranges.len() {
                let reason = format!(
                    "{} chunks, but chunks of {chunk} with an overlap of {overlap} make {} of {} images",
                    files.len(),
                    ranges.len(),
                    images.len()
                );
                return Err(recording.bad(reason));
            }
            let chunk = |(file, range): (PathBuf, std::ops::Range<usize>)| RecordedChunk {
                images: range.collect(),
                files: Files::Plain(file),
            };
            recording.chunks = files.into_iter().zip(ranges).map(chunk).collect();
        }
        if recording.chunks.is_empty() {
            return Err(recording.bad(
                "it holds no chunks (*.npz with *.json, results_output/frame_*.npz, or *.npz in order)"
                    .into(),
            ));
        }
        Ok(recording)
    }

    fn bad(&self, reason: String) -> Error {
        Error::NotARecording { path: self.folder.clone(), reason }
    }

    /// The prediction of the chunk with that number, its views named by `ids`.
    fn read(&self, chunk: usize, ids: &[FrameId]) -> Result<StoredChunk, Error> {
        let number = ChunkId(u32::try_from(chunk).unwrap_or(u32::MAX));
        let recorded = self.chunks.get(chunk).ok_or_else(|| self.bad(format!("it has no chunk {chunk}")))?;
        match &recorded.files {
            Files::Plain(npz) => read_views(npz, ids, number, ChunkFrame::ModelNative, 1.0),
            Files::Described { npz, json } => {
                let sidecar =
                    read_sidecar(json)?.ok_or_else(|| self.bad(format!("chunk {chunk} was removed")))?;
                let mut stored = load(npz, PredictionId::Chunk(number), &sidecar)?;
                for (view, id) in stored.prediction.views.iter_mut().zip(ids) {
                    view.frame_id = *id;
                }
                Ok(stored)
            }
            Files::PerFrame(files) => self.read_frames(recorded, files, ids, number),
        }
    }

    fn read_frames(
        &self,
        recorded: &RecordedChunk,
        files: &[PathBuf],
        ids: &[FrameId],
        number: ChunkId,
    ) -> Result<StoredChunk, Error> {
        let mut all: Option<StoredChunk> = None;
        for ((file, id), image) in files.iter().zip(ids).zip(&recorded.images) {
            let mut one = read_views(file, &[*id], number, ChunkFrame::ModelNative, 0.0)?;
            let pose = self.poses.get(*image).ok_or_else(|| {
                self.bad(format!("camera_poses.txt has {} lines, frame {image} has none", self.poses.len()))
            })?;
            one.prediction.views.iter_mut().for_each(|v| v.chunk_from_camera = *pose);
            match &mut all {
                None => all = Some(one),
                Some(all) => {
                    all.prediction.views.append(&mut one.prediction.views);
                    all.times.append(&mut one.times);
                    all.colors.append(&mut one.colors);
                }
            }
        }
        all.ok_or_else(|| self.bad(format!("chunk {number} has no frames")))
    }
}

/// A recording as a geometry model: a chunk's number tells which prediction it gets.
pub struct RecordedModel {
    recording: RecordedGeometry,
    info: ModelInfo,
    /// Pictures of the last prediction, as its network saw them.
    colors: Vec<Image<[u8; 3]>>,
}

impl RecordedModel {
    /// The recording of a plan's chunks.
    pub fn new(recording: RecordedGeometry) -> Self {
        let name = format!("{RECORDED}{}", recording.folder.display());
        let info = ModelInfo {
            name,
            licence: "unknown".into(),
            weights_sha256: None,
            needs_poses: false,
            min_views: 1,
        };
        Self { recording, info, colors: Vec::new() }
    }

    /// Pictures of the last prediction at the depth's size; empty where none were recorded.
    pub fn take_colors(&mut self) -> Vec<Image<[u8; 3]>> {
        std::mem::take(&mut self.colors)
    }
}

impl GeometryModel for RecordedModel {
    fn info(&self) -> &ModelInfo {
        &self.info
    }

    /// Views whose image could not be read are missing in `views`; their recorded geometry is left out too.
    fn predict(&mut self, views: &ChunkViews) -> Result<GeometryPrediction, ModelError> {
        let number = views.id.0 as usize;
        let expected = self.recording.chunks.get(number).map_or(0, |c| c.images.len());
        if views.views.len() != expected {
            let reason = format!("{} of its {expected} images could be read", views.views.len());
            return Err(ModelError::Other(format!("recorded chunk {}: {reason}", views.id)));
        }
        let ids: Vec<FrameId> = views.views.iter().map(|v| v.frame_id).collect();
        let stored = self.recording.read(number, &ids).map_err(|e| ModelError::Other(e.to_string()))?;
        self.colors = stored.colors;
        Ok(stored.prediction)
    }
}

/// Depth of single images, whichever chunk of a recording they are in.
pub struct RecordedShapes {
    recording: RecordedGeometry,
    /// Images that the recording may be of.
    images: Vec<FrameId>,
    /// The chunk read last: neighbours ask for the same one.
    last: Option<(usize, StoredChunk)>,
}

impl RecordedShapes {
    /// Depth of `images` as the recording has it.
    pub fn new(recording: RecordedGeometry, images: &[ImageEntry]) -> Self {
        Self { recording, images: images.iter().map(|i| i.frame_id).collect(), last: None }
    }

    /// The folder.
    pub fn folder(&self) -> &Path {
        &self.recording.folder
    }

    /// z-depth of an image in the unit of its chunk; `None` where the recording does not hold it.
    pub fn shape(&mut self, frame: FrameId) -> Result<Option<Image<f32>>, Error> {
        let Some(image) = self.images.iter().position(|f| *f == frame) else { return Ok(None) };
        let holds = |chunk: &RecordedChunk| chunk.images.binary_search(&image).is_ok();
        let Some(chunk) = self.recording.chunks.iter().position(holds) else { return Ok(None) };
        if self.last.as_ref().is_none_or(|(read, _)| *read != chunk) {
            let ids: Vec<FrameId> = self.recording.chunks[chunk]
                .images
                .iter()
                .filter_map(|i| self.images.get(*i).copied())
                .collect();
            self.last = Some((chunk, self.recording.read(chunk, &ids)?));
        }
        let views = self.last.iter().flat_map(|(_, stored)| &stored.prediction.views);
        Ok(views.into_iter().find(|v| v.frame_id == frame).map(|v| v.depth.image().clone()))
    }
}

/// Files of a folder in natural order, so that `chunk_10` comes after `chunk_9`.
fn names(folder: &Path) -> Result<Vec<PathBuf>, Error> {
    let entries = std::fs::read_dir(folder).map_err(|e| Error::io("open", folder, e))?;
    let mut names: Vec<PathBuf> =
        entries.filter_map(|e| Some(e.ok()?.path())).filter(|p| p.is_file()).collect();
    names.sort_by_key(|p| natural(p));
    Ok(names)
}

/// The name without its digits, the numbers in it, and the name itself.
fn natural(path: &Path) -> (String, Vec<u64>, String) {
    let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    let words = name.chars().filter(|c| !c.is_ascii_digit()).collect();
    let numbers = name.split(|c: char| !c.is_ascii_digit()).filter_map(|n| n.parse().ok()).collect();
    (words, numbers, name)
}

fn described_chunk(json: PathBuf, images: &[ImageEntry]) -> Result<RecordedChunk, Error> {
    let bad = |reason: String| Error::NotARecording { path: json.clone(), reason };
    let sidecar = read_sidecar(&json)?.ok_or_else(|| bad("it was removed".into()))?;
    let place = |time: &i64| {
        let at = images.binary_search_by_key(&Timestamp::from_nanos(*time), |i| i.time).ok();
        at.ok_or_else(|| bad(format!("no image of the input was taken at {time} ns")))
    };
    let images = sidecar.times_ns.iter().map(place).collect::<Result<Vec<_>, _>>()?;
    let npz = json.with_extension("npz");
    Ok(RecordedChunk { images, files: Files::Described { npz, json } })
}

/// `frame_N.npz` by N.
fn frames(folder: &Path, images: usize) -> Result<BTreeMap<usize, PathBuf>, Error> {
    let number = |path: &PathBuf| -> Option<usize> {
        let stem = path.file_stem()?.to_str()?;
        (path.extension()? == "npz").then(|| stem.strip_prefix("frame_")?.parse().ok())?
    };
    let frames: BTreeMap<usize, PathBuf> =
        names(folder)?.into_iter().filter_map(|p| Some((number(&p)?, p))).collect();
    match frames.last_key_value() {
        Some((last, path)) if *last >= images => {
            let reason = format!(
                "it is of image {last}, the input has {images}; --stride and --start must be those of the recording"
            );
            Err(Error::NotARecording { path: path.clone(), reason })
        }
        _ => Ok(frames),
    }
}

/// A line of 16 numbers per image: `world_from_camera`, row by row.
fn streaming_poses(path: &Path) -> Result<Vec<Se3>, Error> {
    let text = crate::system::read_text_up_to(path, crate::system::MAX_JSON_BYTES)
        .map_err(|e| Error::io("read", path, e))?;
    let pose = |(number, line): (usize, &str)| {
        let values: Option<Vec<f64>> = line.split_whitespace().map(|v| v.parse().ok()).collect();
        let pose =
            values.filter(|v| v.len() == 16).and_then(|v| Se3::from_matrix(&Matrix4::from_row_slice(&v)));
        pose.filter(Se3::is_finite).ok_or_else(|| Error::NotARecording {
            path: path.to_owned(),
            reason: format!("line {} is no motion of 16 numbers", number + 1),
        })
    };
    text.lines().filter(|l| !l.trim().is_empty()).enumerate().map(pose).collect()
}

fn ranges(images: usize, chunk: usize, overlap: usize) -> Result<Vec<std::ops::Range<usize>>, Error> {
    let ranges =
        chunk_ranges(images, chunk, overlap).map_err(|e| Error::BadValue { reason: e.to_string() })?;
    Ok(ranges.into_iter().map(|r| r.frames).collect())
}

fn cut(frames: BTreeMap<usize, PathBuf>, chunk: usize, overlap: usize) -> Result<Vec<RecordedChunk>, Error> {
    let frames: Vec<(usize, PathBuf)> = frames.into_iter().collect();
    let part = |range: std::ops::Range<usize>| {
        let (images, files) = frames[range].iter().cloned().unzip();
        RecordedChunk { images, files: Files::PerFrame(files) }
    };
    Ok(ranges(frames.len(), chunk, overlap)?.into_iter().map(part).collect())
}
