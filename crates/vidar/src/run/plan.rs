//! What a run would do, before it does anything.

use super::looks::Looks;
use super::source::{Opened, Source};
use crate::config::{Config, PoseSource};
use crate::error::Error;
use crate::events::{CancelToken, Events};
use crate::input::{self, MetricAnchor};
use crate::keyframes::{Keyframe, select_by_time, select_keyframes};
use crate::models::device_memory;
use crate::models::geometry::NetworkPlan;
use std::collections::BTreeSet;
use std::ops::Range;
use std::path::Path;
use vidar_align::CouplingMode;
use vidar_align::streaming::chunk_ranges;
use vidar_core::remap::undistorted_view;
use vidar_core::{CameraModel, ModelInfo, Pinhole, Se3, Warning};
use vidar_dataset::{Dataset, ImageEntry};

/// A chunk: the keyframes whose depth is wanted, inside those that are seen.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ChunkPlan {
    /// Indices of the keyframes whose depth is computed.
    pub core: Range<usize>,
    /// Indices of the keyframes that are seen.
    pub seen: Range<usize>,
}

/// The plan of a run.
#[derive(Clone, Debug)]
pub struct Plan {
    /// When it was made, RFC 3339.
    pub started: String,
    /// Dataset name and kind, and why that kind.
    pub input: String,
    /// How depth is coupled to the metric poses.
    pub mode: CouplingMode,
    /// The metric trajectory; none where the mode needs none and there is none.
    pub anchor: Option<MetricAnchor>,
    /// Images in the input.
    pub images: usize,
    /// Images with a pose.
    pub posed: usize,
    /// The frames that carry geometry.
    pub keyframes: Vec<Keyframe>,
    /// The chunks in order.
    pub chunks: Vec<ChunkPlan>,
    /// The camera as it is.
    pub camera: CameraModel,
    /// The undistorted view that the model gets.
    pub view: Pinhole,
    /// The geometry model.
    pub model: ModelInfo,
    /// The network it is, where it is one.
    pub network: Option<NetworkPlan>,
    /// How places are told again: `salad`, `model` or `pictures`.
    pub places: &'static str,
    /// What the result will be judged against.
    pub reference: ReferenceSource,
    /// Units of the depth PNG per metre.
    pub depth_units_per_metre: f64,
    /// Memory bound of the fused volume, bytes.
    pub volume_budget_bytes: u64,
    /// Disk that the run folder will take at most, bytes.
    pub disk_bytes: u64,
    /// What was noticed.
    pub warnings: Vec<Warning>,
}

/// What the surface is judged against.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ReferenceSource {
    /// A point cloud file.
    Cloud(std::path::PathBuf),
    /// The depth sensor's images, fused with ground-truth poses.
    DepthSensor,
    /// Nothing.
    None,
}

