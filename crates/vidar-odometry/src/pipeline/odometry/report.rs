//! What is said of an image.

use super::{Odometry, Phase, Status};
use crate::backend::Smoother;
use crate::imu::{Preintegration, propagate};
use crate::pipeline::health::HealthDecision;
use crate::pipeline::keyframes::{KeyframeInput, public_state, seen_landmarks};
use crate::pipeline::output::{TrackSummary, Tracking};
use crate::tracking::StepReport;
use vidar_core::{Frame, FrameId, Health, NavCovariance, Timestamp};

impl Odometry {
    /// Share of the image that moves with the camera, the largest at a time so far: its carrier, a finger, dirt on the lens. No features are taken there.
    pub fn carrier_share(&self) -> f64 {
        self.phase.tracker().fixed_share()
    }

    /// What is known after a step.
    pub(super) fn report(&mut self, step: &StepReport, frame: &Frame, id: FrameId) -> Status {
        let is_metric = self.imu_model.is_some();
        let Phase::Tracking(window) = &mut self.phase else {
            return Status::Waiting(self.failure.clone());
        };
        let Some(state) = window.state() else { return Status::Waiting(self.failure.clone()) };
        let smoother = &mut window.smoother;
        let covariance = smoother.covariance_of_newest().unwrap_or_else(unknown_covariance);
        let scale_std = present_scale_std(smoother, is_metric);
        let health = match self.health_monitor.evaluate(
            &state,
            step,
            frame.time,
            is_metric,
            scale_std,
            &self.config,
        ) {
            HealthDecision::Continue(health) => health,
            HealthDecision::Lost(reason) => return self.lose(reason),
        };
        let world_from_camera = state.world_from_body * *smoother.body_from_camera();
        let mut landmarks = seen_landmarks(smoother, &window.tracker.tracks, &world_from_camera);
        self.working.restore_landmarks(&mut landmarks);
        let mut tracking = Tracking {
            segment: self.segment,
            state: public_state(&state, frame.time),
            covariance,
            scale_std,
            health,
            tracked: step.fitting,
            tracks: step.summary(),
            landmarks,
            keyframe: None,
            revised: Vec::new(),
            settled: Vec::new(),
            joined: None,
        };
        if step.is_keyframe {
            let input = KeyframeInput {
                frame: id,
                caller_frame: frame.id,
                time: frame.time,
                segment: self.segment,
                state: &state,
                covariance: &covariance,
                scale_std,
                health,
                landmarks: &tracking.landmarks,
            };
            tracking.keyframe = Some(Box::new(self.keyframes.make(smoother, &input)));
        }
        if step.is_keyframe || !step.left.is_empty() {
            self.keyframes.revise(smoother, &step.left, &mut tracking.revised);
        }
        let body_from_camera = *smoother.body_from_camera();
        let world_from_smoother = self.world_from_smoother();
        for (frame, state) in &step.left {
            let world_from_camera = world_from_smoother * state.world_from_body * body_from_camera;
            self.relocalizer.revise(*frame, world_from_camera);
        }
        self.placed.iter().for_each(|placed| tracking.move_by(placed));
        Status::Tracking(Box::new(tracking))
    }

    /// The state carried forward by the IMU, for an image that tells nothing.
    pub(super) fn coast(&mut self, preintegration: Option<Preintegration>, time: Timestamp) -> Status {
        let Phase::Tracking(window) = &mut self.phase else {
            return Status::Waiting(self.failure.clone());
        };
        let Some(state) = window.state() else { return Status::Waiting(self.failure.clone()) };
        let covariance = window.smoother.covariance_of_newest().unwrap_or_else(unknown_covariance);
        let scale_std = present_scale_std(&mut window.smoother, self.imu_model.is_some());
        let (state, covariance) = match &preintegration {
            Some(preintegration) => {
                let carried = propagate(&state, &covariance, preintegration);
                (carried.state, carried.covariance)
            }
            None => (state, covariance),
        };
        let mut tracking = Tracking {
            segment: self.segment,
            state: public_state(&state, time),
            covariance,
            scale_std,
            health: Health::Degraded,
            tracked: 0,
            tracks: TrackSummary::default(),
            landmarks: Vec::new(),
            keyframe: None,
            revised: Vec::new(),
            settled: Vec::new(),
            joined: None,
        };
        self.placed.iter().for_each(|placed| tracking.move_by(placed));
        Status::Tracking(Box::new(tracking))
    }
}

/// Standard deviation of ln(scale) of the present window; infinite where it is not observable or not finite.
fn present_scale_std(smoother: &mut Smoother, is_metric: bool) -> f64 {
    let sigma = if is_metric { smoother.log_scale_sigma() } else { None };
    sigma.filter(|s| s.is_finite()).unwrap_or(f64::INFINITY)
}

/// Covariance of a state that the backend gives none for.
fn unknown_covariance() -> NavCovariance {
    NavCovariance::from_diagonal_element(f64::INFINITY)
}
