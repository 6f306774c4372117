//! `vidar depth`: the plain use of Depth Anything 3. Images in; depth, confidence, cameras and a cloud out.
//!
//! ```text
//! images ─▶ (cameras of the same images) ─▶ network ─▶ prediction ─▶ files
//! ```
//!
//! All images are predicted together. The run folder holds `predictions.json` (the result, in VIDAR's conventions),
//! `manifest.json` (how it was made), and the formats asked for.

mod at_input;
mod format;
mod inputs;
mod record;
mod write;

pub use format::{DepthFormat, Resolution, parse_formats};

use crate::error::Error;
use crate::events::{CancelToken, Events};
use crate::models::{self, LicenceAccepted, LocatedModel, MemoryPlan, ModelChoice, planned_memory};
use crate::run::bytes;
use crate::run_folder::{OutputLocation, RunFolder};
use at_input::Mapping;
use inputs::{Cameras, Picture};
use serde::Serialize;
use std::path::PathBuf;
use vidar_core::Warning;
use vidar_da3::preprocess::processed_size;
use vidar_da3::{Da3, Da3Error, Da3Options, DevicePlan, Hooks, InferOptions, Inputs, Prediction, Variant};
use vidar_export::official::SceneOptions;
use vidar_hub::Store;

/// Inputs, network and outputs.
#[derive(Clone, Debug)]
pub struct DepthRequest {
    /// Images, folders of images, videos and bags, in order.
    pub inputs: Vec<PathBuf>,
    /// The network.
    pub model: ModelChoice,
    /// A licence that the user accepts.
    pub accepted: Option<LicenceAccepted>,
    /// The checkpoints of this machine.
    pub store: Store,
    /// Options of the network.
    pub da3: Da3Options,
    /// Options of the inference.
    pub infer: InferOptions,
    /// Known cameras: a `transforms.json`, a COLMAP model, or a run folder.
    pub poses: Option<PathBuf>,
    /// Focal length in pixels of the images, for the metric network.
    pub focal_px: Option<f64>,
    /// What to write.
    pub formats: Vec<DepthFormat>,
    /// At which size cloud and depth images are written.
    pub resolution: Resolution,
    /// What becomes a point.
    pub scene: SceneOptions,
    /// Where results go.
    pub place: OutputLocation,
    /// The command as typed.
    pub command: Vec<String>,
}

/// The plan of a run.
#[derive(Clone, Debug)]
pub struct DepthPlan {
    /// The images in order.
    pub images: Vec<PathBuf>,
    /// The same, with the recordings that they lie in.
    sources: Vec<inputs::Source>,
    /// Columns and rows of the network's input.
    pub processed: (usize, usize),
    /// The model, or why it cannot be used yet.
    pub model: Result<LocatedModel, String>,
    /// Memory, where the architecture is known.
    pub memory: Option<MemoryPlan>,
    /// The graphics processor and what it must hold; none where the CPU computes, or nothing is known of the network.
    pub device: Option<DevicePlan>,
    /// Where known cameras come from.
    pub cameras: Option<String>,
    /// Warnings.
    pub warnings: Vec<Warning>,
    name: String,
    formats: Vec<DepthFormat>,
}

/// The result of a run.
#[derive(Clone, Debug, Serialize)]
pub struct DepthOutcome {
    /// The folder.
    pub folder: PathBuf,
    /// Views with depth.
    pub views: usize,
    /// Columns and rows of the prediction.
    pub size: (usize, usize),
    /// The unit of depth.
    pub unit: Unit,
    /// The reason for the unit.
    pub unit_reason: String,
    /// Files, relative to the folder.
    pub artifacts: Vec<String>,
    /// Warnings.
    pub warnings: Vec<Warning>,
    /// Wall time of the network, s.
    pub network_secs: f64,
    /// Wall time of everything, s.
    pub seconds: f64,
}

/// The unit of depth.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Unit {
    /// A metre.
    Metre,
    /// The unit of the cameras given.
    GivenCameras,
    /// The network's own: one unknown factor for all views.
    Arbitrary,
}

