//! What the machine keeps of chunks and frames.

use super::anchored::Pair;
use super::observation::PosePrior;
use super::report::{ChunkStatus, RejectionReason};
use super::{AlignerConfig, GraphWeights};
use crate::depth_field::DepthField;
use crate::landmark_scale::LogScale;
use crate::overlap::{OverlapFit, SampledView};
use nalgebra::Vector6;
use std::collections::BTreeMap;
use vidar_core::model::ChunkFrame;
use vidar_core::{
    ChunkId, FrameId, GeometryPrediction, LieGroup, PoseCovariance, Se3, Sim3, Timestamp, ViewGeometry,
};

/// A view of a chunk.
#[derive(Clone, Debug)]
pub(super) struct View {
    pub frame_id: FrameId,
    pub chunk_from_camera: Se3,
    /// Middle depth, chunk units.
    pub median_depth: f64,
    /// A few hundred depths, for loops and for frames that come back.
    pub thin: SampledView,
    pub field: Option<DepthField>,
}

/// A chunk after its dense geometry is gone.
#[derive(Clone, Debug)]
pub(super) struct Chunk {
    pub id: ChunkId,
    pub frame: ChunkFrame,
    pub views: Vec<View>,
    pub status: ChunkStatus,
    /// The tie to the last usable chunk before, by its index.
    pub tie: Option<OverlapConstraint>,
    /// Further ties to older chunks that hold some of the same frames.
    pub revisits: Vec<OverlapConstraint>,
    /// ln(metres per unit) as landmarks tell it.
    pub landmark_scale: Option<LogScale>,
    pub rejections: Vec<RejectionReason>,
    /// Where anchors and overlap put it when it came.
    pub first_guess: Option<Sim3>,
    pub log_scale_std: f64,
    /// Whether the odometry is believed within it.
    pub odometry_trusted: bool,
}

/// How far the unit of a chunk that was predicted in the anchors' own world is from a metre, where no neighbour contradicts it.
const PRIOR_WORLD_SCALE: f64 = 0.005;
/// The same where it and the chunk before see shared frames so differently that nothing ties them.
const PRIOR_WORLD_UNKNOWN: f64 = 0.3;

/// `earlier_from_this` of an overlap.
#[derive(Clone, Debug)]
pub(super) struct OverlapConstraint {
    pub to: usize,
    pub frames: usize,
    pub fit: OverlapFit,
}

/// From one anchored frame to the next.
#[derive(Clone, Copy, Debug)]
pub(super) struct Step {
    pub from: FrameId,
    pub to: FrameId,
    pub from_from_to: Se3,
    pub world_from_to: Se3,
    dt_s: f64,
    relative_covariance: Option<PoseCovariance>,
}

impl Step {
    /// Covariance of δ in `from_from_to · exp(δ)`: the odometry's own, or what odometry is like.
    pub fn covariance(&self, weights: &GraphWeights) -> PoseCovariance {
        let usable =
            |c: &PoseCovariance| c.iter().all(|v| v.is_finite()) && c.diagonal().iter().all(|v| *v > 0.0);
        self.relative_covariance.filter(usable).unwrap_or_else(|| {
            let position = (weights.odometry_per_metre * self.from_from_to.translation.norm())
                .max(weights.odometry_floor_m);
            let rotation = weights.odometry_rotation_deg.to_radians() * self.dt_s.clamp(0.02, 10.0).sqrt();
            let (r, p) = (rotation * rotation, position * position);
            PoseCovariance::from_diagonal(&Vector6::new(r, r, r, p, p, p))
        })
    }
}

/// A frame as it goes through the run.
#[derive(Clone, Debug)]
pub(super) struct GraphKeyframe {
    pub frame_id: FrameId,
    pub time: Timestamp,
    pub pose_prior: Option<PosePrior>,
}

/// Frames in the order of time.
#[derive(Clone, Debug, Default)]
pub(super) struct Frames {
    by_id: BTreeMap<FrameId, GraphKeyframe>,
    /// The segment of the first trusted anchor: its world is the world.
    segment: Option<u32>,
}

