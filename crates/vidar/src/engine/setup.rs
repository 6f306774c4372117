//! What the engine needs from outside, as traits and values: it opens no file and starts no thread of its own.

use super::events::FrameStamp;
use super::pose_source::PoseSource;
use crate::chunks::StoredChunk;
use crate::config::Config;
use crate::error::Error;
use std::ops::Range;
use vidar_core::{
    CameraId, ChunkId, ChunkViews, Duration, FrameId, FrameImage, GeometryPrediction, Image, ModelError,
    ModelInfo, Pinhole, RigCamera, Se3, Timestamp, Warning, Watch,
};
use vidar_stereo::PoseStd;

/// Values and sources of an [`super::Engine`].
pub struct EngineSetup<'a> {
    /// Name of the recording, for messages.
    pub name: String,
    /// Settings of every stage.
    pub config: &'a Config,
    /// Which camera is in use.
    pub camera_id: CameraId,
    /// The camera in use, with its place on the rig.
    pub camera: RigCamera,
    /// Time from the first to the last row of an image; zero for a global shutter. Poses are those of the middle row.
    pub readout: Duration,
    /// The undistorted view that the geometry model gets.
    pub view: Pinhole,
    /// Where poses come from; none where the coupling works without any.
    pub poses: Option<Box<dyn PoseSource + 'a>>,
    /// Poses that are used, with a warning, if `poses` gave none.
    pub fallback: Option<Box<dyn PoseSource + 'a>>,
    /// Frames of each chunk, where a recording of predictions prescribes them.
    pub prescribed: Option<Vec<Vec<FrameId>>>,
    /// The geometry model.
    pub geometry: &'a mut dyn GeometrySource,
    /// Describes places, for place recognition.
    pub places: &'a dyn PlaceDescriber,
    /// Pixels of keyframes.
    pub images: &'a dyn ImageSource,
    /// Predictions on their way from prediction to fusion.
    pub store: &'a dyn PredictionStore,
    /// Memory bound of the fused volume, bytes.
    pub volume_budget_bytes: u64,
    /// Asked now and then; `true` stops predictions, and what was placed is fused.
    pub cancelled: &'a (dyn Fn() -> bool + Sync),
    /// Told now and then which share of the prediction at hand is done, 0…1.
    pub predicting: &'a (dyn Fn(f64) + Sync),
}

/// Pixels of images that were pushed before, as they are needed. A file is read again, a live source keeps what it can.
pub trait ImageSource: Sync {
    /// The image as captured.
    ///
    /// # Errors
    /// A degradation that names the image.
    fn image(&self, stamp: &FrameStamp) -> Result<FrameImage, Warning>;
    /// What of the image is not to be used, as captured: `true` there; `None` where all of it is used.
    ///
    /// # Errors
    /// A degradation that names the mask.
    fn mask(&self, _: &FrameStamp) -> Result<Option<Image<bool>>, Warning> {
        Ok(None)
    }
}

/// A prediction with what came with it.
#[derive(Debug)]
pub struct Prediction {
    /// Geometry of the views that got any.
    pub geometry: GeometryPrediction,
    /// Images at the depth's size, one per view, where the model brings its own; else empty.
    pub colors: Vec<Image<[u8; 3]>>,
    /// The network's tokens, one list per view; empty where there are none.
    pub tokens: Vec<Vec<f32>>,
    /// Another z-depth per view, in any unit and at any size of the same view, for what the geometry leaves empty; empty where
    /// there is none.
    pub shapes: Vec<Option<Image<f32>>>,
    /// What the pose of each view is known to, where the images corrected it; else empty.
    pub pose_std: Vec<PoseStd>,
    /// What the user should know of it.
    pub warnings: Vec<Warning>,
}

impl Prediction {
    /// Geometry alone.
    pub fn of(geometry: GeometryPrediction) -> Self {
        Self {
            geometry,
            colors: Vec::new(),
            tokens: Vec::new(),
            shapes: Vec::new(),
            pose_std: Vec::new(),
            warnings: Vec::new(),
        }
    }
}

