//! Stereo landmarks: the points of a chunk's images whose depth multi-view stereo measures with the highest confidence.
//!
//! The odometry tracks few points, and a given trajectory comes with none. A network's depth, off by a factor that varies
//! slowly over each image, can be fitted to these points as well, as long as its error is larger than stereo's.

use crate::config::Config;
use crate::error::Error;
use std::collections::BTreeMap;
use vidar_align::landmark_scale::{DepthPoint, LandmarkConfig, point_ratios};
use vidar_align::landmark_transfer::pixel_at_size;
use vidar_core::Watch;
use vidar_core::camera::Pixel;
use vidar_core::model::ChunkFrame;
use vidar_core::{ChunkView, ChunkViews, FrameId, GeometryPrediction, Image, ViewGeometry};
use vidar_solve::statistics::median_upper;
use vidar_stereo::{StereoConfig, StereoError, StereoModel, TOLERANCE_RATIO};

/// Blocks across and down that the image is cut into; each gives one landmark at most.
const BLOCKS: (usize, usize) = (20, 14);
/// A few hundred points need no fine image.
const MAX_WIDTH_PX: usize = 240;
/// The least probability that the depth is right to within [`TOLERANCE_RATIO`]. Maps by da3-nano on given poses at 0.75, 0.6 and 0.5, F@0.05: redkitchen
/// .210, .272, .274, HoloLens .466, .456, .450, rendered room U .354, .355, .364.
const MIN_CONFIDENCE: f32 = 0.6;

/// A network whose median difference from stereo is smaller may be the better of the two: stereo's errors are those of whole
/// regions, which held-out landmarks cannot show. 1.5 times stereo's tolerance.
const CONTRADICTS: f64 = 1.5 * TOLERANCE_RATIO as f64;

/// What stereo's errors have in common from point to point and chunk to chunk (calibration, poses, exposure), of ln(depth):
/// half of its tolerance.
pub const SHARED_STD: f64 = 0.5 * TOLERANCE_RATIO as f64;

/// Finds landmarks by stereo.
pub struct StereoLandmarks {
    stereo: StereoModel,
    config: LandmarkConfig,
}

impl StereoLandmarks {
    /// Stereo at a reduced size.
    pub fn new(config: &Config) -> Result<Self, Error> {
        let max_width_px = config.stereo.max_width_px.min(MAX_WIDTH_PX);
        let quick = StereoConfig { max_width_px, ..config.stereo.clone() };
        Ok(Self { stereo: StereoModel::new(quick)?, config: config.align.landmarks.clone() })
    }

    /// Landmarks of those of a prediction's `views` that have a pose, at the pixels of its depth. Empty where the camera hardly moved, or where stereo and the prediction agree.
    pub fn find(
        &self,
        prediction: &GeometryPrediction,
        views: &[ChunkView],
        masks: &[Option<Image<bool>>],
        watch: Watch<'_>,
    ) -> Result<BTreeMap<FrameId, Vec<DepthPoint>>, StereoError> {
        let with_masks = views.iter().enumerate().map(|(i, v)| (v.clone(), masks.get(i).cloned().flatten()));
        let (views, masks): (Vec<ChunkView>, Vec<_>) =
            with_masks.filter(|(v, _)| v.world_from_camera.is_some()).unzip();
        let references = 0..views.len();
        let views = ChunkViews { id: prediction.chunk_id, views };
        let by_stereo = match self.stereo.predict_unmasked(&views, &masks, references, watch) {
            Ok(output) => output.prediction.views,
            Err(StereoError::TooFewViews { .. } | StereoError::Cancelled) => return Ok(BTreeMap::new()),
            Err(error) => return Err(error),
        };
        let mut numbers = 0..;
        let landmarks_of = |view: &ViewGeometry| {
            let stereo = by_stereo.iter().find(|s| s.frame_id == view.frame_id)?;
            let moved = |l: DepthPoint| {
                let pixel = pixel_at_size(&l.pixel, &stereo.intrinsics, &view.intrinsics)?;
                Some(DepthPoint { pixel, ..l })
            };
            let points = most_confident(stereo, &mut numbers);
            Some((view.frame_id, points.into_iter().filter_map(moved).collect()))
        };
        let landmarks: BTreeMap<_, _> = prediction.views.iter().filter_map(landmarks_of).collect();
        Ok(if self.contradicts(prediction, &landmarks) { landmarks } else { BTreeMap::new() })
    }

    /// Whether a chunk's depth differs from its landmarks by more than stereo's error.
    fn contradicts(
        &self,
        prediction: &GeometryPrediction,
        landmarks: &BTreeMap<FrameId, Vec<DepthPoint>>,
    ) -> bool {
        let of = |v: &ViewGeometry| {
            landmarks.get(&v.frame_id).map_or(Vec::new(), |l| point_ratios(v, l, &self.config))
        };
        let logs: Vec<f64> = prediction.views.iter().flat_map(of).map(|r| r.log_ratio).collect();
        // The unit of a chunk in a frame of its own is free.
        let is_free = prediction.frame == ChunkFrame::ModelNative;
        let unit = if is_free { median_upper(&mut logs.clone()) } else { Some(0.0) };
        let off = |unit: f64| median_upper(&mut logs.iter().map(|l| (l - unit).abs()).collect::<Vec<_>>());
        unit.and_then(off).is_some_and(|off| off > CONTRADICTS)
    }
}

