//! What is kept of a chunk after its dense geometry is dropped.

use super::config::AlignerConfig;
use super::frames::Frames;
use super::pose_fit::{CameraPair, fit_about_rotations};
use super::report::{ChunkStatus, RejectionReason};
use crate::depth_field::DepthField;
use crate::landmark_scale::LogScale;
use crate::overlap::{OverlapFit, SampledView};
use vidar_core::model::ChunkFrame;
use vidar_core::{ChunkId, FrameId, GeometryPrediction, Se3, Sim3, ViewGeometry};
use vidar_solve::statistics::median_upper;

/// A view of a chunk.
#[derive(Clone, Debug)]
pub(super) struct View {
    pub frame_id: FrameId,
    pub chunk_from_camera: Se3,
    /// Median depth, chunk units.
    pub median_depth: f64,
    /// A few hundred depths: for loops, and for frames that come back.
    pub samples: SampledView,
    pub field: Option<DepthField>,
}

/// A chunk.
#[derive(Clone, Debug)]
pub(super) struct Chunk {
    pub id: ChunkId,
    pub frame: ChunkFrame,
    pub views: Vec<View>,
    pub status: ChunkStatus,
    /// The constraint to the last usable chunk before.
    pub overlap: Option<OverlapConstraint>,
    /// Constraints to older chunks that hold some of the same frames.
    pub revisits: Vec<OverlapConstraint>,
    /// ln(metres per unit) from landmarks.
    pub landmark_scale: Option<LogScale>,
    pub rejections: Vec<RejectionReason>,
    /// From the world of its pose priors as they were when the chunk came to that as they are now.
    pub now_from_then: Sim3,
    /// `world_from_chunk` from pose priors and overlap when the chunk came.
    pub initial: Option<Sim3>,
    pub log_scale_std: f64,
    /// Whether the odometry within it agrees with chunks that agree with each other.
    pub odometry_trusted: bool,
}

/// σ of ln(metres per unit) of a chunk that was predicted in the world of its pose priors and that no neighbour contradicts.
const PRIOR_WORLD_STD: f64 = 0.005;
/// The same where it and the chunk before disagree on shared frames so much that no overlap constraint was found.
const PRIOR_WORLD_STD_WITHOUT_OVERLAP: f64 = 0.3;

/// Two chunks constrained by the frames that both hold.
#[derive(Clone, Debug)]
pub(super) struct OverlapConstraint {
    /// Index of the earlier chunk.
    pub earlier: usize,
    /// Frames that both hold.
    pub frames: usize,
    /// `earlier_from_this` and its covariance.
    pub fit: OverlapFit,
}

impl Chunk {
    /// Cameras that have a pose prior, in the chunk and in the world.
    pub fn pairs(&self, frames: &Frames) -> Vec<CameraPair> {
        self.views
            .iter()
            .filter_map(|v| {
                let prior = frames.pose_prior(v.frame_id)?;
                Some(CameraPair {
                    chunk_from_camera: v.chunk_from_camera,
                    world_from_camera: prior.world_from_camera,
                })
            })
            .collect()
    }

    /// Its pose priors, which were `before`, are `now`: how their world moved about it. Where they do not tell how lengths changed, it is by
    /// the factor `scale`.
    pub fn follow(&mut self, before: &[CameraPair], now: &[CameraPair], scale: f64) -> Option<Sim3> {
        let moved = before.iter().zip(now).map(|(before, now)| CameraPair {
            chunk_from_camera: before.world_from_camera,
            world_from_camera: now.world_from_camera,
        });
        let now_from_before = fit_about_rotations(&moved.collect::<Vec<_>>(), scale, 0.0)?.world_from_chunk;
        self.now_from_then = now_from_before * self.now_from_then;
        if let Some(landmarks) = &mut self.landmark_scale {
            landmarks.log_scale += now_from_before.scale.ln();
        }
        Some(now_from_before)
    }

    /// Median over views of their median depth, chunk units; 1 without views.
    pub fn median_depth(&self) -> f64 {
        median_upper(&mut self.views.iter().map(|v| v.median_depth).collect::<Vec<f64>>()).unwrap_or(1.0)
    }

    pub fn view(&self, frame: FrameId) -> Option<&View> {
        self.views.iter().find(|v| v.frame_id == frame)
    }

    pub fn is_usable(&self) -> bool {
        self.status.is_usable()
    }

    /// σ of ln(metres per unit) of the depth of a chunk in the world of its pose priors: no smaller than the scale step to
    /// the chunk before on the frames that both hold. Stereo chunks agree to a per mille; a small network that was given
    /// the poses may predict each chunk at another size. Its camera centres, which were given, are no evidence of it.
    pub fn prior_world_std(&self) -> f64 {
        match &self.overlap {
            Some(overlap) => overlap.fit.target_from_source.scale.ln().abs().max(PRIOR_WORLD_STD),
            None if self.rejections.contains(&RejectionReason::NoOverlap) => PRIOR_WORLD_STD_WITHOUT_OVERLAP,
            None => PRIOR_WORLD_STD,
        }
    }
}

/// The usable views of a prediction, each with its dense samples; and how many views were dropped.
pub(super) fn sampled_views(
    prediction: &GeometryPrediction,
    config: &AlignerConfig,
) -> (Vec<View>, Vec<SampledView>, usize) {
    let mut views: Vec<View> = Vec::with_capacity(prediction.views.len());
    let mut dense: Vec<SampledView> = Vec::with_capacity(prediction.views.len());
    for view in &prediction.views {
        let sampled = SampledView::new(view, config.overlap.samples_per_view);
        let Some(median_depth) = sampled.median_depth() else { continue };
        // A frame given twice in one chunk is one view.
        if views.iter().any(|v| v.frame_id == view.frame_id) {
            continue;
        }
        views.push(View {
            frame_id: view.frame_id,
            chunk_from_camera: view.chunk_from_camera,
            median_depth,
            samples: sparse_samples(view),
            field: None,
        });
        dense.push(sampled);
    }
    let dropped = prediction.views.len() - views.len();
    (views, dense, dropped)
}

/// Depths kept of every view of every chunk: 4 kB.
const SPARSE_SAMPLES: usize = 512;

/// A view as it is kept for the whole run.
pub(super) fn sparse_samples(view: &ViewGeometry) -> SampledView {
    SampledView::new(view, SPARSE_SAMPLES)
}