/// The geometry model as the engine uses it.
pub trait GeometrySource {
    /// Which model it is.
    fn info(&self) -> &ModelInfo;
    /// Whether chunks share keyframes with their neighbours. Stereo's need not: its poses are given.
    fn overlaps(&self) -> bool;
    /// Whether it predicts any set of views, so also both ends of a loop together.
    fn predicts_any_views(&self) -> bool;
    /// Whether pixels that it leaves empty are filled once all is fused.
    fn completes(&self) -> bool {
        false
    }
    /// Depth of the views `wanted` (indices into `views.views`). `masks` has one entry per view at its image's size, `true` where it is
    /// not to be used; what a source says there all the same is taken out of its prediction.
    ///
    /// # Errors
    /// What the model reports; [`ModelError::Cancelled`] when `watch` answered `true`.
    fn predict(
        &mut self,
        views: &ChunkViews,
        masks: &[Option<Image<bool>>],
        wanted: Range<usize>,
        watch: Watch<'_>,
    ) -> Result<Prediction, ModelError>;
}

/// Describes keyframes by vectors whose inner product is high where they show the same place.
pub trait PlaceDescriber {
    /// Whether descriptors are averages of network tokens, which are compared after whitening.
    fn is_whitened(&self) -> bool;
    /// Adds the descriptors that cannot be computed from what is stored.
    ///
    /// # Errors
    /// The descriptor network failed.
    fn describe(&self, chunk: &mut StoredChunk, tokens: &[Vec<f32>]) -> Result<(), Error>;
    /// Descriptors of a chunk's views, in their order; empty where a view has none.
    fn descriptors(&self, chunk: &StoredChunk) -> Vec<Vec<f32>>;
}

/// Which prediction it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum PredictionId {
    /// A chunk of the sequence.
    Chunk(ChunkId),
    /// Keyframes of two chunks that show one place.
    Loop {
        /// The later chunk.
        later: ChunkId,
        /// The earlier chunk.
        earlier: ChunkId,
    },
}

impl PredictionId {
    /// The number under which the model is asked. Models use it in messages and as a seed; a loop's has the later chunk in
    /// its upper half, so that no two predictions of a run (of less than 65 536 chunks) are asked for under one number. In a longer one
    /// two may share a seed and no more: what is stored is named by this id itself.
    pub fn model_number(self) -> ChunkId {
        match self {
            Self::Chunk(id) => id,
            Self::Loop { later, earlier } => ChunkId(later.0.rotate_left(16) ^ earlier.0),
        }
    }
}

impl std::fmt::Display for PredictionId {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Chunk(id) => write!(f, "chunk {id}"),
            Self::Loop { later, earlier } => write!(f, "loop of chunks {later} and {earlier}"),
        }
    }
}

/// What identifies a keyframe of a prediction: its time and the pose that the model was given.
pub type PredictedFrame = (Timestamp, Option<Se3>);

/// Keeps predictions from alignment to fusion, and from an interrupted run to the one that resumes it.
pub trait PredictionStore {
    /// A prediction that was made of exactly these frames by the same model and settings.
    fn find(&self, id: PredictionId, frames: &[PredictedFrame]) -> Option<StoredChunk>;
    /// Keeps a prediction and returns it as [`PredictionStore::read`] will, so that a resumed run computes with the same bits.
    ///
    /// # Errors
    /// It could not be kept.
    fn keep(
        &self,
        id: PredictionId,
        frames: &[PredictedFrame],
        chunk: &StoredChunk,
    ) -> Result<StoredChunk, Error>;
    /// A prediction that was kept.
    ///
    /// # Errors
    /// It is not there, or damaged.
    fn read(&self, id: PredictionId) -> Result<StoredChunk, Error>;
    /// Keeps the volume of a chunk that the growing surface does not need in memory.
    ///
    /// # Errors
    /// It could not be kept.
    fn keep_volume(&self, chunk: ChunkId, bytes: &[u8]) -> Result<(), Error>;
    /// A volume that was kept.
    ///
    /// # Errors
    /// It is not there.
    fn read_volume(&self, chunk: ChunkId) -> Result<Vec<u8>, Error>;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn loops_are_asked_for_under_numbers_of_their_own() {
        let chunk = |n: u32| PredictionId::Chunk(ChunkId(n)).model_number();
        let of_loop = |later, earlier| {
            PredictionId::Loop { later: ChunkId(later), earlier: ChunkId(earlier) }.model_number()
        };
        let mut numbers: Vec<ChunkId> = (0..200).map(chunk).collect();
        numbers.extend((1..200).flat_map(|later| (0..later).map(move |earlier| of_loop(later, earlier))));
        let count = numbers.len();
        numbers.sort_unstable();
        numbers.dedup();
        assert_eq!(numbers.len(), count);
    }
}