/// The pixel of each block whose depth is most confident. No point is followed from view to view: each has its own number.
fn most_confident(view: &ViewGeometry, numbers: &mut impl Iterator<Item = u32>) -> Vec<DepthPoint> {
    let (depth, confidence) = (view.depth.image(), view.confidence.image());
    let (width, height) = (depth.width(), depth.height());
    let within =
        |block: usize, blocks: usize, size: usize| block * size / blocks..(block + 1) * size / blocks;
    let pick = |block: usize| {
        let columns = within(block % BLOCKS.0, BLOCKS.0, width);
        let candidates = within(block / BLOCKS.0, BLOCKS.1, height)
            .flat_map(|y| columns.clone().map(move |x| (x, y)))
            .filter(|&at| depth[at].is_finite() && confidence[at] >= MIN_CONFIDENCE);
        candidates.reduce(|a, b| if confidence[b] > confidence[a] { b } else { a })
    };
    let landmark = |((x, y), number): ((usize, usize), u32)| {
        let inverse_depth = 1.0 / f64::from(depth[(x, y)]);
        DepthPoint {
            number,
            pixel: Pixel::new(x as f64, y as f64),
            inverse_depth,
            inverse_depth_std: f64::from(TOLERANCE_RATIO) * inverse_depth,
        }
    };
    (0..BLOCKS.0 * BLOCKS.1).filter_map(pick).zip(numbers).map(landmark).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::{ChunkId, Confidence, Image, Pinhole, RelativeDepth, Se3};

    fn view(width: usize, height: usize, depth: Image<f32>, confidence: Image<f32>) -> ViewGeometry {
        ViewGeometry {
            frame_id: FrameId(3),
            chunk_from_camera: Se3::IDENTITY,
            intrinsics: Pinhole::new(150.0, 150.0, 99.5, 69.5, width, height).unwrap(),
            depth: RelativeDepth::new(depth),
            confidence: Confidence::new(confidence),
        }
    }

    /// A wall 2 m away that stereo measures on the left half alone, with more confidence at one pixel of each block.
    #[test]
    fn every_block_that_stereo_measures_gives_one_landmark_where_confidence_is_highest() {
        let (width, height) = (200, 140);
        let mut depth = Image::filled(width, height, 2.0_f32);
        depth.data_mut()[0] = f32::NAN;
        let sure = |x: usize, y: usize| match (x < width / 2, x % 10 == 7 && y % 10 == 4) {
            (false, _) => 0.5,
            (true, false) => 0.8,
            (true, true) => 0.9,
        };
        let view = view(width, height, depth, Image::from_fn(width, height, sure));
        let landmarks = most_confident(&view, &mut (0..));
        assert_eq!(landmarks.len(), 10 * 14);
        for landmark in &landmarks {
            assert_eq!((landmark.pixel.x as usize % 10, landmark.pixel.y as usize % 10), (7, 4));
            assert!((landmark.inverse_depth - 0.5).abs() < 1e-12);
            assert!((landmark.inverse_depth_std - 0.015).abs() < 1e-9);
        }
        let numbers: std::collections::BTreeSet<_> = landmarks.iter().map(|l| l.number).collect();
        assert_eq!(numbers.len(), landmarks.len());
    }

    /// A wall that a network sees 10 % too far contradicts landmarks in metres, not those of a chunk whose unit is free; one
    /// that it sees 2 % too far contradicts neither.
    #[test]
    fn a_network_is_contradicted_where_it_is_off_by_more_than_stereo() {
        let (width, height) = (200, 140);
        let seen =
            |z: f32| view(width, height, Image::filled(width, height, z), Image::filled(width, height, 1.0));
        let stereo = StereoModel::new(StereoConfig::default()).unwrap();
        let stereo_landmarks = StereoLandmarks { stereo, config: LandmarkConfig::default() };
        let landmarks = BTreeMap::from([(FrameId(3), most_confident(&seen(2.0), &mut (0..)))]);
        let is_contradicted = |z: f32, frame: ChunkFrame| {
            let prediction = GeometryPrediction { chunk_id: ChunkId(0), frame, views: vec![seen(z)] };
            stereo_landmarks.contradicts(&prediction, &landmarks)
        };
        assert!(is_contradicted(2.2, ChunkFrame::PriorWorld));
        assert!(!is_contradicted(2.04, ChunkFrame::PriorWorld));
        assert!(!is_contradicted(2.2, ChunkFrame::ModelNative));
        let bent = view(
            width,
            height,
            Image::from_fn(width, height, |x, _| 2.0 + 0.6 * x as f32 / width as f32),
            Image::filled(width, height, 1.0),
        );
        let bent =
            GeometryPrediction { chunk_id: ChunkId(0), frame: ChunkFrame::ModelNative, views: vec![bent] };
        assert!(stereo_landmarks.contradicts(&bent, &landmarks));
    }
}
