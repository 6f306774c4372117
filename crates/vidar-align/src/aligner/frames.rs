//! Frames in the order of time, with their pose priors.

use super::config::GraphWeights;
use super::observation::PosePrior;
use crate::covariance::transported;
use nalgebra::{Matrix6, Vector6};
use std::collections::BTreeMap;
use vidar_core::{FrameId, LieGroup, PoseCovariance, Se3, Timestamp};

/// A frame as it takes part in the graph.
#[derive(Clone, Debug)]
pub(super) struct GraphKeyframe {
    pub frame_id: FrameId,
    pub time: Timestamp,
    pub pose_prior: Option<PosePrior>,
}

/// From one frame with a pose prior to the next.
#[derive(Clone, Copy, Debug)]
pub(super) struct OdometryStep {
    pub from: FrameId,
    pub to: FrameId,
    pub from_from_to: Se3,
    pub world_from_to: Se3,
    dt_s: f64,
    relative_covariance: Option<PoseCovariance>,
}

impl OdometryStep {
    /// Covariance of δ in `from_from_to · exp(δ)`: the odometry's own, or that of typical odometry.
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

/// All frames of a run.
#[derive(Clone, Debug, Default)]
pub(super) struct Frames {
    by_id: BTreeMap<FrameId, GraphKeyframe>,
    /// Segment of the first trusted pose prior: its world is the world of the map.
    segment: Option<u32>,
}

impl Frames {
    /// Adds a frame, or replaces its time and, where a finite one is given, its pose prior: the odometry may have revised it.
    pub fn insert(&mut self, frame_id: FrameId, time: Timestamp, pose_prior: Option<PosePrior>) {
        let finite = pose_prior.filter(|p| p.world_from_camera.is_finite());
        let frame = self.by_id.entry(frame_id).or_insert(GraphKeyframe { frame_id, time, pose_prior: None });
        frame.time = time;
        if let Some(prior) = finite {
            if prior.is_trusted && self.segment.is_none() {
                self.segment = Some(prior.segment);
            }
            frame.pose_prior = Some(prior);
        }
    }

    /// Replaces the poses of pose priors.
    pub fn revise(&mut self, poses: &[(FrameId, Se3)]) {
        for (frame_id, pose) in poses.iter().filter(|(_, pose)| pose.is_finite()) {
            if let Some(prior) = self.by_id.get_mut(frame_id).and_then(|f| f.pose_prior.as_mut()) {
                prior.world_from_camera = *pose;
            }
        }
    }

    pub fn iter(&self) -> impl Iterator<Item = &GraphKeyframe> {
        self.by_id.values()
    }

    pub fn memory_bytes(&self) -> usize {
        self.by_id.len() * size_of::<GraphKeyframe>()
    }

    /// The pose prior of a frame, if it is trusted and shares the world of the first one.
    pub fn pose_prior(&self, frame: FrameId) -> Option<&PosePrior> {
        let prior = self.by_id.get(&frame)?.pose_prior.as_ref()?;
        (prior.is_trusted && Some(prior.segment) == self.segment).then_some(prior)
    }

    /// Steps between consecutive frames with pose priors of one segment.
    pub fn steps(&self) -> impl Iterator<Item = OdometryStep> + '_ {
        let with_prior = || self.by_id.values().filter_map(|k| Some((k, k.pose_prior.as_ref()?)));
        with_prior().zip(with_prior().skip(1)).filter(|(a, b)| a.1.segment == b.1.segment).map(
            |((i, a), (j, b))| OdometryStep {
                from: i.frame_id,
                to: j.frame_id,
                from_from_to: a.world_from_camera.inverse() * b.world_from_camera,
                world_from_to: b.world_from_camera,
                dt_s: j.time.since(i.time).as_secs_f64().abs(),
                relative_covariance: b.relative_covariance,
            },
        )
    }

    /// Length of the path along the pose priors up to a frame, m; `None` without pose priors.
    pub fn travel_m(&self, frame: FrameId) -> Option<f64> {
        let mut steps = self.steps().take_while(|s| s.to <= frame).peekable();
        steps.peek()?;
        Some(steps.map(|s| s.from_from_to.translation.norm()).sum())
    }

    /// `first_from_second` of two frames with pose priors, and the covariance of its right perturbation, summed over the
    /// steps between them: `Σ Ad(T_last⁻¹ T_k) Σ_k Ad(…)ᵀ`.
    pub fn relative(
        &self,
        first: FrameId,
        second: FrameId,
        weights: &GraphWeights,
    ) -> Option<(Se3, PoseCovariance)> {
        let end = self.pose_prior(second)?.world_from_camera;
        let start = self.pose_prior(first)?.world_from_camera;
        let mut covariance = Matrix6::zeros();
        for step in self.steps().filter(|s| s.from >= first && s.to <= second) {
            let to_end = (end.inverse() * step.world_from_to).adjoint();
            covariance += transported(&to_end, &step.covariance(weights));
        }
        Some((start.inverse() * end, covariance))
    }
}
