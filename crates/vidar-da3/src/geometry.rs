//! Depth Anything 3 as a [`GeometryModel`]: chunks of views in, depth and poses per view out.

use crate::align::ScaleSource;
use crate::config::HeadKind;
use crate::da3::Da3;
use crate::error::Da3Error;
use crate::infer::{InferOptions, Inputs, Prediction};
use crate::model::backbone::ReferenceStrategy;
use crate::pose::{from_edge, parts, rigid_inverse, to_edge};
use crate::preprocess::PreprocessConfig;
use crate::run::Hooks;
use nalgebra::{Matrix3, Matrix4};
use serde::{Deserialize, Serialize};
use std::ops::Range;
use std::sync::Arc;
use vidar_core::Watch;
use vidar_core::model::ChunkFrame;
use vidar_core::{
    ChunkViews, Confidence, FrameId, GeometryModel, GeometryPrediction, Image, LieGroup, ModelError,
    ModelInfo, RelativeDepth, Se3, So3, ViewGeometry,
};

/// Whether the network is told where the cameras are.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum PoseMode {
    /// Images alone: the network finds poses and intrinsics in a frame and unit of its own.
    #[default]
    Free,
    /// Prior poses and intrinsics are given to the network, and depth comes out in their frame and metres.
    Conditioned,
}

/// How the model is used on chunks.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Da3ModelConfig {
    /// Whether prior poses are given to the network. `conditioned` needs a pose for every view; change it when odometry
    /// is better than what the network sees.
    pub mode: PoseMode,
    /// Size of the network's input. Larger shows more detail at quadratic cost.
    pub preprocess: PreprocessConfig,
    /// How the reference view is chosen when no poses are given. `saddle_balanced` unless views are known to be special.
    pub reference: ReferenceStrategy,
    /// Poses from the ray branch instead of the camera decoder: also finds principal points, costs more than twice the
    /// head. Off unless the decoder's poses are poor.
    pub use_ray_pose: bool,
}

impl Da3ModelConfig {
    /// Refuses sizes outside their range.
    pub fn validate(&self) -> Result<(), Da3Error> {
        self.preprocess.validate()
    }
}

/// A [`GeometryModel`] on a network that is open; several may share one network.
pub struct Da3Model {
    network: Arc<Da3>,
    config: Da3ModelConfig,
    info: ModelInfo,
    place_layer: Option<usize>,
    place_tokens: Vec<Vec<f32>>,
}

impl Da3Model {
    /// Any-view networks answer in both modes; the metric one only when poses are given. `weights_sha256` is passed on.
    pub fn new(
        network: Arc<Da3>,
        config: Da3ModelConfig,
        weights_sha256: Option<String>,
    ) -> Result<Self, Da3Error> {
        config.validate()?;
        let needs_poses = config.mode == PoseMode::Conditioned;
        let description = network.config();
        let answers_poses = network.is_any_view() || (needs_poses && is_metric(&network));
        if !answers_poses {
            let reason = format!("{} sees one view at a time and finds no poses", description.name);
            return Err(Da3Error::BadInput { what: "model", reason });
        }
        if needs_poses && network.is_any_view() && description.main().camera_encoder.is_none() {
            let reason = format!("{} has no camera encoder", description.name);
            return Err(Da3Error::BadInput { what: "mode", reason });
        }
        if network.is_any_view() && !description.main().camera_decoder && !config.use_ray_pose {
            let reason = format!("{} has no camera decoder; poses can come from rays", description.name);
            return Err(Da3Error::BadInput { what: "use_ray_pose", reason });
        }
        let licence = description.variant.map_or("LicenseRef-unknown", |v| v.licence()).to_owned();
        let info =
            ModelInfo { name: description.name.clone(), licence, weights_sha256, needs_poses, min_views: 1 };
        Ok(Self { network, config, info, place_layer: None, place_tokens: Vec::new() })
    }

    /// From now on keeps the tokens by which a place is recognised ([`Da3Model::take_place_tokens`]): those of the last
    /// block before attention across views, so that an image's do not depend on what it was seen with.
    pub fn keep_place_tokens(&mut self) {
        let backbone = &self.network.config().main().backbone;
        self.place_layer = Some(backbone.alternate_from.unwrap_or(backbone.depth).saturating_sub(1));
    }

    /// Patch tokens `[patches, channels]` of each view of the last prediction, in its order; empty unless they are kept.
    pub fn take_place_tokens(&mut self) -> Vec<Vec<f32>> {
        std::mem::take(&mut self.place_tokens)
    }

