//! The interface of dense geometry models: views in, a prediction in the model's own units out.

use crate::camera::Pinhole;
use crate::geometry::{Confidence, RelativeDepth};
use crate::id::{ChunkId, FrameId};
use crate::image::FrameImage;
use crate::lie::Se3;
use crate::time::Timestamp;
use serde::{Deserialize, Serialize};
use std::ops::Range;
use thiserror::Error;

/// One undistorted view of a chunk.
#[derive(Clone, Debug)]
pub struct ChunkView {
    /// Which frame it is.
    pub frame_id: FrameId,
    /// Time of the exposure.
    pub time: Timestamp,
    /// The undistorted image.
    pub image: FrameImage,
    /// Its intrinsics at the image's size.
    pub intrinsics: Pinhole,
    /// A prior pose in metres (from odometry, an external trajectory or ground truth), if there is one.
    pub world_from_camera: Option<Se3>,
}

/// The views that a model processes together.
#[derive(Clone, Debug)]
pub struct ChunkViews {
    /// The chunk's number.
    pub id: ChunkId,
    /// Its views in the order of time.
    pub views: Vec<ChunkView>,
}

/// Geometry of one view in the chunk's frame and units.
#[derive(Clone, Debug)]
pub struct ViewGeometry {
    /// Which frame it is.
    pub frame_id: FrameId,
    /// Pose in the chunk's frame, translation in chunk units.
    pub chunk_from_camera: Se3,
    /// Intrinsics at the depth's size.
    pub intrinsics: Pinhole,
    /// z-depth in chunk units.
    pub depth: RelativeDepth,
    /// Confidence per pixel.
    pub confidence: Confidence,
}

/// The frame and the units of a prediction.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ChunkFrame {
    /// The frame of the given prior poses, in metres.
    PriorWorld,
    /// A frame and scale that the model chooses.
    ModelNative,
}

/// Output of a model for one chunk.
#[derive(Clone, Debug)]
pub struct GeometryPrediction {
    /// Which chunk.
    pub chunk_id: ChunkId,
    /// Its frame and units.
    pub frame: ChunkFrame,
    /// One entry per view with geometry, in the order of the input views.
    pub views: Vec<ViewGeometry>,
}

/// Which model it is and under which terms it may be used.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ModelInfo {
    /// Name as the user chooses it (`stereo`, `da3-small`).
    pub name: String,
    /// SPDX licence of the weights, or of the code when there are none.
    pub licence: String,
    /// SHA-256 of the weights, when there are any.
    pub weights_sha256: Option<String>,
    /// Whether prior poses are required.
    pub needs_poses: bool,
    /// Fewest views it can work with.
    pub min_views: usize,
}

/// Why a model could not predict.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ModelError {
    /// Fewer views than the model needs.
    #[error("chunk {chunk}: {found} views, the model needs at least {needed}")]
    TooFewViews {
        /// Which chunk.
        chunk: ChunkId,
        /// Views given.
        found: usize,
        /// Views needed.
        needed: usize,
    },
    /// A view lacks the prior pose that the model needs.
    #[error("frame {frame} has no prior pose, and this model needs one")]
    MissingPose {
        /// Which frame.
        frame: FrameId,
    },
    /// A view cannot be used as it is.
    #[error("frame {frame}: {reason}")]
    BadView {
        /// Which frame.
        frame: FrameId,
        /// What is wrong with it.
        reason: String,
    },
    /// The caller asked to stop.
    #[error("cancelled")]
    Cancelled,
    /// The model is elsewhere and does not answer any more: no other chunk would be predicted either.
    #[error("{0}")]
    OutOfReach(String),
    /// Any other error, as the model describes it.
    #[error("{0}")]
    Other(String),
}

/// Called between pieces of long work with the share of it that is done, 0…1, roughly; `true` ends the work.
pub type Watch<'a> = &'a (dyn Fn(f64) -> bool + Sync);

/// A model that predicts dense geometry from views.
pub trait GeometryModel: Send {
    /// Which model this is.
    fn info(&self) -> &ModelInfo;