impl Plan {
    /// Looks at poses, camera and configuration, and opens the source of geometry and what tells places.
    pub fn make(
        dataset: &Dataset,
        config: &Config,
        reference: Option<&Path>,
        events: &Events,
        cancel: &CancelToken,
    ) -> Result<(Self, (Source, Looks)), Error> {
        if let Some(path) = reference {
            // Better said now than after an hour of depth.
            std::fs::File::open(path).map_err(|e| Error::io("read", path, e))?;
        }
        input::require_calibration(dataset)?;
        let images = input::strided(dataset, config);
        let Opened { mut source, chunks: recorded } = Source::open(dataset, &images, config)?;
        // Better a wrong checkpoint now than after the odometry.
        let looks = Looks::open(config, &mut source)?;
        let anchor = anchor(dataset, config, events, cancel)?;
        let mut warnings = anchor.as_ref().map_or_else(Vec::new, |a| a.warnings.clone());
        let chosen = choose(dataset, &images, anchor.as_ref(), recorded, &source, config, &mut warnings)?;
        let (needed, found) = (source.info().min_views, chosen.keyframes.len());
        if found < needed.max(1) {
            return Err(Error::TooFewKeyframes { found, needed });
        }
        let camera = camera_model(dataset)?;
        let view = model_view(&camera, config)?;
        let coverage = vidar_core::remap::RemapTable::new(&camera, &view).coverage();
        if coverage < 0.95 {
            let seen = format!("the undistorted view sees {:.0} % of its pixels", coverage * 100.0);
            warnings.push(Warning::new("view-coverage", seen).hint("check the calibration's distortion"));
        }
        let views_at_once = chosen.chunks.iter().map(|c| c.seen.len()).max().unwrap_or(0);
        let network = source.planned(config, &view, views_at_once, &mut warnings)?;
        let volume_budget_bytes = map_budget(config, views_at_once, &view, network.as_ref())?;
        let plan = Self {
            started: crate::run_folder::now_rfc3339(),
            input: format!("{}: {} ({})", dataset.name, dataset.kind, dataset.reason),
            mode: config.coupling.mode,
            images: images.len(),
            posed: chosen.posed,
            disk_bytes: disk_bytes(chosen.keyframes.len(), &chosen.chunks, &view, config),
            keyframes: chosen.keyframes,
            chunks: chosen.chunks,
            camera,
            view,
            model: source.info().clone(),
            places: looks.word(),
            network,
            reference: reference_source(dataset, config, reference),
            depth_units_per_metre: config.output.depth_units_per_metre,
            volume_budget_bytes,
            anchor,
            warnings,
        };
        Ok((plan, (source, looks)))
    }

    /// Where metric poses come from, in words.
    pub fn poses(&self) -> String {
        self.anchor
            .as_ref()
            .map_or_else(|| "none: lengths are not metres".to_owned(), |a| a.source.to_string())
    }

    /// Whether the map comes out in metres.
    pub fn is_metric(&self) -> bool {
        self.anchor.is_some() && self.mode.uses_pose_priors()
    }

    /// The plan in lines of label and text, for `--dry-run` and the report.
    pub fn lines(&self) -> Vec<(&'static str, String)> {
        let k = &self.view;
        let mut lines = vec![
            ("input", self.input.clone()),
            ("metric poses", self.poses()),
            ("coupling", self.mode.to_string()),
            ("images", format!("{} ({} with a pose)", self.images, self.posed)),
            ("keyframes", format!("{} in {} chunks", self.keyframes.len(), self.chunks.len())),
            ("camera", format!("{} {}x{}", self.camera.name(), self.camera.width(), self.camera.height())),
            ("model view", format!("{}x{} px, f {:.1}/{:.1} px, undistorted", k.width, k.height, k.fx, k.fy)),
            ("geometry", format!("{} ({})", self.model.name, self.model.licence)),
            ("places told by", self.places.to_owned()),
            ("judged against", self.reference.to_string()),
            ("memory of the map", format!("at most {}", bytes(self.volume_budget_bytes))),
            ("disk", format!("at most {}", bytes(self.disk_bytes))),
        ];
        if let Some(network) = &self.network {
            let (memory, views) = (bytes(network.memory.total()), network.views_at_once);
            lines.push(("memory of the network", format!("about {memory} for {views} views at once")));
            lines.push(("computes", network.arithmetic.clone()));
            if let Some(device) = &network.device {
                lines.push(("device", device.device.clone()));
                lines.push(("memory of the device", device_memory(device)));
            }
        }
        lines
    }

    /// The model as manifests have it.
    pub fn model_json(&self) -> serde_json::Value {
        let mut value = serde_json::json!(self.model);
        if let (Some(object), Some(network)) = (value.as_object_mut(), &self.network) {
            object.insert("network".to_owned(), serde_json::json!(network));
        }
        value
    }
}

