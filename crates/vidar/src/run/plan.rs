//! What a run would do: all that is known before anything is tracked or predicted.

use super::budget::Budget;
use super::place_recognition::PlaceRecognition;
use super::source::{OpenedSource, Source};
use crate::calibrate::MissingCalibration;
use crate::config::Config;
use crate::engine::{ChunkRule, GeometrySource, PosedFrame, Selection, chunk_rule};
use crate::error::Error;
use crate::input::{self, PosePlan};
use crate::masks::Masks;
use crate::models::device_memory;
use crate::models::geometry::NetworkPlan;
use std::path::Path;
use std::sync::Arc;
use vidar_align::CouplingMode;
use vidar_core::remap::undistorted_view;
use vidar_core::{CameraId, CameraModel, FrameId, ModelInfo, Pinhole, Warning};
use vidar_dataset::{ImageEntry, Recording};

/// Keyframes and chunks, where they are known before tracking.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ExpectedWork {
    /// Images with a pose.
    pub posed: usize,
    /// Keyframes.
    pub keyframes: usize,
    /// Chunks.
    pub chunks: usize,
    /// Keyframes that the model sees, over all chunks.
    pub seen: usize,
    /// Most keyframes that the model sees at once.
    pub largest: usize,
}

/// The plan of a run.
#[derive(Clone, Debug)]
pub struct Plan {
    /// When it was made, RFC 3339.
    pub started: String,
    /// Recording name and kind, and why that kind.
    pub input: String,
    /// How depth is coupled to the metric poses.
    pub mode: CouplingMode,
    /// Where metric poses come from.
    pub poses: PosePlan,
    /// Images that may become keyframes.
    pub images: usize,
    /// Keyframes and chunks; none where the odometry decides them.
    pub expected: Option<ExpectedWork>,
    /// Frames of each chunk, where a recording prescribes them.
    pub prescribed: Option<Vec<Vec<FrameId>>>,
    /// Which camera is in use.
    pub camera_id: CameraId,
    /// The camera as it is.
    pub camera: CameraModel,
    /// What of the calibration is still to be found; nothing once a run has calibrated.
    pub missing_calibration: Option<MissingCalibration>,
    /// The undistorted view that the model gets.
    pub view: Pinhole,
    /// The geometry model.
    pub model: ModelInfo,
    /// The network it is, where it is one.
    pub network: Option<NetworkPlan>,
    /// Descriptors of place recognition: `salad`, `model` or `image`.
    pub place_recognition: &'static str,
    /// What the result will be compared with.
    pub reference: ReferenceSource,
    /// Units of the depth PNG per metre.
    pub depth_units_per_metre: f64,
    /// Memory bound of the fused volume, bytes.
    pub volume_budget_bytes: u64,
    /// Disk that the run folder will take at most, bytes.
    pub disk_bytes: u64,
    /// Masks of the images, where there are any.
    pub masks: Option<Arc<Masks>>,
    /// The time budget with what was chosen for it; none without a limit, and before the poses that it depends on are known.
    pub budget: Option<Budget>,
    /// What the workers elsewhere compute with, where they are asked.
    pub remote: Option<vidar_link::geometry::ModelFacts>,
    /// Warnings about the input and the settings.
    pub warnings: Vec<Warning>,
}