impl Frames {
    /// Takes what is new; what came later is the last word of the odometry.
    pub fn learn(&mut self, frame_id: FrameId, time: Timestamp, anchor: Option<PosePrior>) {
        let finite = anchor.filter(|a| a.world_from_camera.is_finite());
        let known = self.by_id.entry(frame_id).or_insert(GraphKeyframe { frame_id, time, pose_prior: None });
        known.time = time;
        if let Some(anchor) = finite {
            if anchor.is_trusted && self.segment.is_none() {
                self.segment = Some(anchor.segment);
            }
            known.pose_prior = Some(anchor);
        }
    }

    pub fn iter(&self) -> impl Iterator<Item = &GraphKeyframe> {
        self.by_id.values()
    }

    pub fn len(&self) -> usize {
        self.by_id.len()
    }

    /// The metric anchor of a frame, if it may be believed and shares the world of the first one.
    pub fn pose_prior(&self, frame: FrameId) -> Option<&PosePrior> {
        let anchor = self.by_id.get(&frame)?.pose_prior.as_ref()?;
        (anchor.is_trusted && Some(anchor.segment) == self.segment).then_some(anchor)
    }
}

impl Frames {
    /// Steps between neighbouring anchored frames of one segment.
    pub fn steps(&self) -> impl Iterator<Item = Step> + '_ {
        let anchored = || self.by_id.values().filter_map(|k| Some((k, k.pose_prior.as_ref()?)));
        anchored().zip(anchored().skip(1)).filter(|(a, b)| a.1.segment == b.1.segment).map(
            |((i, a), (j, b))| Step {
                from: i.frame_id,
                to: j.frame_id,
                from_from_to: a.world_from_camera.inverse() * b.world_from_camera,
                world_from_to: b.world_from_camera,
                dt_s: j.time.since(i.time).as_secs_f64().abs(),
                relative_covariance: b.relative_covariance,
            },
        )
    }

    /// Length of the anchored way up to a frame, m; `None` without anchors.
    pub fn travel_m(&self, frame: FrameId) -> Option<f64> {
        let mut steps = self.steps().take_while(|s| s.to <= frame).peekable();
        steps.peek()?;
        Some(steps.map(|s| s.from_from_to.translation.norm()).sum())
    }
}

impl Chunk {
    /// Cameras that have anchors, as both have them.
    pub fn pairs(&self, frames: &Frames) -> Vec<Pair> {
        self.views
            .iter()
            .filter_map(|v| {
                let anchor = frames.pose_prior(v.frame_id)?;
                Some(Pair {
                    chunk_from_camera: v.chunk_from_camera,
                    world_from_camera: anchor.world_from_camera,
                })
            })
            .collect()
    }

    /// Middle of the views' middle depths, chunk units; 1 without views.
    pub fn median_depth(&self) -> f64 {
        let mut depths: Vec<f64> = self.views.iter().map(|v| v.median_depth).collect();
        let middle = depths.len() / 2;
        if depths.is_empty() { 1.0 } else { *depths.select_nth_unstable_by(middle, f64::total_cmp).1 }
    }

    pub fn view(&self, frame: FrameId) -> Option<&View> {
        self.views.iter().find(|v| v.frame_id == frame)
    }

    pub fn is_usable(&self) -> bool {
        self.status.is_usable()
    }

    /// How far the depth of a chunk in the anchors' own world may be trusted, standard deviation of ln: no farther than the chunk
    /// before bears out on the frames that both hold. Stereo's agree to a per mille; a small network that was given the poses
    /// may see each chunk at another size. Its centres, which were given, say nothing of it.
    pub fn prior_world_std(&self) -> f64 {
        match &self.tie {
            Some(tie) => tie.fit.target_from_source.scale.ln().abs().max(PRIOR_WORLD_SCALE),
            None if self.rejections.contains(&RejectionReason::NoOverlap) => PRIOR_WORLD_UNKNOWN,
            None => PRIOR_WORLD_SCALE,
        }
    }
}

/// The views of a prediction that can be used, sampled; how many could not.
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
            thin: sampled_thin(view),
            field: None,
        });
        dense.push(sampled);
    }
    let dropped = prediction.views.len() - views.len();
    (views, dense, dropped)
}

/// Depths kept of every view of every chunk: 4 kB.
const THIN_SAMPLES: usize = 512;

/// A view as it is kept for good.
pub(super) fn sampled_thin(view: &ViewGeometry) -> SampledView {
    SampledView::new(view, THIN_SAMPLES)
}