/// Plans a run from images, cameras and model: what it does and what it needs.
pub fn plan(request: &DepthRequest) -> Result<DepthPlan, Error> {
    let sources = inputs::list(&request.inputs)?;
    let images: Vec<PathBuf> = sources.iter().map(|s| s.path.clone()).collect();
    let sizes = sources.iter().map(inputs::Source::size).collect::<Result<Vec<_>, _>>()?;
    let processed = joint_size(&sizes, request)?;
    let cameras = request.poses.as_ref().map(|path| Cameras::read(path)).transpose()?;
    if let Some(cameras) = &cameras {
        cameras.of_images(&images, &sizes)?;
    }
    let mut warnings = Vec::new();
    let model = match models::locate(&request.model, request.accepted.as_ref(), &request.store) {
        Ok(located) => Ok(located),
        Err(error @ Error::WeightsMissing(_)) => Err(error.to_string()),
        Err(error) => return Err(error),
    };
    let config = match (&model, models::architecture(&request.model)) {
        (_, Some(config)) => Some(config),
        (Ok(located), None) => Some(located.open(&request.da3)?.config().clone()),
        (Err(_), None) => None,
    };
    let memory = config.as_ref().map(|c| planned_memory(c, images.len(), processed));
    let size = (images.len(), processed.1, processed.0);
    let planned =
        config.map(|c| request.da3.device.plan(&c, size, request.infer.use_ray_pose)).transpose()?;
    let device = planned.flatten();
    // What a device computes takes the device's memory.
    warnings.extend(memory.as_ref().filter(|_| device.is_none()).and_then(models::memory_warning));
    Ok(DepthPlan {
        device,
        processed,
        memory,
        cameras: cameras.map(|c| format!("{} of {}", c.source, c.count())),
        warnings,
        model,
        images,
        sources,
        name: request.model.name(),
        formats: request.formats.clone(),
    })
}

/// Columns and rows after the smallest common crop, which is what a batch ends with.
fn joint_size(sizes: &[(usize, usize)], request: &DepthRequest) -> Result<(usize, usize), Error> {
    let mut joint = (usize::MAX, usize::MAX);
    for &(width, height) in sizes {
        let (w, h) = processed_size(width, height, &request.infer.preprocess)?;
        joint = (joint.0.min(w), joint.1.min(h));
    }
    Ok(joint)
}

impl DepthPlan {
    /// The plan in lines of label and text.
    pub fn lines(&self) -> Vec<(&'static str, String)> {
        let (model, licence) = match &self.model {
            Ok(m) => (m.identity.name.clone(), m.identity.licence.clone()),
            Err(reason) => (self.name.clone(), format!("not ready: {reason}")),
        };
        let formats: Vec<&str> = self.formats.iter().map(|f| f.name()).collect();
        let mut lines = vec![
            ("images", self.images.len().to_string()),
            ("network input", format!("{}x{} px", self.processed.0, self.processed.1)),
            ("model", model),
            ("licence", licence),
            ("cameras", self.cameras.clone().unwrap_or_else(|| "estimated by the network".to_owned())),
            ("writes", formats.join(", ")),
        ];
        if let Some(memory) = &self.memory {
            let parts = format!(
                "{} (weights {}, mapped from their file; work {})",
                bytes(memory.total()),
                bytes(memory.weights),
                bytes(memory.working)
            );
            lines.push(("memory", parts));
        }
        if let Some(device) = &self.device {
            lines.push(("device", device.device.clone()));
            lines.push(("memory of the device", models::device_memory(device)));
        }
        lines
    }
}

/// Reads, predicts and writes.
pub fn run(request: &DepthRequest, events: &Events, cancel: &CancelToken) -> Result<DepthOutcome, Error> {
    let clock = std::time::Instant::now();
    let plan = plan(request)?;
    let located = models::locate(&request.model, request.accepted.as_ref(), &request.store)?;
    let model = events.stage("open model", 0, || located.open(&request.da3))?;
    check_formats(&model, request)?;
    let pictures = events.stage("read", plan.images.len(), || inputs::read_all(&plan.sources))?;
    let cameras = given_cameras(request, &pictures)?;
    // The folder is created only after the network has been opened.
    let network = std::time::Instant::now();
    let mut prediction =
        events.stage("depth", 0, || infer(&model, request, &pictures, cameras.as_ref(), cancel))?;
    let network_secs = network.elapsed().as_secs_f64();
    let (unit, unit_reason) = unit_of(&model, &mut prediction, request, &pictures, cameras.as_ref());
    let folder = RunFolder::create(&request.place)?;
    let mut outcome = DepthOutcome {
        folder: folder.path().to_owned(),
        views: prediction.depth.len(),
        size: (prediction.width(), prediction.height()),
        unit,
        unit_reason,
        artifacts: Vec::new(),
        warnings: warnings(&plan, &located, &prediction),
        network_secs,
        seconds: 0.0,
    };
    events.stage("write", 0, || {
        let mut writer = write::Writer::new(&folder, events, request, &pictures, &prediction, unit);
        writer.formats()?;
        record::predictions(&mut writer, &located, &outcome)?;
        outcome.warnings.append(&mut writer.warnings);
        outcome.artifacts.append(&mut writer.artifacts);
        Ok::<(), Error>(())
    })?;
    outcome.warnings.iter().for_each(|w| events.warn(w));
    outcome.seconds = clock.elapsed().as_secs_f64();
    record::manifest(&folder, request, &located, &model, &outcome)?;
    Ok(outcome)
}

