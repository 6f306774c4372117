//! What a run would do, before it does anything.

use crate::config::Config;
use crate::error::Error;
use crate::input::{self, MetricAnchor};
use crate::keyframes::{PosedFrame, select_keyframes};
use crate::models::Located;
use crate::models::geometry::{self, NetworkPlan};
use std::ops::Range;
use std::path::Path;
use vidar_core::remap::undistorted_view;
use vidar_core::{CameraModel, ModelInfo, Pinhole, Warning};
use vidar_dataset::Dataset;

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
    /// The metric trajectory.
    pub anchor: MetricAnchor,
    /// Images in the input.
    pub images: usize,
    /// Images with a pose.
    pub posed: usize,
    /// The frames that carry geometry.
    pub keyframes: Vec<PosedFrame>,
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
    /// Looks at poses, camera and configuration.
    pub fn make(dataset: &Dataset, config: &Config, reference: Option<&Path>) -> Result<Self, Error> {
        if let Some(path) = reference {
            // Better said now than after an hour of depth.
            std::fs::File::open(path).map_err(|e| Error::io("read", path, e))?;
        }
        input::require_calibration(dataset)?;
        let anchor = input::metric_anchor(dataset, config)?;
        let (posed, mut warnings) = input::posed_frames(dataset, &anchor, config)?;
        warnings.extend(anchor.warnings.iter().cloned());
        let keyframes = select_keyframes(&posed, &config.keyframes);
        let source = Source::open(config)?;
        let needed = source.info().min_views;
        if keyframes.len() < needed {
            return Err(Error::TooFewKeyframes { found: keyframes.len(), needed });
        }
        let camera = camera_model(dataset)?;
        let view = model_view(&camera, config)?;
        let coverage = vidar_core::remap::RemapTable::new(&camera, &view).coverage();
        if coverage < 0.95 {
            let seen = format!("the undistorted view sees {:.0} % of its pixels", coverage * 100.0);
            warnings.push(Warning::new("view-coverage", seen).hint("check the calibration's distortion"));
        }
        let chunks =
            chunks(keyframes.len(), config.geometry.chunk_keyframes, config.geometry.context_keyframes);
        let network = source.planned(config, &view, &chunks, &mut warnings)?;
        Ok(Self {
            started: crate::run_folder::now_rfc3339(),
            input: format!("{}: {} ({})", dataset.name, dataset.kind, dataset.reason),
            images: dataset.images.len(),
            posed: posed.len(),
            chunks,
            disk_bytes: disk_bytes(keyframes.len(), &view, config),
            keyframes,
            camera,
            view,
            model: source.info().clone(),
            network,
            reference: reference_source(dataset, config, reference),
            depth_units_per_metre: config.output.depth_units_per_metre,
            volume_budget_bytes: config.fusion.memory_budget_bytes,
            anchor,
            warnings,
        })
    }

    /// The plan in lines of label and text, for `--dry-run` and the report.
    pub fn lines(&self) -> Vec<(&'static str, String)> {
        let k = &self.view;
        let mut lines = vec![
            ("input", self.input.clone()),
            ("metric poses", self.anchor.source.to_string()),
            ("images", format!("{} ({} with a pose)", self.images, self.posed)),
            ("keyframes", format!("{} in {} chunks", self.keyframes.len(), self.chunks.len())),
            ("camera", format!("{} {}x{}", self.camera.name(), self.camera.width(), self.camera.height())),
            ("model view", format!("{}x{} px, f {:.1}/{:.1} px, undistorted", k.width, k.height, k.fx, k.fy)),
            ("geometry", format!("{} ({})", self.model.name, self.model.licence)),
            ("judged against", self.reference.to_string()),
            ("memory of the map", format!("at most {}", bytes(self.volume_budget_bytes))),
            ("disk", format!("at most {}", bytes(self.disk_bytes))),
        ];
        if let Some(network) = &self.network {
            let (memory, views) = (bytes(network.memory.total()), network.views_at_once);
            lines.push(("memory of the network", format!("about {memory} for {views} views at once")));
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

/// The geometry model of a plan, opened to be asked what it is and needs.
enum Source {
    Stereo(Box<dyn vidar_core::GeometryModel>),
    Network(Box<(vidar_da3::Da3Model, Located)>),
}

impl Source {
    fn open(config: &Config) -> Result<Self, Error> {
        Ok(match geometry::chosen(config)? {
            None => Self::Stereo(super::dense::model(config)?),
            Some(choice) => Self::Network(Box::new(geometry::open(&choice, config)?)),
        })
    }

    fn info(&self) -> &ModelInfo {
        match self {
            Self::Stereo(model) => model.info(),
            Self::Network(network) => vidar_core::GeometryModel::info(&network.0),
        }
    }

    fn planned(
        &self,
        config: &Config,
        view: &Pinhole,
        chunks: &[ChunkPlan],
        warnings: &mut Vec<Warning>,
    ) -> Result<Option<NetworkPlan>, Error> {
        let Self::Network(network) = self else { return Ok(None) };
        let (model, located) = network.as_ref();
        let views = chunks.iter().map(|c| c.seen.len()).max().unwrap_or(0);
        let (plan, noticed) = geometry::planned(model, located, config, view, views)?;
        warnings.extend(noticed);
        Ok(Some(plan))
    }
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

/// Upper bound: raw 16-bit depth and 24-bit colour per keyframe, and the volume's share for map files.
fn disk_bytes(keyframes: usize, view: &Pinhole, config: &Config) -> u64 {
    let pixels = (view.width * view.height * keyframes) as u64;
    let per_pixel = 2 * u64::from(config.output.depth_png) + 3 * u64::from(config.output.images);
    pixels * per_pixel + (256 << 20)
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
    fn sizes_are_readable() {
        assert_eq!(bytes(12), "12 B");
        assert_eq!(bytes(3 << 19), "1.5 MiB");
        assert_eq!(bytes(5 << 29), "2.50 GiB");
    }
}