/// Metric poses, where there are any; a mode that needs none goes without.
fn anchor(
    dataset: &Dataset,
    config: &Config,
    events: &Events,
    cancel: &CancelToken,
) -> Result<Option<MetricAnchor>, Error> {
    let mode = config.coupling.mode;
    let mut config = config.clone();
    if mode == CouplingMode::GroundTruth {
        config.input.poses = PoseSource::GroundTruth;
    }
    match input::metric_anchor(dataset, &config, events, cancel) {
        Err(Error::NoAnchor { .. } | Error::NoOdometry { .. }) if !mode.uses_pose_priors() => Ok(None),
        other => other.map(Some),
    }
}

/// Which images carry geometry, and how they are cut.
struct Chosen {
    keyframes: Vec<Keyframe>,
    posed: usize,
    chunks: Vec<ChunkPlan>,
}

fn choose(
    dataset: &Dataset,
    images: &[ImageEntry],
    anchor: Option<&MetricAnchor>,
    recorded: Option<Vec<Vec<usize>>>,
    source: &Source,
    config: &Config,
    warnings: &mut Vec<Warning>,
) -> Result<Chosen, Error> {
    let posed = match anchor {
        None => None,
        Some(anchor) => {
            let (frames, noticed) = input::posed_frames(dataset, images, anchor, config)?;
            warnings.extend(noticed);
            Some(frames)
        }
    };
    let count = posed.as_ref().map_or(0, Vec::len);
    if let Some(chunks) = recorded {
        let pose_of = anchor.map(|a| input::poses_at(dataset, a, config));
        let (keyframes, chunks) = recorded_keyframes(images, &chunks, pose_of)?;
        return Ok(Chosen { keyframes, posed: count, chunks });
    }
    let keyframes: Vec<Keyframe> = match posed {
        Some(frames) => {
            // The odometry's keyframes come with landmarks, which tell a chunk's scale.
            let tracked = anchor.and_then(|a| a.tracked.as_ref()).filter(|_| knows_landmarks(config, source));
            let known: BTreeSet<_> = tracked.iter().flat_map(|t| &t.keyframes).map(|k| k.frame_id).collect();
            let chosen = select_keyframes(&frames, &config.keyframes, &|id| known.contains(&id));
            chosen.into_iter().map(Keyframe::from).collect()
        }
        None => select_by_time(images, &config.keyframes),
    };
    let geometry = &config.geometry;
    let chunks = match source.overlaps() {
        true => overlapping(keyframes.len(), geometry.chunk_keyframes, geometry.overlap_keyframes)?,
        false => chunks(keyframes.len(), geometry.chunk_keyframes, geometry.context_keyframes),
    };
    Ok(Chosen { keyframes, posed: count, chunks })
}

/// Whether landmarks of the odometry matter: where chunks have a scale of their own that is to be found.
fn knows_landmarks(config: &Config, source: &Source) -> bool {
    config.coupling.mode == CouplingMode::Coupled && source.overlaps()
}

/// The images that a recording is of, and its chunks as spans of them.
fn recorded_keyframes(
    images: &[ImageEntry],
    recorded: &[Vec<usize>],
    pose_of: Option<impl Fn(&ImageEntry) -> Option<Se3>>,
) -> Result<(Vec<Keyframe>, Vec<ChunkPlan>), Error> {
    let mut used: Vec<usize> = recorded.iter().flatten().copied().collect();
    used.sort_unstable();
    used.dedup();
    let keyframe = |&i: &usize| Keyframe {
        image: images[i].clone(),
        world_from_camera: pose_of.as_ref().and_then(|f| f(&images[i])),
    };
    let keyframes = used.iter().map(keyframe).collect();
    let span = |images: &Vec<usize>| {
        let first = images.first().and_then(|i| used.binary_search(i).ok())?;
        let range = first..first + images.len();
        (used.get(range.clone())? == images.as_slice()).then_some(range)
    };
    let spans: Option<Vec<Range<usize>>> = recorded.iter().map(span).collect();
    let spans = spans.ok_or_else(|| Error::BadValue {
        reason: "the recorded chunks are not spans of consecutive frames".into(),
    })?;
    Ok((keyframes, owned(spans)))
}

