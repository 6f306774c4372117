//! Landmarks by stereo: the points of a chunk's pictures that matching between known places is surest of.
//!
//! The odometry follows few points, and a trajectory that was given comes with none. A network's depth, off by a factor that
//! varies slowly over each picture, can be held to these as well.

use super::plan::Plan;
use super::source::Source;
use crate::config::Config;
use crate::error::Error;
use std::collections::BTreeMap;
use vidar_align::CouplingMode;
use vidar_core::camera::Pixel;
use vidar_core::{
    ChunkId, ChunkView, ChunkViews, FrameId, GeometryPrediction, LandmarkId, Pinhole, SparseLandmark,
    ViewGeometry,
};
use vidar_stereo::{StereoConfig, StereoError, StereoModel, TOLERANCE_RATIO};

/// The picture is cut into so many blocks across and down; each gives one landmark at most.
const BLOCKS: (usize, usize) = (20, 14);
/// A few hundred points need no fine picture, and no refinement: 320 px with it cost three times as much for a hundredth more.
const MAX_WIDTH_PX: usize = 240;
/// The least probability that the depth is right to within [`TOLERANCE_RATIO`].
const MIN_CONFIDENCE: f32 = 0.75;

/// Landmarks of a frame, with the camera whose pixels they are given in.
pub type OfFrame = (Pinhole, Vec<SparseLandmark>);

/// Finds landmarks by stereo.
pub struct Sparse(StereoModel);

impl Sparse {
    /// `None` where nothing is held to landmarks, or these are not wanted.
    pub fn wanted(plan: &Plan, source: &Source, config: &Config) -> Result<Option<Self>, Error> {
        let holds = plan.mode == CouplingMode::Coupled && plan.anchor.is_some() && source.overlaps();
        if !(holds && config.coupling.stereo_landmarks) {
            return Ok(None);
        }
        let max_width_px = config.stereo.max_width_px.min(MAX_WIDTH_PX);
        let quick = StereoConfig { max_width_px, refine_rounds: 0, ..config.stereo.clone() };
        Ok(Some(Self(StereoModel::new(quick)?)))
    }

    /// Landmarks of those of a chunk's views that have a pose. None at all where the camera hardly moved.
    pub fn of(
        &self,
        id: ChunkId,
        views: &[ChunkView],
        cancel: &(dyn Fn() -> bool + Sync),
    ) -> Result<BTreeMap<FrameId, OfFrame>, StereoError> {
        let views: Vec<ChunkView> = views.iter().filter(|v| v.world_from_camera.is_some()).cloned().collect();
        let references: Vec<usize> = (0..views.len()).collect();
        match self.0.predict_with(&ChunkViews { id, views }, &references, cancel) {
            Ok(output) => Ok(landmarks(&output.prediction)),
            Err(
                StereoError::NoParallax { .. } | StereoError::TooFewViews { .. } | StereoError::Cancelled,
            ) => Ok(BTreeMap::new()),
            Err(error) => Err(error),
        }
    }
}

fn landmarks(prediction: &GeometryPrediction) -> BTreeMap<FrameId, OfFrame> {
    let of = |view: &ViewGeometry| (view.frame_id, (view.intrinsics, surest(view)));
    prediction.views.iter().map(of).collect()
}

/// The surest pixel of each block.
fn surest(view: &ViewGeometry) -> Vec<SparseLandmark> {
    let (depth, confidence) = (view.depth.image(), view.confidence.image());
    let (width, height) = (depth.width(), depth.height());
    let within =
        |block: usize, blocks: usize, size: usize| block * size / blocks..(block + 1) * size / blocks;
    let pick = |block: usize| {
        let columns = within(block % BLOCKS.0, BLOCKS.0, width);
        let places = within(block / BLOCKS.0, BLOCKS.1, height)
            .flat_map(|y| columns.clone().map(move |x| (x, y)))
            .filter(|&at| depth[at].is_finite() && confidence[at] >= MIN_CONFIDENCE);
        let (x, y) = places.reduce(|a, b| if confidence[b] > confidence[a] { b } else { a })?;
        let inverse_depth = 1.0 / f64::from(depth[(x, y)]);
        // No point is followed from frame to frame: each view's own are told apart by its frame.
        let number = (view.frame_id.0).wrapping_mul((BLOCKS.0 * BLOCKS.1) as u32).wrapping_add(block as u32);
        Some(SparseLandmark {
            id: LandmarkId(number),
            pixel: Pixel::new(x as f64, y as f64),
            inverse_depth,
            inverse_depth_std: f64::from(TOLERANCE_RATIO) * inverse_depth,
        })
    };
    (0..BLOCKS.0 * BLOCKS.1).filter_map(pick).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::{Confidence, Image, RelativeDepth, Se3};

    /// A wall 2 m away of which stereo is sure on the left half alone, more so at one pixel of each block.
    #[test]
    fn every_block_that_stereo_is_sure_of_gives_one_landmark_where_it_is_surest() {
        let (width, height) = (200, 140);
        let mut depth = Image::filled(width, height, 2.0_f32);
        depth.data_mut()[0] = f32::NAN;
        let sure = |x: usize, y: usize| match (x < width / 2, x % 10 == 7 && y % 10 == 4) {
            (false, _) => 0.5,
            (true, false) => 0.8,
            (true, true) => 0.9,
        };
        let view = ViewGeometry {
            frame_id: FrameId(3),
            chunk_from_camera: Se3::IDENTITY,
            intrinsics: Pinhole::new(150.0, 150.0, 99.5, 69.5, width, height).unwrap(),
            depth: RelativeDepth::new(depth),
            confidence: Confidence::new(Image::from_fn(width, height, sure)),
        };
        let found = surest(&view);
        assert_eq!(found.len(), 10 * 14);
        for landmark in &found {
            assert_eq!((landmark.pixel.x as usize % 10, landmark.pixel.y as usize % 10), (7, 4));
            assert!((landmark.inverse_depth - 0.5).abs() < 1e-12);
            assert!((landmark.inverse_depth_std - 0.015).abs() < 1e-9);
        }
        let ids: std::collections::BTreeSet<_> = found.iter().map(|l| l.id).collect();
        assert_eq!(ids.len(), found.len());
    }
}
