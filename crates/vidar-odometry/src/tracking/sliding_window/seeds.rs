//! Tracks whose distance is not known yet, until the smoother takes them as landmarks.

use super::{SlidingWindowOdometry, WindowPoses, observation};
use crate::backend::{Observation, SmootherError};
use crate::tracking::CameraPoses;
use crate::tracking::track::{InverseDistance, Track};
use crate::tracking::{host_covariance, parallax, unknown_distance};
use vidar_core::camera::Pixel;
use vidar_core::{FrameId, LandmarkId, LieGroup};

/// Mean chi-square per measurement (two degrees of freedom) up to which a seed's distance is accepted.
const DISTANCE_GATE: f64 = 9.0;

/// A seed becomes a landmark when its distance is known to this share...
const PROMOTION_RELATIVE_STD: f64 = 0.25;
/// ... its parallax is at least this, rad ...
const PROMOTION_PARALLAX: f64 = 0.5 * std::f64::consts::PI / 180.0;
/// ... and it was found in this many frames.
const PROMOTION_FRAMES: u32 = 4;

/// Landmarks whose distance is assumed while none is known, and the standard deviation of the logarithms of their distances.
/// Together they say that the scene is 2.5 m away to a factor of two (2.4 / √12 = 0.7), as rooms and desks are; each alone may be anywhere.
pub(crate) const ASSUMED_LANDMARKS: usize = 12;
pub(crate) const ASSUMED_LOG_STD: f64 = 2.4;

impl SlidingWindowOdometry {
    /// A state that begins at rest knows no distance, and its velocity is that of the accelerometer alone as soon as it moves.
    /// Some tracks become landmarks of an assumed distance: images without parallax then say that the body is where it was.
    pub(super) fn assume_distances(&mut self) -> Result<(), SmootherError> {
        if self.tracker.tracks.iter().any(|t| t.is_landmark) {
            return Ok(());
        }
        let mut chosen: Vec<(LandmarkId, Pixel)> = Vec::with_capacity(ASSUMED_LANDMARKS);
        let seen = |t: &&Track| t.measured.is_some() && t.found >= PROMOTION_FRAMES;
        let seen: Vec<&Track> = self.tracker.tracks.iter().filter(seen).collect();
        while chosen.len() < ASSUMED_LANDMARKS {
            // Far from those chosen, so that they look in all directions.
            let apart = |t: &Track| {
                let nearest = chosen.iter().map(|(_, p)| (t.last_pixel - p).norm_squared());
                nearest.fold(f64::INFINITY, f64::min)
            };
            let next = seen.iter().filter(|t| chosen.iter().all(|(id, _)| *id != t.id));
            let Some(next) = next.max_by(|a, b| apart(a).total_cmp(&apart(b))) else { break };
            chosen.push((next.id, next.last_pixel));
        }
        let typical = self.typical_inverse;
        for (id, _) in &chosen {
            if let Some(track) = self.tracker.tracks.iter_mut().find(|t| t.id == *id) {
                track.is_landmark = true;
                track.distance =
                    InverseDistance { mean: typical, variance: (ASSUMED_LOG_STD * typical).powi(2) };
            }
            self.promote(*id)?;
            self.smoother.assume_distance(*id, typical, ASSUMED_LOG_STD);
        }
        Ok(())
    }

    /// Estimates the distances of seeds and hands those that are known well enough to the smoother.
    pub(super) fn update_seeds(&mut self, frame: FrameId) -> Result<(), SmootherError> {
        let held = WindowPoses(&self.smoother);
        let Some(world_from_current) = held.world_from_camera(frame) else { return Ok(()) };
        let measured = self.tracker.tracks.iter().filter(|t| t.is_landmark && t.measured.is_some()).count();
        let mut room = self.config.max_landmarks.saturating_sub(measured);
        let (scratch, camera) = (&mut self.scratch.observations, &self.camera);
        let mut promoted = std::mem::take(&mut self.scratch.promoted);
        promoted.clear();
        self.tracker.tracks.retain_mut(|track| {
            if track.is_landmark || track.measured.is_none() {
                return true;
            }
            let Some(world_from_host) = held.world_from_camera(track.host.frame) else { return false };
            track.observations.retain(|(f, _)| held.0.state(*f).is_some());
            scratch.clear();
            scratch.extend(
                track
                    .observations
                    .iter()
                    .filter_map(|(f, m)| Some((held.world_from_camera(*f)?.inverse() * world_from_host, *m))),
            );
            let prior = unknown_distance(self.typical_inverse);
            let Some(estimate) = prior.updated(camera, &track.feature, scratch, DISTANCE_GATE) else {
                return false;
            };
            track.distance = estimate;
            let current_from_host = world_from_current.inverse() * world_from_host;
            let apart = parallax(&track.feature, estimate.mean, &current_from_host);
            let known = estimate.relative_std() < PROMOTION_RELATIVE_STD && apart > PROMOTION_PARALLAX;
            if known && track.found >= PROMOTION_FRAMES && room > 0 {
                room -= 1;
                track.is_landmark = true;
                promoted.push(track.id);
            }
            true
        });
        for id in &promoted {
            self.promote(*id)?;
        }
        self.scratch.promoted = promoted;
        Ok(())
    }

    /// Makes a track a landmark of the smoother, with all that the window's frames saw of it.
    fn promote(&mut self, id: LandmarkId) -> Result<(), SmootherError> {
        let Some(at) = self.tracker.tracks.iter().position(|t| t.id == id) else { return Ok(()) };
        let track = &self.tracker.tracks[at];
        let host = Observation {
            frame: track.host.frame,
            landmark: id,
            pixel: track.feature.global_pixel,
            covariance: host_covariance(track),
        };
        self.smoother.add_landmark(&host, track.distance.mean)?;
        for (frame, measured) in &track.observations {
            let observations = observation(*frame, id, measured, self.config.pixel_noise_px);
            if *frame != track.host.frame && self.smoother.add_observation(&observations).is_err() {
                // An observation of no use; the others remain.
                continue;
            }
        }
        self.tracker.tracks[at].observations.clear();
        Ok(())
    }
}
