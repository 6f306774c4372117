//! A start whose IMU does not tell the scale.

use super::{Fit, InFlightInitializer, median};
use crate::backend::Smoother;
use crate::initialization::linear::LinearSolution;
use crate::initialization::monocular::INITIAL_INVERSE_DISTANCE;
use crate::initialization::views::{Track, View};
use crate::tracking::{ASSUMED_LANDMARKS, ASSUMED_LOG_STD};
use vidar_core::{LandmarkId, LieGroup};

/// Standard deviation of ln(scale) up to which a window needs no assumption: what the assumption tells. A body that goes steadily along a line or
/// a circle does not show its scale, however long one waits: what it feels looks like a bias of the accelerometer.
const TOLD_LOG_SCALE_SIGMA: f64 = 0.7;

impl InFlightInitializer {
    /// Whether the IMU tells the scale of a window.
    pub(super) fn tells_scale(smoother: &mut Smoother) -> bool {
        smoother.log_scale_sigma().is_some_and(|sigma| sigma <= TOLD_LOG_SCALE_SIGMA)
    }

    /// A solved window, whatever its scale, with its points at the assumed distance, in the median.
    pub(super) fn at_assumed_distance(
        smoother: &Smoother,
        views: &[View<'_>],
        tracks: &[Track],
    ) -> Option<LinearSolution> {
        let first = smoother.state(views.first()?.logged.frame)?;
        let first_from_world = first.world_from_body.inverse();
        let turn = first_from_world.rotation;
        let points: Vec<_> = tracks
            .iter()
            .map(|t| smoother.landmark(t.landmark).map(|l| first_from_world.act(&l.in_world)))
            .collect();
        let distance = median(points.iter().flatten().map(|p| p.norm()))?;
        let scale = 1.0 / (INITIAL_INVERSE_DISTANCE * distance);
        let solution = LinearSolution {
            velocity: turn.act(&first.velocity),
            gravity: turn.act(&smoother.imu_model()?.gravity()),
            accel_bias: first.bias.accel,
            points,
        };
        (scale.is_finite() && scale > 0.0).then(|| solution.scaled(scale))
    }

    /// Solves a window with the distances of every so many-th landmark assumed to a factor: parallax holds the others to them.
    pub(super) fn refine_with_assumed_distances(&self, smoother: &mut Smoother) -> Fit {
        let held: Vec<LandmarkId> = smoother.landmarks().map(|l| l.id).collect();
        let stride = held.len().div_ceil(ASSUMED_LANDMARKS).max(1);
        for landmark in held.iter().step_by(stride) {
            smoother.assume_distance(*landmark, INITIAL_INVERSE_DISTANCE, ASSUMED_LOG_STD);
        }
        self.refine(smoother)
    }
}
