//! Pose-conditioned (the paper's section III-E): poses are the odometry's, each chunk's depth is divided by its robust scale,
//! `D ← D / s*`, with the scale's range and the rank of section III-F. Ground truth is the same with true poses. Where a
//! chunk in a frame of its own has landmarks, its scale is that of centres and landmarks together.

use super::super::chunk::Chunk;
use super::super::estimate::Estimate;
use super::super::history::History;
use super::super::pose_fit::{
    self, CameraPair, PoseFit, center_rms, rescaled_about_centers, with_landmark_scale,
};
use super::super::report::{ChunkStatus, RejectionReason};
use super::Coupling;
use crate::aligner::chunk::OverlapConstraint;
use vidar_core::Sim3;
use vidar_core::model::ChunkFrame;

/// The coupling.
#[derive(Debug)]
pub(in crate::aligner) struct PoseConditioned;

impl Coupling for PoseConditioned {
    fn revisits(&self, _history: &History, _chunk: &Chunk) -> Vec<OverlapConstraint> {
        Vec::new()
    }

    fn closes_loops(&self) -> bool {
        false
    }

    fn starts_at_priors(&self) -> bool {
        true
    }

    fn initialise(&self, history: &History, chunk: &mut Chunk, pairs: &[CameraPair]) {
        if pairs.is_empty() {
            chunk.status = ChunkStatus::Unplaced;
            return;
        }
        let fitted = match chunk.frame {
            ChunkFrame::PriorWorld => Ok((Sim3::IDENTITY, ChunkStatus::PriorWorld)),
            ChunkFrame::ModelNative => pose_fit::world_from_chunk(pairs).map(|s| (s, ChunkStatus::Fitted)),
        };
        let (mut world_from_chunk, status) = fitted.unwrap_or((Sim3::IDENTITY, ChunkStatus::RankDeficient));
        chunk.status = status;
        if status == ChunkStatus::RankDeficient {
            chunk.rejections.push(RejectionReason::RankDeficient);
        }
        chunk.log_scale_std = match chunk.frame {
            ChunkFrame::PriorWorld => chunk.prior_world_std(),
            ChunkFrame::ModelNative => {
                let fit = history.pose_fit(chunk, pairs, world_from_chunk.scale);
                let fit = fit.map(|f| PoseFit { world_from_chunk, ..f });
                let fit = fit.map(|f| with_landmark_scale(f, chunk.landmark_scale, pairs));
                world_from_chunk = fit.map_or(world_from_chunk, |f| f.world_from_chunk);
                fit.map_or(f64::INFINITY, |f| f.log_scale_std)
            }
        };
        if let Some(clamped) = clamped_scale(history, chunk, &world_from_chunk) {
            // In the world of the pose priors the scale is 1 already: it is the overlap's scale that is rejected.
            if chunk.frame != ChunkFrame::PriorWorld {
                world_from_chunk = rescaled_about_centers(&world_from_chunk, clamped, pairs);
            }
            chunk.rejections.push(RejectionReason::ScaleOutOfRange);
        }
        let agrees = center_rms(&world_from_chunk, pairs) <= history.config.max_center_rms_m;
        if status.is_usable() && !agrees {
            chunk.status = ChunkStatus::Inconsistent;
        }
        chunk.initial = Some(world_from_chunk);
    }

    /// Each chunk where its pose priors put it; poses are the priors themselves.
    fn estimate(&self, history: &History) -> Estimate {
        let chunks: Vec<Option<Sim3>> =
            history.chunks.iter().map(|c| c.initial.filter(|_| c.is_usable())).collect();
        let mut estimate = Estimate::new(history, chunks, self.loops(history), true);
        for frame in history.frames.iter() {
            if let Some(prior) = history.frames.pose_prior(frame.frame_id) {
                estimate.keyframes.insert(frame.frame_id, prior.world_from_camera);
            }
        }
        estimate
    }
}

/// The scale that makes the step from the chunk before equal to that of their overlap, where the fitted one leaves
/// [0.85, 1.20] of it: between metric chunks the ratio is 1 (the paper's clamp). Landmarks measure the scale itself.
fn clamped_scale(history: &History, chunk: &Chunk, world_from_chunk: &Sim3) -> Option<f64> {
    let overlap = chunk.overlap.as_ref().filter(|_| chunk.landmark_scale.is_none())?;
    let before = history.chunks[overlap.earlier].initial.filter(|_| chunk.status.is_usable())?;
    let expected = before.scale * overlap.fit.target_from_source.scale;
    let ratio = world_from_chunk.scale / expected;
    let [low, high] = history.config.scale_range;
    (!(ratio >= low && ratio <= high)).then_some(expected)
}