/// What the surface is compared with.
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
    /// Checks poses, camera and configuration, and opens the geometry model and place recognition. Nothing is tracked,
    /// predicted or written.
    pub fn make(
        dataset: &Recording,
        config: &Config,
        reference: Option<&Path>,
    ) -> Result<(Self, Source, PlaceRecognition), Error> {
        if let Some(path) = reference {
            // Better refused now than after an hour of depth.
            std::fs::File::open(path).map_err(|e| Error::io("read", path, e))?;
        }
        if input::needs_calibration(config) {
            input::require_calibration(dataset)?;
        }
        let images = input::strided(dataset, config);
        let OpenedSource { mut source, chunks } = Source::open(dataset, &images, config)?;
        let frames_of = |chunk: Vec<usize>| chunk.into_iter().map(|i| images[i].frame_id).collect();
        let prescribed: Option<Vec<Vec<FrameId>>> = chunks.map(|c| c.into_iter().map(frames_of).collect());
        let place_recognition = PlaceRecognition::open(config, &mut source)?;
        let poses = PosePlan::new(dataset, config)?;
        let rule = chunk_rule(config, source.overlaps(), prescribed.clone());
        let expected = expected_work(dataset, &images, &poses, &rule, config)?;
        let needed = source.info().min_views.max(1);
        let found = expected.map_or(images.len(), |e| e.keyframes);
        if found < needed {
            return Err(Error::TooFewKeyframes { found, needed });
        }
        let masks = match config.input.masks.as_str() {
            "" => None,
            folder => Some(Arc::new(Masks::open(Path::new(folder), dataset)?)),
        };
        let mut warnings: Vec<Warning> = poses.warning(dataset, config).into_iter().collect();
        let camera = camera_model(dataset)?;
        let view = model_view(&camera, config)?;
        let coverage = vidar_core::remap::RemapTable::new(&camera, &view).coverage();
        if coverage < 0.95 {
            let seen = format!("the undistorted view shows {:.0} % of its pixels", coverage * 100.0);
            warnings.push(Warning::new("view-coverage", seen).hint("check the calibration's distortion"));
        }
        let views_at_once = expected.map_or(rule.largest().min(images.len()), |e| e.largest);
        let network = source.planned(config, &view, views_at_once, &mut warnings)?;
        let volume_budget_bytes = map_budget(config, views_at_once, &view, network.as_ref())?;
        let plan = Self {
            started: crate::run_folder::now_rfc3339(),
            input: format!("{}: {} ({})", dataset.name, dataset.kind, dataset.reason),
            mode: config.coupling.mode,
            images: images.len(),
            disk_bytes: disk_bytes(expected, images.len(), &rule, &view, config),
            expected,
            prescribed,
            camera_id: dataset.camera,
            camera,
            missing_calibration: None,
            view,
            model: source.info().clone(),
            remote: source.remote().map(|r| r.facts().clone()),
            place_recognition: place_recognition.name(),
            network,
            reference: reference_source(dataset, config, reference),
            depth_units_per_metre: config.output.depth_units_per_metre,
            volume_budget_bytes,
            poses,
            masks,
            budget: None,
            warnings,
        };
        Ok((plan, source, place_recognition))
    }

    /// Where metric poses come from, in words.
    pub fn pose_source(&self) -> String {
        match (&self.poses, self.poses.source()) {
            (PosePlan::Odometry { fallback: Some(fallback) }, Some(source)) => {
                format!("{source}; if it fails, {}", fallback.source)
            }
            (_, Some(source)) => source.to_string(),
            (_, None) => "none: lengths are not metres".to_owned(),
        }
    }

    /// The plan in lines of label and text, for `--dry-run` and the report.
    pub fn lines(&self) -> Vec<(&'static str, String)> {
        let k = &self.view;
        let (images, keyframes) = match &self.expected {
            Some(e) => {
                let images = format!("{} ({} with a pose)", self.images, e.posed);
                (images, format!("{} in {} chunks", e.keyframes, e.chunks))
            }
            None => {
                (self.images.to_string(), "known when the odometry has tracked; cut into chunks".to_owned())
            }
        };
        let mut lines = vec![
            ("input", self.input.clone()),
            ("metric poses", self.pose_source()),
            ("coupling", self.mode.to_string()),
            ("images", images),
            ("keyframes", keyframes),
            ("camera", format!("{} {}x{}", self.camera.name(), self.camera.width(), self.camera.height())),
            ("model view", format!("{}x{} px, f {:.1}/{:.1} px, undistorted", k.width, k.height, k.fx, k.fy)),
            ("geometry", format!("{} ({})", self.model.name, self.model.licence)),
            ("place recognition", self.place_recognition.to_owned()),
            ("compared with", self.reference.to_string()),
            ("memory of the map", format!("at most {}", bytes(self.volume_budget_bytes))),
            ("disk", format!("at most {}", bytes(self.disk_bytes))),
        ];
        lines.extend(self.missing_calibration.map(|missing| ("calibration", missing.words().to_owned())));
        if let Some(network) = &self.network {
            let (memory, views) = (bytes(network.memory.total()), network.views_at_once);
            lines.push(("memory of the network", format!("about {memory} for {views} views at once")));
            lines.push(("computes", network.arithmetic.clone()));
            if let Some(device) = &network.device {
                lines.push(("device", device.device.clone()));
                lines.push(("memory of the device", device_memory(device)));
            }
        }
        if let Some(remote) = &self.remote {
            let (model, licence) =
                (vidar_core::printable(&remote.model), vidar_core::printable(&remote.licence));
            let arithmetic = vidar_core::printable(&remote.arithmetic);
            lines.push(("computed elsewhere", format!("{model} ({licence}), {arithmetic}")));
        }
        if let Some(masks) = &self.masks {
            lines.push(("masks", masks.words()));
        }
        if let Some(budget) = &self.budget {
            lines.push(("time budget", budget.words()));
        }
        lines
    }

    /// The model as manifests have it.
    pub fn model_json(&self) -> serde_json::Value {
        let mut value = serde_json::json!(self.model);
        if let (Some(object), Some(network)) = (value.as_object_mut(), &self.network) {
            object.insert("network".to_owned(), serde_json::json!(network));
        }
        if let (Some(object), Some(remote)) = (value.as_object_mut(), &self.remote) {
            object.insert("remote".to_owned(), serde_json::json!(remote));
        }
        value
    }
}