    /// Channels of a token.
    pub fn token_channels(&self) -> usize {
        self.network.config().main().backbone.dim
    }

    /// The network.
    pub fn network(&self) -> &Da3 {
        &self.network
    }

    fn predict_some(
        &mut self,
        chunk: &ChunkViews,
        wanted: Range<usize>,
        watch: Watch<'_>,
    ) -> Result<GeometryPrediction, ModelError> {
        let wanted = wanted.start.min(chunk.views.len())..wanted.end.min(chunk.views.len());
        if chunk.views.is_empty() {
            return Err(ModelError::TooFewViews { chunk: chunk.id, found: 0, needed: 1 });
        }
        let priors = match self.config.mode {
            PoseMode::Free => None,
            PoseMode::Conditioned => Some(prior_poses(chunk)?),
        };
        let frame = if priors.is_some() { ChunkFrame::PriorWorld } else { ChunkFrame::ModelNative };
        if wanted.is_empty() {
            return Ok(GeometryPrediction { chunk_id: chunk.id, frame, views: Vec::new() });
        }
        let images: Vec<Image<[u8; 3]>> = chunk.views.iter().map(|v| v.image.to_rgb8()).collect();
        let intrinsics: Vec<Matrix3<f64>> = chunk.views.iter().map(|v| to_edge(&v.intrinsics)).collect();
        let options = InferOptions {
            preprocess: self.config.preprocess,
            reference: self.config.reference,
            use_ray_pose: self.config.use_ray_pose,
            wanted: Some(wanted.clone()),
            feature_layers: self.place_layer.into_iter().collect(),
            ..InferOptions::default()
        };
        let told = priors.as_deref().filter(|_| self.network.is_any_view());
        let inputs = Inputs { images: &images, camera_from_world: told, intrinsics: Some(&intrinsics) };
        let hooks = Hooks { watch, trace: None };
        let mut prediction =
            self.network.infer_with(&inputs, &options, &hooks).map_err(|e| model_error(e, chunk))?;
        drop(images);
        let tokens = std::mem::take(&mut prediction.features).into_values().next();
        self.place_tokens = tokens.map_or_else(Vec::new, |t| t.views[wanted.clone()].to_vec());
        let answer = match priors {
            Some(priors) if !self.network.is_any_view() => {
                metric_in_prior_world(prediction, priors, intrinsics, chunk)
            }
            Some(_) => in_prior_world(prediction),
            None => Ok(Placed { frame, prediction }),
        };
        collect(&answer.map_err(|e| model_error(e, chunk))?, chunk, wanted)
    }
}

impl GeometryModel for Da3Model {
    fn info(&self) -> &ModelInfo {
        &self.info
    }

    fn predict(&mut self, views: &ChunkViews) -> Result<GeometryPrediction, ModelError> {
        self.predict_some(views, 0..views.views.len(), &|_| false)
    }

    fn predict_views(
        &mut self,
        views: &ChunkViews,
        wanted: Range<usize>,
        watch: Watch<'_>,
    ) -> Result<GeometryPrediction, ModelError> {
        self.predict_some(views, wanted, watch)
    }
}

/// Whether depth of single views can be brought to metres: the metric network's is canonical, the monocular one's is
/// not; a network that does not say is taken for neither.
fn is_metric(network: &Da3) -> bool {
    network.config().variant == Some(crate::config::Variant::MetricLarge)
        && network.config().main().head.kind == HeadKind::DptSky
}

fn prior_poses(chunk: &ChunkViews) -> Result<Vec<Matrix4<f64>>, ModelError> {
    chunk
        .views
        .iter()
        .map(|view| {
            let pose = view.world_from_camera.ok_or(ModelError::MissingPose { frame: view.frame_id })?;
            Ok(pose.inverse().matrix())
        })
        .collect()
}

/// A prediction and the frame it is in.
struct Placed {
    frame: ChunkFrame,
    prediction: Prediction,
}

/// Depth is in metres where a baseline was seen. One place alone shows no scale: the answer is then in the network's
/// own frame and unit, and says so.
fn in_prior_world(mut prediction: Prediction) -> Result<Placed, Da3Error> {
    let is_scaled =
        prediction.alignment.as_ref().is_some_and(|a| a.scale_source != ScaleSource::Unobservable);
    if is_scaled || prediction.is_metric {
        return Ok(Placed { frame: ChunkFrame::PriorWorld, prediction });
    }
    if let (Some(alignment), Some(poses)) = (&prediction.alignment, &mut prediction.camera_from_world) {
        for pose in poses {
            *pose = alignment.to_predicted(pose);
        }
    }
    Ok(Placed { frame: ChunkFrame::ModelNative, prediction })
}