/// Chunks of `size` keyframes that share `overlap` with their neighbour.
fn overlapping(keyframes: usize, size: usize, overlap: usize) -> Result<Vec<ChunkPlan>, Error> {
    let ranges =
        chunk_ranges(keyframes, size, overlap).map_err(|e| Error::BadValue { reason: e.to_string() })?;
    Ok(owned(ranges.into_iter().map(|r| r.frames).collect()))
}

/// Each keyframe belongs to one chunk; what two share is halved between them, because geometry is worst at a chunk's ends.
fn owned(spans: Vec<Range<usize>>) -> Vec<ChunkPlan> {
    let middle = |a: &Range<usize>, b: &Range<usize>| {
        let shared = a.end.saturating_sub(b.start);
        b.start + shared / 2
    };
    let core = |k: usize| {
        let start = if k == 0 { spans[0].start } else { middle(&spans[k - 1], &spans[k]) };
        let end = spans.get(k + 1).map_or(spans[k].end, |next| middle(&spans[k], next));
        start..end.max(start)
    };
    (0..spans.len()).map(|k| ChunkPlan { core: core(k), seen: spans[k].clone() }).collect()
}

impl std::fmt::Display for ReferenceSource {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Cloud(path) => write!(f, "reference cloud {}", path.display()),
            Self::DepthSensor => f.write_str("the depth sensor's images, fused with ground-truth poses"),
            Self::None => f.write_str("nothing: no reference cloud and no depth sensor"),
        }
    }
}

/// A number of bytes as people read it.
pub fn bytes(n: u64) -> String {
    match n {
        0..=1023 => format!("{n} B"),
        1024..=1_048_575 => format!("{:.0} KiB", n as f64 / 1024.0),
        1_048_576..=1_073_741_823 => format!("{:.1} MiB", n as f64 / 1_048_576.0),
        _ => format!("{:.2} GiB", n as f64 / 1_073_741_824.0),
    }
}

fn camera_model(dataset: &Dataset) -> Result<CameraModel, Error> {
    match dataset.rig.camera(dataset.camera) {
        Some(camera) => Ok(camera.model.clone()),
        None => Err(vidar_core::TrajectoryError::NoSuchCamera(dataset.camera).into()),
    }
}

/// The largest undistorted view that is not wider than the configuration allows.
fn model_view(camera: &CameraModel, config: &Config) -> Result<Pinhole, Error> {
    let (width, height) = (camera.width(), camera.height());
    let target = width.min(config.geometry.max_width_px);
    let scaled = (height as f64 * target as f64 / width as f64).round().max(1.0) as usize;
    Ok(undistorted_view(camera, target, scaled)?)
}

fn chunks(keyframes: usize, size: usize, context: usize) -> Vec<ChunkPlan> {
    (0..keyframes)
        .step_by(size)
        .map(|start| {
            let end = (start + size).min(keyframes);
            ChunkPlan {
                core: start..end,
                seen: start.saturating_sub(context)..(end + context).min(keyframes),
            }
        })
        .collect()
}

fn reference_source(dataset: &Dataset, config: &Config, given: Option<&Path>) -> ReferenceSource {
    let has_depth =
        dataset.depth_sensor.is_some() && !dataset.depths.is_empty() && dataset.ground_truth.is_some();
    match (config.eval.mode, given.or(dataset.reference_cloud.as_deref())) {
        (crate::config::EvalMode::Off, _) => ReferenceSource::None,
        (_, Some(path)) => ReferenceSource::Cloud(path.to_owned()),
        (_, None) if has_depth => ReferenceSource::DepthSensor,
        _ => ReferenceSource::None,
    }
}

