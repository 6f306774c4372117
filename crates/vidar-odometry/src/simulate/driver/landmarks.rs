//! Tracks that become landmarks, and landmarks that are left out.

use super::FeatureOdometry;
use crate::backend::{Observation, Smoother, SmootherError};
use crate::initialization::TrackObservation;
use nalgebra::Vector3;
use vidar_core::{FrameId, LieGroup, Se3};

/// Residual of a new landmark's observations that is accepted, in standard deviations.
const NEW_GATE_SIGMAS: f64 = 4.0;

impl FeatureOdometry {
    pub(super) fn leave_out(&mut self, smoother: &mut Smoother) {
        for outlier in &self.report.outliers {
            smoother.remove_observation(outlier.frame, outlier.landmark);
            if smoother.landmark(outlier.landmark).is_some_and(|l| l.observations < 2) {
                smoother.remove_landmark(outlier.landmark);
                self.banned.insert(outlier.landmark);
                self.tracks.remove(&outlier.landmark);
            }
        }
    }

    /// Tracks with enough parallax become landmarks, hosted by the first keyframe that saw them.
    pub(super) fn add_landmarks(
        &mut self,
        smoother: &mut Smoother,
        id: FrameId,
        observations: &[TrackObservation],
    ) -> Result<(), SmootherError> {
        let keyframes: Vec<FrameId> = smoother.keyframes().collect();
        let held: Vec<FrameId> = smoother.frames().collect();
        let body_from_camera = *smoother.body_from_camera();
        for s in observations {
            if smoother.landmark(s.landmark).is_some() {
                continue;
            }
            let Some(history) = self.tracks.get_mut(&s.landmark) else { continue };
            history.retain(|(f, _)| held.contains(f));
            let Some((host, host_seen)) = history.iter().find(|(f, _)| keyframes.contains(f)).copied() else {
                continue;
            };
            let camera_of = |f: FrameId| smoother.state(f).map(|x| x.world_from_body * body_from_camera);
            let (Some(first), Some(now)) = (camera_of(host), camera_of(id)) else { continue };
            let rays = (self.camera.unproject(&host_seen.pixel), self.camera.unproject(&s.pixel));
            let (Some(ray), Some(ray_now)) = rays else { continue };
            let Some(distance) = triangulate(&first, &ray, &now, &ray_now, self.config.min_parallax_deg)
            else {
                continue;
            };
            let point = first.act(&(ray * distance));
            let fits = |f: FrameId, observations: &TrackObservation| {
                let pixel = camera_of(f).and_then(|c| self.camera.project(&c.inverse().act(&point)));
                let limit = NEW_GATE_SIGMAS * (0.5 * observations.covariance.trace()).sqrt() + 1.0;
                pixel.is_some_and(|p| (p - observations.pixel).norm() < limit)
            };
            let fitting: Vec<(FrameId, TrackObservation)> =
                history.iter().filter(|(f, s)| *f != host && fits(*f, s)).copied().collect();
            if fitting.len() < 2 || fitting.len() * 3 < history.len() {
                continue;
            }
            smoother.add_landmark(&observation(host, &host_seen), 1.0 / distance)?;
            for (frame, observations) in fitting.iter().filter(|(f, _)| *f >= host) {
                smoother.add_observation(&observation(*frame, observations))?;
            }
        }
        Ok(())
    }
}

pub(super) fn observation(frame: FrameId, observations: &TrackObservation) -> Observation {
    Observation {
        frame,
        landmark: observations.landmark,
        pixel: observations.pixel,
        covariance: observations.covariance,
    }
}

/// Distance along the first ray of the point nearest to both rays, if their angle is wide enough and it lies ahead.
fn triangulate(
    first: &Se3,
    ray: &Vector3<f64>,
    now: &Se3,
    ray_now: &Vector3<f64>,
    min_deg: f64,
) -> Option<f64> {
    let (a, b) = (first.rotation * *ray, now.rotation * *ray_now);
    let cross = a.cross(&b);
    let sin2 = cross.norm_squared();
    if sin2 < min_deg.to_radians().sin().powi(2) {
        return None;
    }
    let base = now.translation - first.translation;
    let along_first = base.cross(&b).dot(&cross) / sin2;
    let along_now = base.cross(&a).dot(&cross) / sin2;
    (along_first > 0.1 && along_now > 0.1 && along_first < 500.0).then_some(along_first)
}