/// The metric network: canonical depth times focal/300 is in metres; poses are the prior ones, sky has no depth.
fn metric_in_prior_world(
    mut prediction: Prediction,
    priors: Vec<Matrix4<f64>>,
    intrinsics: Vec<Matrix3<f64>>,
    chunk: &ChunkViews,
) -> Result<Placed, Da3Error> {
    let (width, height) = (prediction.width(), prediction.height());
    if prediction.was_cropped {
        let reason = "the views of a chunk differ in size".into();
        return Err(Da3Error::BadInput { what: "images", reason });
    }
    let mut processed = Vec::with_capacity(intrinsics.len());
    for (view, mut k) in chunk.views.iter().zip(intrinsics) {
        k.row_mut(0).scale_mut(width as f64 / view.image.width() as f64);
        k.row_mut(1).scale_mut(height as f64 / view.image.height() as f64);
        processed.push(k);
    }
    let sky = prediction.sky.take().unwrap_or_default();
    let mut confidence = Vec::with_capacity(sky.len());
    for ((depth, sky), k) in prediction.depth.iter_mut().zip(&sky).zip(&processed) {
        let factor = crate::model::metres_per_canonical(k) as f32;
        for (depth, is_sky) in depth.data_mut().iter_mut().zip(sky.data()) {
            *depth = if *is_sky { f32::NAN } else { *depth * factor };
        }
        // The largest confidence there is, and none for sky: see `collect`.
        confidence.push(sky.map(|is_sky| if *is_sky { 1.0 } else { f32::INFINITY }));
    }
    prediction.confidence = Some(confidence);
    prediction.camera_from_world = Some(priors);
    prediction.intrinsics = Some(processed);
    Ok(Placed { frame: ChunkFrame::PriorWorld, prediction })
}

/// Brings a prediction to `VIDAR`'s conventions. The head's confidence is `c = 1 + exp(l)`; `1 − 1/c` is the logistic
/// function of the same l, a number in 0…1 in the same order.
fn collect(
    placed: &Placed,
    chunk: &ChunkViews,
    wanted: Range<usize>,
) -> Result<GeometryPrediction, ModelError> {
    let prediction = &placed.prediction;
    let (width, height) = (prediction.width(), prediction.height());
    let lacks = |what: &str| ModelError::Other(format!("the network gave no {what}"));
    let poses = prediction.camera_from_world.as_ref().ok_or_else(|| lacks("poses"))?;
    let intrinsics = prediction.intrinsics.as_ref().ok_or_else(|| lacks("intrinsics"))?;
    let confidence = prediction.confidence.as_ref().ok_or_else(|| lacks("confidence"))?;
    let mut views = Vec::with_capacity(wanted.len());
    for i in wanted {
        let frame_id = chunk.views[i].frame_id;
        let bad = |reason: &str| ModelError::BadView { frame: frame_id, reason: reason.into() };
        let map = i.checked_sub(prediction.wanted.start).filter(|m| *m < prediction.depth.len());
        let map = map.ok_or_else(|| lacks("depth"))?;
        let (rotation, position) = parts(&rigid_inverse(&poses[i]));
        let rotation =
            So3::from_matrix(&rotation).ok_or_else(|| bad("its predicted orientation is no rotation"))?;
        let pinhole = from_edge(&intrinsics[i], width, height)
            .ok_or_else(|| bad("its predicted intrinsics are not positive and finite"))?;
        let valid = |d: &f32| if d.is_finite() && *d > 0.0 { *d } else { f32::NAN };
        views.push(ViewGeometry {
            frame_id,
            chunk_from_camera: Se3::new(rotation, position),
            intrinsics: pinhole,
            depth: RelativeDepth::new(prediction.depth[map].map(valid)),
            confidence: Confidence::new(confidence[map].map(|c| 1.0 - 1.0 / c)),
        });
    }
    Ok(GeometryPrediction { chunk_id: chunk.id, frame: placed.frame, views })
}

fn model_error(error: Da3Error, chunk: &ChunkViews) -> ModelError {
    match error {
        Da3Error::Cancelled => ModelError::Cancelled,
        Da3Error::BadView { view, reason } => {
            let frame = chunk.views.get(view).map_or(FrameId(0), |v| v.frame_id);
            ModelError::BadView { frame, reason }
        }
        other => ModelError::Other(other.to_string()),
    }
}