/// What the map may take: the fusion's own bound, or what `limits.memory_bytes` leaves beside network and chunk.
fn map_budget(
    config: &Config,
    views: usize,
    view: &Pinhole,
    network: Option<&NetworkPlan>,
) -> Result<u64, Error> {
    let asked = config.fusion.memory_budget_bytes;
    if config.limits.memory_bytes == 0 {
        return Ok(asked);
    }
    // Images read and undistorted, depth and confidence as predicted, packed for the disk, and read back.
    let chunk = (views * view.width * view.height) as u64 * CHUNK_BYTES_PER_PIXEL;
    let network = network.map_or(0, |n| n.memory.total());
    let taken = PROGRAM_BYTES + chunk + network;
    // The surface is extracted, judged and written beside the volume: about as much again, and half.
    let left = config.limits.memory_bytes.saturating_sub(taken) * 2 / 5;
    if left < LEAST_MAP_BYTES {
        return Err(Error::BadValue {
            reason: format!(
                "limits.memory_bytes is {}, but the program takes {}, a chunk of {views} views {}, the network {}, and a map \
                 at least {}: lower geometry.chunk_keyframes or geometry.max_width_px, take a smaller network, or allow more",
                bytes(config.limits.memory_bytes),
                bytes(PROGRAM_BYTES),
                bytes(chunk),
                bytes(network),
                bytes(LEAST_MAP_BYTES * 5 / 2),
            ),
        });
    }
    Ok(asked.min(left))
}

/// Code, tables, the odometry and the aligner's samples.
const PROGRAM_BYTES: u64 = 96 << 20;
/// Largest number of bytes that a pixel of a chunk takes at once.
const CHUNK_BYTES_PER_PIXEL: u64 = 48;
/// A map smaller than this is not worth a run.
const LEAST_MAP_BYTES: u64 = 16 << 20;

/// Upper bound: raw 16-bit depth and 24-bit colour per keyframe, every chunk's prediction (depth and confidence of
/// 32 bits, colour), and the volume's share for map files.
fn disk_bytes(keyframes: usize, chunks: &[ChunkPlan], view: &Pinhole, config: &Config) -> u64 {
    let pixels = (view.width * view.height) as u64;
    let per_pixel = 2 * u64::from(config.output.depth_png) + 3 * u64::from(config.output.images);
    let predicted: usize = chunks.iter().map(|c| c.seen.len()).sum();
    pixels * (per_pixel * keyframes as u64 + 11 * predicted as u64) + (256 << 20)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chunks_cover_every_keyframe_once_and_see_their_neighbours() {
        let plan = chunks(37, 16, 4);
        assert_eq!(plan.iter().map(|c| c.core.len()).sum::<usize>(), 37);
        assert_eq!(plan[0], ChunkPlan { core: 0..16, seen: 0..20 });
        assert_eq!(plan[1], ChunkPlan { core: 16..32, seen: 12..36 });
        assert_eq!(plan[2], ChunkPlan { core: 32..37, seen: 28..37 });
        assert!(chunks(0, 16, 4).is_empty());
    }

    #[test]
    fn overlapping_chunks_own_every_keyframe_once() {
        let plan = overlapping(37, 16, 4).unwrap();
        assert_eq!(plan[0], ChunkPlan { core: 0..14, seen: 0..16 });
        assert_eq!(plan[1], ChunkPlan { core: 14..26, seen: 12..28 });
        assert_eq!(plan[2], ChunkPlan { core: 26..37, seen: 24..37 });
        assert!(overlapping(10, 4, 4).is_err());
        assert_eq!(overlapping(3, 16, 4).unwrap(), [ChunkPlan { core: 0..3, seen: 0..3 }]);
    }

    #[test]
    fn sizes_are_readable() {
        assert_eq!(bytes(12), "12 B");
        assert_eq!(bytes(3 << 19), "1.5 MiB");
        assert_eq!(bytes(5 << 29), "2.50 GiB");
    }
}