/// Keyframes and chunks, where no odometry has to track for them.
fn expected_work(
    dataset: &Recording,
    images: &[ImageEntry],
    poses: &PosePlan,
    rule: &ChunkRule,
    config: &Config,
) -> Result<Option<ExpectedWork>, Error> {
    // Given poses come without keyframes of the odometry, so none is preferred.
    let mut selection = Selection::new(&config.keyframes, false);
    let stamps = images.iter().map(input::stamp_of);
    let (posed, keyframes) = match poses {
        PosePlan::Odometry { .. } => return Ok(None),
        PosePlan::None => {
            let stamps: Vec<_> = stamps.collect();
            (0, selection.among_unposed(&stamps, rule, true))
        }
        PosePlan::Given(trajectory) => {
            let Some(given) = poses.given(dataset, config) else { return Ok(None) };
            input::require_overlap(images, &given, &trajectory.camera_trajectory)?;
            let posed = |stamp: crate::engine::FrameStamp| {
                let world_from_camera = given.pose_at(stamp.time)?;
                Some(PosedFrame { stamp, world_from_camera, odometry: None })
            };
            let posed: Vec<PosedFrame> = stamps.filter_map(posed).collect();
            (posed.len(), selection.among_posed(&posed, rule, true))
        }
    };
    let frames: Vec<FrameId> = keyframes.iter().map(|k| k.stamp.frame_id).collect();
    let chunks = rule.chunks(&frames)?;
    Ok(Some(ExpectedWork {
        posed,
        keyframes: keyframes.len(),
        chunks: chunks.len(),
        seen: chunks.iter().map(|c| c.seen.len()).sum(),
        largest: chunks.iter().map(|c| c.seen.len()).max().unwrap_or(0),
    }))
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

fn camera_model(dataset: &Recording) -> Result<CameraModel, Error> {
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

fn reference_source(dataset: &Recording, config: &Config, given: Option<&Path>) -> ReferenceSource {
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
    // The surface is extracted, evaluated and written beside the volume: about as much again, and half.
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

/// Upper bound: raw 16-bit depth and 24-bit colour per keyframe, every chunk's prediction (depth and confidence of 32 bits,
/// colour), and the volume's share for map files. Where the keyframes are not known, every image may become one.
fn disk_bytes(
    expected: Option<ExpectedWork>,
    images: usize,
    rule: &ChunkRule,
    view: &Pinhole,
    config: &Config,
) -> u64 {
    let keyframes = expected.map_or(images, |e| e.keyframes);
    let predicted = expected.map_or_else(
        || {
            let frames: Vec<FrameId> = (0..u32::try_from(images).unwrap_or(u32::MAX)).map(FrameId).collect();
            rule.chunks(&frames).map_or(images, |c| c.iter().map(|c| c.seen.len()).sum())
        },
        |e| e.seen,
    );
    let pixels = (view.width * view.height) as u64;
    let per_pixel = 2 * u64::from(config.output.depth_png) + 3 * u64::from(config.output.images);
    pixels * (per_pixel * keyframes as u64 + 11 * predicted as u64) + (256 << 20)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_readable() {
        assert_eq!(bytes(12), "12 B");
        assert_eq!(bytes(3 << 19), "1.5 MiB");
        assert_eq!(bytes(5 << 29), "2.50 GiB");
    }
}