    /// Predicts depth, confidence and poses of a chunk. Same input, same bits, for any thread count.
    fn predict(&mut self, views: &ChunkViews) -> Result<GeometryPrediction, ModelError>;

    /// Predicts the views `requested` (indices into `views.views`) of a chunk.
    ///
    /// The other views are context. When `watch` answers `true` the work ends with [`ModelError::Cancelled`]. The default
    /// implementation predicts all views and keeps the requested ones.
    fn predict_views(
        &mut self,
        views: &ChunkViews,
        requested: Range<usize>,
        watch: Watch<'_>,
    ) -> Result<GeometryPrediction, ModelError> {
        if watch(0.0) {
            return Err(ModelError::Cancelled);
        }
        let mut prediction = self.predict(views)?;
        let ids: Vec<FrameId> = views
            .views
            .iter()
            .enumerate()
            .filter(|(i, _)| requested.contains(i))
            .map(|(_, v)| v.frame_id)
            .collect();
        prediction.views.retain(|v| ids.contains(&v.frame_id));
        Ok(prediction)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::image::Image;
    use nalgebra::Vector3;

    /// Predicts depth one everywhere and repeats the prior poses.
    struct Wall(ModelInfo);

    impl GeometryModel for Wall {
        fn info(&self) -> &ModelInfo {
            &self.0
        }

        fn predict(&mut self, chunk: &ChunkViews) -> Result<GeometryPrediction, ModelError> {
            if chunk.views.len() < self.0.min_views {
                let (found, needed) = (chunk.views.len(), self.0.min_views);
                return Err(ModelError::TooFewViews { chunk: chunk.id, found, needed });
            }
            let view = |v: &ChunkView| {
                let chunk_from_camera =
                    v.world_from_camera.ok_or(ModelError::MissingPose { frame: v.frame_id })?;
                Ok(ViewGeometry {
                    frame_id: v.frame_id,
                    chunk_from_camera,
                    intrinsics: v.intrinsics,
                    depth: RelativeDepth::new(Image::filled(v.image.width(), v.image.height(), 1.0)),
                    confidence: Confidence::full(v.image.width(), v.image.height()),
                })
            };
            let views = chunk.views.iter().map(view).collect::<Result<_, ModelError>>()?;
            Ok(GeometryPrediction { chunk_id: chunk.id, frame: ChunkFrame::PriorWorld, views })
        }
    }

    fn chunk(world_from_camera: Option<Se3>, n: u32) -> ChunkViews {
        let intrinsics = Pinhole { fx: 4.0, fy: 4.0, cx: 1.5, cy: 1.0, width: 4, height: 3 };
        let view = |i| ChunkView {
            frame_id: FrameId(i),
            time: Timestamp::from_nanos(i64::from(i)),
            image: FrameImage::Gray8(Image::filled(4, 3, 128)),
            intrinsics,
            world_from_camera,
        };
        ChunkViews { id: ChunkId(3), views: (0..n).map(view).collect() }
    }

    #[test]
    fn a_model_is_used_through_the_trait_and_names_what_it_lacks() {
        let info = ModelInfo {
            name: "wall".into(),
            licence: "MIT".into(),
            weights_sha256: None,
            needs_poses: true,
            min_views: 2,
        };
        let mut model: Box<dyn GeometryModel> = Box::new(Wall(info));
        assert!(model.info().needs_poses);
        let here = Se3::from_translation(Vector3::x());
        let prediction = model.predict(&chunk(Some(here), 2)).unwrap();
        assert_eq!((prediction.chunk_id, prediction.views.len()), (ChunkId(3), 2));
        assert_eq!(prediction.views[1].chunk_from_camera, here);
        let few = model.predict(&chunk(Some(here), 1)).unwrap_err();
        assert_eq!(few.to_string(), "chunk 3: 1 views, the model needs at least 2");
        let lost = model.predict(&chunk(None, 2)).unwrap_err();
        assert_eq!(lost.to_string(), "frame 0 has no prior pose, and this model needs one");
    }
}
