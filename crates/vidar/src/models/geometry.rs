//! A network as the geometry model of a run.

use super::{LocatedModel, MemoryPlan, ModelChoice, ModelIdentity, locate, planned_memory, store};
use crate::chunks::RECORDED;
use crate::config::{Config, ModelConfig};
use crate::error::Error;
use serde::Serialize;
use std::path::PathBuf;
use std::sync::Arc;
use vidar_core::{Pinhole, Warning};
use vidar_da3::preprocess::processed_size;
use vidar_da3::{Da3Model, Da3ModelConfig, Da3Options, DevicePlan, PoseMode, Precision};

/// The source of geometry that needs no network.
pub const STEREO: &str = "stereo";

/// The source of geometry that completes stereo's depth.
pub const AUTO: &str = "auto";
/// The source of geometry that `model.dir` alone means: its weights.
pub const CUSTOM: &str = "custom";

/// How `geometry.fill_network` says that there is none.
pub const NO_NETWORK: &str = "none";

/// The source of geometry of a configuration.
#[derive(Clone, Debug)]
pub enum SourceChoice {
    /// Multi-view stereo.
    Stereo,
    /// Stereo, completed by the fused surface, planes, and the shapes of a source where there is one.
    Auto(Option<ShapeChoice>),
    /// A network.
    Network(ModelChoice),
    /// Predictions in a folder.
    Recorded(PathBuf),
    /// A simulated network over a synthetic recording.
    Simulated,
    /// The workers under a key.
    Remote(String),
}

/// Where the shapes come from that fill what stereo leaves empty.
#[derive(Clone, Debug)]
pub enum ShapeChoice {
    /// A network.
    Network(ModelChoice),
    /// Predictions in a folder.
    Recorded(PathBuf),
}

impl SourceChoice {
    /// Whether depth is measured by stereo, which is given its poses.
    pub fn is_by_stereo(&self) -> bool {
        matches!(self, Self::Stereo | Self::Auto(_))
    }
}

/// The simulated network: true geometry of a synthetic recording with the errors of a network.
pub const SIMULATED: &str = "simulated";

/// How a source begins that lies with the workers under the key that follows.
pub const REMOTE: &str = "remote:";

/// The source of geometry that the configuration names.
pub fn source(config: &Config) -> Result<SourceChoice, Error> {
    if config.geometry.source == AUTO {
        return shapes(config).map(SourceChoice::Auto);
    }
    if let Some(key) = config.geometry.source.strip_prefix(REMOTE) {
        return Ok(SourceChoice::Remote(key.to_owned()));
    }
    match config.geometry.source.strip_prefix(RECORDED) {
        Some(folder) => Ok(SourceChoice::Recorded(PathBuf::from(folder))),
        None if config.geometry.source == SIMULATED => Ok(SourceChoice::Simulated),
        _ => Ok(chosen(config)?.map_or(SourceChoice::Stereo, SourceChoice::Network)),
    }
}

/// What `auto` fills with: custom weights where there are any, else what `geometry.fill_network` names.
fn shapes(config: &Config) -> Result<Option<ShapeChoice>, Error> {
    let named = config.geometry.fill_network.as_str();
    Ok(match (config.model.dir.as_str(), named.strip_prefix(RECORDED)) {
        ("", Some(folder)) => Some(ShapeChoice::Recorded(PathBuf::from(folder))),
        ("", None) if named == NO_NETWORK => None,
        ("", None) => Some(ShapeChoice::Network(ModelChoice::named(named)?)),
        (dir, _) => Some(ShapeChoice::Network(ModelChoice::Folder(PathBuf::from(dir)))),
    })
}

/// The network in a plan.
#[derive(Clone, Debug, Serialize)]
pub struct NetworkPlan {
    /// Its identity in manifests.
    #[serde(flatten)]
    pub identity: ModelIdentity,
    /// Views per prediction.
    pub views_at_once: usize,
    /// Memory for those, bytes.
    pub memory: MemoryPlan,
    /// Precision and device.
    pub arithmetic: String,
    /// The graphics processor and the memory it needs; `None` on the CPU.
    pub device: Option<DevicePlan>,
}

/// The network that the configuration names; `None` where no network is needed.
pub fn chosen(config: &Config) -> Result<Option<ModelChoice>, Error> {
    match (config.model.dir.as_str(), config.geometry.source.as_str()) {
        (_, STEREO) => Ok(None),
        (_, AUTO) => match shapes(config)? {
            Some(ShapeChoice::Network(choice)) => Ok(Some(choice)),
            Some(ShapeChoice::Recorded(_)) | None => Ok(None),
        },
        (dir, CUSTOM) if !dir.is_empty() => Ok(Some(ModelChoice::Folder(PathBuf::from(dir)))),
        (_, name) if [RECORDED, REMOTE].iter().any(|p| name.starts_with(p)) || name == SIMULATED => Ok(None),
        (_, name) => ModelChoice::named(name).map(Some),
    }
}

/// Opens the network. Nothing is downloaded.
pub fn open(
    choice: &ModelChoice,
    config: &Config,
    mode: PoseMode,
) -> Result<(Da3Model, LocatedModel), Error> {
    let located = locate(choice, None, &store(true)?)?;
    // The dense head stays in 32 bits, as in the official program.
    let head_precision = Some(Precision::F32);
    let ModelConfig { precision, device, .. } = config.model;
    let options = Da3Options { precision, head_precision, device, ..Da3Options::default() };
    let network = Arc::new(located.open(&options)?);
    let sha256 = located.identity.weights_sha256.clone();
    let network_config = Da3ModelConfig { mode, ..config.model.network.clone() };
    let model = Da3Model::new(network, network_config, sha256)?;
    Ok((model, located))
}

/// Memory of running it on chunks of `views` views, and warnings.
pub fn planned(
    model: &Da3Model,
    located: &LocatedModel,
    config: &Config,
    view: &Pinhole,
    views: usize,
) -> Result<(NetworkPlan, Vec<Warning>), Error> {
    let size = processed_size(view.width, view.height, &config.model.network.preprocess)?;
    let identity = located.identity.clone();
    let memory = planned_memory(model.network().config(), views, size);
    let wants_rays = config.model.network.use_ray_pose;
    let device = model.network().device_plan(views, size.1, size.0, wants_rays);
    // On a device, the device's memory is used.
    let mut warnings: Vec<Warning> = Vec::new();
    warnings.extend(super::memory_warning(&memory).filter(|_| device.is_none()));
    warnings.extend(super::untrained_warning(&identity));
    warnings.extend(super::bundled::small_network_warning(&identity));
    let arithmetic = model.network().describe_compute();
    Ok((NetworkPlan { identity, views_at_once: views, memory, arithmetic, device }, warnings))
}
