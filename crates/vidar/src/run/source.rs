//! Where depth comes from: stereo, a network, or a recording, behind one trait.

use super::auto::{AutoModel, Shapes};
use super::remote::RemoteSource;
use crate::chunks::{RecordedGeometry, RecordedModel};
use crate::config::Config;
use crate::engine::{GeometrySource, Prediction};
use crate::error::Error;
use crate::models::LocatedModel;
use crate::models::geometry::{self, NetworkPlan, SourceChoice};
use std::sync::Arc;
use vidar_align::CouplingMode;
use vidar_core::{ChunkViews, GeometryModel, Image, ModelError, ModelInfo, Pinhole, Warning};
use vidar_da3::{Da3Model, PoseMode};
use vidar_dataset::{ImageEntry, Recording};
use vidar_stereo::StereoModel;
use vidar_synth::Simulation;
use vidar_synth::predict::{Conditioning, PredictionErrors, SyntheticModel};

/// Longer side of a simulated network's predictions, as of a small one.
const SIMULATED_SIDE_PX: usize = 280;

/// An open source of geometry.
pub enum Source {
    /// Multi-view stereo: needs poses, answers in their world.
    Stereo(StereoModel),
    /// Stereo, completed.
    Auto(AutoModel),
    /// A network.
    Network(Box<(Da3Model, LocatedModel)>),
    /// Predictions made elsewhere.
    Recorded(RecordedModel),
    /// A simulated network that knows a synthetic recording's world.
    Simulated(SyntheticModel),
    /// Workers elsewhere.
    Remote(Box<RemoteSource>),
}

/// A source, with the chunks that it prescribes.
pub struct OpenedSource {
    /// The source.
    pub source: Source,
    /// Images per chunk, where the recording prescribes them.
    pub chunks: Option<Vec<Vec<usize>>>,
}

impl Source {
    /// Opens what the configuration names. `images` are those that a recording may be of.
    pub fn open(dataset: &Recording, images: &[ImageEntry], config: &Config) -> Result<OpenedSource, Error> {
        let mode = config.coupling.mode;
        let mut chunks = None;
        let source = match geometry::source(config)? {
            SourceChoice::Stereo | SourceChoice::Auto(_)
                if matches!(
                    mode,
                    CouplingMode::Da3Streaming | CouplingMode::PoseFree | CouplingMode::Hybrid
                ) =>
            {
                return Err(Error::Usage {
                    what: format!(
                        "coupling mode {mode} needs a source of geometry that finds poses, stereo is given them"
                    ),
                    hint: "choose --geometry da3-small (or another network), or --mode pose-conditioned"
                        .into(),
                });
            }
            SourceChoice::Stereo => Self::Stereo(StereoModel::new(config.stereo.clone())?),
            SourceChoice::Auto(shapes) => {
                Self::Auto(AutoModel::open(shapes, images, config, pose_mode(config))?)
            }
            SourceChoice::Network(choice) => {
                Self::Network(Box::new(geometry::open(&choice, config, pose_mode(config))?))
            }
            SourceChoice::Recorded(folder) => {
                let geometry = &config.geometry;
                let recording = RecordedGeometry::open(
                    &folder,
                    images,
                    geometry.chunk_keyframes,
                    geometry.overlap_keyframes,
                )?;
                chunks = Some(recording.chunks.iter().map(|c| c.images.clone()).collect());
                Self::Recorded(RecordedModel::new(recording))
            }
            SourceChoice::Simulated => Self::Simulated(simulated(dataset, config)?),
            SourceChoice::Remote(key) => {
                Self::Remote(Box::new(RemoteSource::open(&key, config, pose_mode(config))?))
            }
        };
        Ok(OpenedSource { source, chunks })
    }

    /// The network, where one takes part.
    fn network(&self) -> Option<&(Da3Model, LocatedModel)> {
        match self {
            Self::Network(network) => Some(network),
            Self::Auto(AutoModel { shapes: Some(Shapes::Network(network)), .. }) => Some(network),
            Self::Auto(_) | Self::Stereo(_) | Self::Recorded(_) | Self::Simulated(_) | Self::Remote(_) => {
                None
            }
        }
    }

    /// The workers elsewhere, where they are asked.
    pub fn remote(&self) -> Option<&RemoteSource> {
        if let Self::Remote(remote) = self { Some(remote) } else { None }
    }