fn check_formats(model: &Da3, request: &DepthRequest) -> Result<(), Error> {
    let usage = |what: String, hint: &str| Err(Error::Usage { what, hint: hint.to_owned() });
    if model.is_any_view() {
        return Ok(());
    }
    if let Some(format) = request.formats.iter().find(|f| f.needs_cameras()) {
        let what = format!("--format {}: {} predicts no cameras", format.name(), request.model.name());
        return usage(
            what,
            "choose an any-view network such as da3-small, or write depth_png, depth_vis, mini_npz",
        );
    }
    if request.infer.use_ray_pose || request.poses.is_some() {
        let what = format!("{} predicts each image separately and no cameras", request.model.name());
        return usage(
            what,
            "remove --poses and --use-ray-pose; --focal gives metric depth with da3-metric-large",
        );
    }
    Ok(())
}

fn given_cameras(
    request: &DepthRequest,
    pictures: &[Picture],
) -> Result<Option<inputs::KnownCameras>, Error> {
    let Some(path) = &request.poses else { return Ok(None) };
    let paths: Vec<PathBuf> = pictures.iter().map(|p| p.path.clone()).collect();
    let sizes: Vec<(usize, usize)> = pictures.iter().map(|p| (p.image.width(), p.image.height())).collect();
    Cameras::read(path)?.of_images(&paths, &sizes).map(Some)
}

fn infer(
    model: &Da3,
    request: &DepthRequest,
    pictures: &[Picture],
    cameras: Option<&inputs::KnownCameras>,
    cancel: &CancelToken,
) -> Result<Prediction, Error> {
    let images: Vec<_> = pictures.iter().map(|p| p.image.clone()).collect();
    let inputs = match cameras {
        Some(given) => Inputs::posed(&images, &given.camera_from_world, &given.intrinsics),
        None => Inputs::images(&images),
    };
    let watch = |_| cancel.is_cancelled();
    let hooks = Hooks { watch: &watch, trace: None };
    model.infer_with(&inputs, &request.infer, &hooks).map_err(|error| match error {
        Da3Error::Cancelled => Error::Interrupted { path: PathBuf::from(".") },
        other => other.into(),
    })
}

/// The metric network assumes a focal length of 300 px: metres = depth · focal / 300, in processed pixels.
const CANONICAL_FOCAL_PX: f64 = 300.0;

/// The unit of depth; a canonical depth whose focal length is known becomes metres.
fn unit_of(
    model: &Da3,
    prediction: &mut Prediction,
    request: &DepthRequest,
    pictures: &[Picture],
    cameras: Option<&inputs::KnownCameras>,
) -> (Unit, String) {
    if prediction.is_metric {
        return (Unit::Metre, "the network's metric part".to_owned());
    }
    if model.config().variant == Some(Variant::MetricLarge) {
        let Some(focal) = request.focal_px else {
            return (
                Unit::Arbitrary,
                "metric for a focal length of 300 px; give --focal PX for metres".to_owned(),
            );
        };
        let processed = (prediction.width(), prediction.height());
        for (depth, picture) in prediction.depth.iter_mut().zip(pictures) {
            let size = (picture.image.width(), picture.image.height());
            let Ok(mapping) = Mapping::new(size, processed, &request.infer.preprocess) else { continue };
            let factor = (focal * mapping.mean_scale() / CANONICAL_FOCAL_PX) as f32;
            depth.data_mut().iter_mut().for_each(|d| *d *= factor);
        }
        return (Unit::Metre, format!("focal length {focal} px"));
    }
    match (&prediction.alignment, cameras) {
        (Some(alignment), Some(given)) if request.infer.align_to_given => match alignment.scale_source {
            vidar_da3::align::ScaleSource::Unobservable => {
                (Unit::Arbitrary, "the given cameras are at one position, which gives no scale".to_owned())
            }
            evidence => (Unit::GivenCameras, format!("{} ({evidence:?})", given.source)),
        },
        _ => (Unit::Arbitrary, "one unknown factor for all views: no cameras given".to_owned()),
    }
}

fn warnings(plan: &DepthPlan, located: &LocatedModel, prediction: &Prediction) -> Vec<Warning> {
    let mut warnings = plan.warnings.clone();
    warnings.extend(models::untrained_warning(&located.identity));
    warnings.extend(models::bundled::small_network_warning(&located.identity));
    if prediction.was_cropped {
        let message = "images of several shapes were cropped to the smallest";
        warnings.push(Warning::new("cropped", message).hint("predict images of each shape separately"));
    }
    warnings
}
