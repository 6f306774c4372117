//! What a feed-forward any-view network would have predicted of a synthetic world.
//!
//! True depth is rendered and then spoiled as Depth Anything 3 spoils it ([`PredictionErrors`]): each chunk has a frame
//! and scale of its own, its cameras drift from view to view and its depth scale with them, depth bends smoothly within
//! a view, bleeds over edges and is noisy, and confidence reflects it only in part. Given prior poses
//! (pose-conditioned), frame and scale are those of the poses up to a small error of scale, and drift is smaller.
//!
//! A frame that two chunks see is predicted twice, with errors that agree only as far as they belong to the image
//! (`deformation_frame_share`). Everything follows from the seed, the chunk's number and the frame's number; the same
//! numbers give the same bits for any number of threads.

mod errors;
mod field;
mod model;
mod motion;
mod pixels;

pub use errors::PredictionErrors;
pub use model::{Conditioning, SyntheticModel};

use crate::error::SynthError;
use crate::random::{Gaussian, Purpose, stream};
use crate::render::{RayTable, depth_image};
use crate::world::World;
use field::Field;
use pixels::ViewErrors;
use rayon::prelude::*;
use vidar_core::model::ChunkFrame;
use vidar_core::{
    CameraModel, ChunkId, FrameId, GeometryPrediction, MetricDepth, Pinhole, Se3, Timestamp, ViewGeometry,
};

/// A view of the world as it is.
#[derive(Clone, Debug)]
pub struct TrueView {
    /// Which frame.
    pub frame_id: FrameId,
    /// When it was taken.
    pub time: Timestamp,
    /// Where the camera stood.
    pub world_from_camera: Se3,
    /// Intrinsics at the depth's size.
    pub intrinsics: Pinhole,
    /// Exact z-depth, m.
    pub depth: MetricDepth,
}

/// A place to look from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TruePlace {
    /// Which frame.
    pub frame_id: FrameId,
    /// When it was taken.
    pub time: Timestamp,
    /// Where the camera stands.
    pub world_from_camera: Se3,
}

/// Exact depth of `world` seen from `places` by a camera of `intrinsics`.
pub fn true_views(world: &World, places: &[TruePlace], intrinsics: &Pinhole) -> Vec<TrueView> {
    let rays = RayTable::new(&CameraModel::Pinhole(*intrinsics), 1);
    let view = |place: &TruePlace| TrueView {
        frame_id: place.frame_id,
        time: place.time,
        world_from_camera: place.world_from_camera,
        intrinsics: *intrinsics,
        depth: MetricDepth::new(depth_image(world, &rays, &place.world_from_camera)),
    };
    places.par_iter().map(view).collect()
}

/// The prediction of one chunk from its true views, in the order of time.
///
/// Without `prior` the prediction is pose-free ([`ChunkFrame::ModelNative`]); with one prior pose
/// (`world_from_camera`, m) per view it is pose-conditioned ([`ChunkFrame::PriorWorld`]).
///
/// # Errors
/// A key of `errors` outside its domain, or another number of prior poses than of views.
pub fn predict_chunk(
    chunk_id: ChunkId,
    views: &[TrueView],
    prior: Option<&[Se3]>,
    errors: &PredictionErrors,
    seed: u64,
) -> Result<GeometryPrediction, SynthError> {
    errors.validate()?;
    if let Some(prior) = prior
        && prior.len() != views.len()
    {
        let found = format!("{} poses for {} views", prior.len(), views.len());
        return Err(SynthError::BadConfig { key: "prior", expected: "one pose per view", found });
    }
    let motion = motion::believed(chunk_id.0, views, prior, errors, seed);
    let deformations = deformations(chunk_id.0, views, errors, seed);
    let predicted: Result<Vec<ViewGeometry>, SynthError> = views
        .par_iter()
        .zip(deformations)
        .enumerate()
        .map(|(i, (view, deformation))| {
            let own = ViewErrors { log_scale: motion.log_depth_scale[i], deformation, failed: motion.failed };
            let purpose = Purpose::Prediction(chunk_id.0, view.frame_id.0);
            let mut random = Gaussian::new(stream(seed, purpose));
            let (depth, confidence) = pixels::believed(view.depth.image(), &own, errors, &mut random);
            let mut intrinsics = view.intrinsics;
            intrinsics.fx *= motion.focal;
            intrinsics.fy *= motion.focal;
            let chunk_from_camera = motion.chunk_from_camera[i];
            Ok(ViewGeometry { frame_id: view.frame_id, chunk_from_camera, intrinsics, depth, confidence })
        })
        .collect();
    let frame = if prior.is_some() { ChunkFrame::PriorWorld } else { ChunkFrame::ModelNative };
    Ok(GeometryPrediction { chunk_id, frame, views: predicted? })
}

/// Per view a deformation of variance 1: one part is the image's own, one changes slowly through the chunk.
fn deformations(chunk: u32, views: &[TrueView], errors: &PredictionErrors, seed: u64) -> Vec<Field> {
    let order = errors.deformation_order;
    let mut random = Gaussian::new(stream(seed, Purpose::ChunkField(chunk)));
    let (own, shared) =
        ((1.0 - errors.deformation_frame_share).sqrt(), errors.deformation_frame_share.sqrt());
    let kept = errors.deformation_persistence;
    let fresh = (1.0 - kept * kept).sqrt();
    let mut slow = Field::random(order, &mut random);
    let mut of_view = |view: &TrueView| {
        let mut image_random = Gaussian::new(stream(seed, Purpose::FrameField(view.frame_id.0)));
        let image = Field::random(order, &mut image_random);
        let field = slow.mixed(own, &image, shared);
        slow = slow.mixed(kept, &Field::random(order, &mut random), fresh);
        field
    };
    views.iter().map(&mut of_view).collect()
}

#[cfg(test)]
mod tests;
