//! Stereo with the shapes of another source for what it leaves empty.

use crate::chunks::{RecordedGeometry, RecordedShapes};
use crate::config::Config;
use crate::engine::Prediction;
use crate::error::Error;
use crate::models::LocatedModel;
use crate::models::geometry::{self, ShapeChoice};
use std::ops::Range;
use vidar_core::{
    ChunkViews, FrameId, GeometryModel, GeometryPrediction, Image, ModelError, ModelInfo, Warning, Watch,
};
use vidar_da3::{Da3Model, PoseMode};
use vidar_dataset::ImageEntry;
use vidar_stereo::{StereoModel, StereoOutput};

/// Where shapes come from.
pub(super) enum Shapes {
    /// A network.
    Network(Box<(Da3Model, LocatedModel)>),
    /// Predictions made elsewhere.
    Recorded(Box<RecordedShapes>),
}

/// Stereo, and the shapes that fill it.
pub struct AutoModel {
    stereo: StereoModel,
    pub(super) shapes: Option<Shapes>,
    info: ModelInfo,
}

impl AutoModel {
    /// Opens stereo and the source of shapes. Nothing is downloaded.
    pub(super) fn open(
        choice: Option<ShapeChoice>,
        images: &[ImageEntry],
        config: &Config,
        mode: PoseMode,
    ) -> Result<Self, Error> {
        let stereo = StereoModel::new(config.stereo.clone())?;
        let shapes = match choice {
            None => None,
            Some(ShapeChoice::Network(choice)) => {
                Some(Shapes::Network(Box::new(geometry::open(&choice, config, mode)?)))
            }
            Some(ShapeChoice::Recorded(folder)) => {
                let (size, overlap) = (config.geometry.chunk_keyframes, config.geometry.overlap_keyframes);
                let recording = RecordedGeometry::open(&folder, images, size, overlap)?;
                Some(Shapes::Recorded(Box::new(RecordedShapes::new(recording, images))))
            }
        };
        let (weights_sha256, licence) = match &shapes {
            Some(Shapes::Network(network)) => {
                (network.0.info().weights_sha256.clone(), network.0.info().licence.clone())
            }
            Some(Shapes::Recorded(_)) | None => (None, stereo.info().licence.clone()),
        };
        let info =
            ModelInfo { name: geometry::AUTO.to_owned(), licence, weights_sha256, ..stereo.info().clone() };
        Ok(Self { stereo, shapes, info })
    }

    /// Which model it is.
    pub(super) fn info(&self) -> &ModelInfo {
        &self.info
    }

    /// Stereo of the views `wanted`, and the shapes of those that got depth. Where no shape can be had, the chunk does
    /// without, with a warning.
    pub(super) fn predict(
        &mut self,
        views: &ChunkViews,
        masks: &[Option<Image<bool>>],
        wanted: Range<usize>,
        watch: Watch<'_>,
    ) -> Result<Prediction, ModelError> {
        let StereoOutput { prediction: geometry, pose_std, .. } =
            self.stereo.predict_unmasked(views, masks, wanted, watch)?;
        let (shapes, warnings) = match self.shapes(views, &geometry, watch) {
            Ok(shapes) => (shapes, Vec::new()),
            Err(ModelError::Cancelled) => return Err(ModelError::Cancelled),
            Err(error) => {
                let warning = Warning::degraded("fill-network-failed", error.to_string());
                (Vec::new(), vec![warning.hint("depth between what is measured is interpolated instead")])
            }
        };
        Ok(Prediction { pose_std, shapes, warnings, ..Prediction::of(geometry) })
    }

    fn shapes(
        &mut self,
        views: &ChunkViews,
        geometry: &GeometryPrediction,
        watch: Watch<'_>,
    ) -> Result<Vec<Option<Image<f32>>>, ModelError> {
        let frames: Vec<FrameId> = geometry.views.iter().map(|v| v.frame_id).collect();
        match &mut self.shapes {
            None => Ok(Vec::new()),
            Some(_) if frames.is_empty() => Ok(Vec::new()),
            Some(Shapes::Recorded(recorded)) => {
                let shape = |frame: &FrameId| recorded.shape(*frame);
                let shapes: Result<Vec<_>, Error> = frames.iter().map(shape).collect();
                shapes.map_err(|e| ModelError::Other(e.to_string()))
            }
            Some(Shapes::Network(network)) => {
                let is_wanted = |v: &&vidar_core::ChunkView| frames.contains(&v.frame_id);
                let views = ChunkViews {
                    id: views.id,
                    views: views.views.iter().filter(is_wanted).cloned().collect(),
                };
                let count = views.views.len();
                let predicted = network.0.predict_views(&views, 0..count, watch)?;
                let of = |frame: &FrameId| {
                    let view = predicted.views.iter().find(|v| v.frame_id == *frame)?;
                    Some(view.depth.image().clone())
                };
                Ok(frames.iter().map(of).collect())
            }
        }
    }
}