    /// Channels of the tokens that a network can tell places by.
    pub fn token_channels(&self) -> Option<usize> {
        match self {
            Self::Network(network) => Some(network.0.token_channels()),
            Self::Remote(remote) => remote.token_channels(),
            Self::Stereo(_) | Self::Auto(_) | Self::Recorded(_) | Self::Simulated(_) => None,
        }
    }

    /// From now on tokens are kept.
    pub fn keep_place_tokens(&mut self) {
        match self {
            Self::Network(network) => network.0.keep_place_tokens(),
            Self::Remote(remote) => remote.keep_place_tokens(),
            Self::Stereo(_) | Self::Auto(_) | Self::Recorded(_) | Self::Simulated(_) => {}
        }
    }

    /// The most memory of a graphics processor that it held at a time so far, bytes; `None` where it works on none.
    pub fn device_peak_bytes(&self) -> Option<u64> {
        self.network()?.0.network().device_peak_bytes()
    }

    /// What running it on chunks of `views` such views takes; warnings join `warnings`.
    pub fn planned(
        &self,
        config: &Config,
        view: &Pinhole,
        views: usize,
        warnings: &mut Vec<Warning>,
    ) -> Result<Option<NetworkPlan>, Error> {
        let Some((model, located)) = self.network() else { return Ok(None) };
        let (plan, noticed) = geometry::planned(model, located, config, view, views)?;
        warnings.extend(noticed);
        Ok(Some(plan))
    }
}

impl GeometrySource for Source {
    fn info(&self) -> &ModelInfo {
        match self {
            Self::Stereo(model) => model.info(),
            Self::Auto(model) => model.info(),
            Self::Network(network) => network.0.info(),
            Self::Recorded(model) => model.info(),
            Self::Simulated(model) => model.info(),
            Self::Remote(remote) => remote.info(),
        }
    }

    fn overlaps(&self) -> bool {
        !matches!(self, Self::Stereo(_) | Self::Auto(_))
    }

    fn completes(&self) -> bool {
        matches!(self, Self::Auto(_))
    }

    fn predicts_any_views(&self) -> bool {
        matches!(self, Self::Network(_) | Self::Simulated(_) | Self::Remote(_))
    }

    fn predict(
        &mut self,
        views: &ChunkViews,
        masks: &[Option<Image<bool>>],
        wanted: std::ops::Range<usize>,
        watch: vidar_core::Watch<'_>,
    ) -> Result<Prediction, ModelError> {
        let (mut colors, mut tokens, mut pose_std) = (Vec::new(), Vec::new(), Vec::new());
        let geometry = match self {
            Self::Auto(model) => return model.predict(views, masks, wanted, watch),
            Self::Remote(remote) => return remote.predict(views, wanted, watch),
            Self::Network(network) => {
                let geometry = network.0.predict_views(views, wanted, watch)?;
                tokens = network.0.take_place_tokens();
                geometry
            }
            Self::Recorded(model) => {
                let geometry = model.predict_views(views, wanted, watch)?;
                colors = model.take_colors();
                geometry
            }
            Self::Stereo(model) => {
                let output = model.predict_unmasked(views, masks, wanted, watch)?;
                pose_std = output.pose_std;
                output.prediction
            }
            Self::Simulated(model) => model.predict_views(views, wanted, watch)?,
        };
        Ok(Prediction { colors, tokens, pose_std, ..Prediction::of(geometry) })
    }
}

/// The simulated network of a recording that `vidar synth` made.
fn simulated(dataset: &Recording, config: &Config) -> Result<SyntheticModel, Error> {
    // `mav0/` lies inside the folder that was written.
    let inner = dataset.root.ends_with("mav0").then(|| dataset.root.parent()).flatten();
    let simulation = Arc::new(Simulation::open(inner.unwrap_or(&dataset.root))?);
    let seed = simulation.config().seed;
    let conditioning = match pose_mode(config) {
        PoseMode::Free => Conditioning::PoseFree,
        PoseMode::Conditioned => Conditioning::PosesInjected,
    };
    let errors = PredictionErrors::default();
    Ok(SyntheticModel::new(simulation, errors, conditioning, SIMULATED_SIDE_PX, seed)?)
}

/// How the network is used: with given camera poses or without.
fn pose_mode(config: &Config) -> PoseMode {
    match config.coupling.mode {
        CouplingMode::PoseConditioned | CouplingMode::GroundTruth => PoseMode::Conditioned,
        CouplingMode::Da3Streaming | CouplingMode::PoseFree | CouplingMode::Hybrid => PoseMode::Free,
        _ => config.model.network.mode,
    }
}
