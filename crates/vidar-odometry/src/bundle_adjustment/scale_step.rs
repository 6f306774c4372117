//! A step whose common change of all distances is taken as a factor.
//!
//! Images do not see a common factor of positions and distances, the IMU sees it weakly: it is the longest valley of the cost, and a
//! bent one. Added to positions and inverse distances, a change by `ln s` is off by `½ (ln s)²` of each, which images see from 1 % on, so
//! that only small steps or none were taken along it. Multiplied, it leaves the images as they are. What else a step holds is added, as
//! before: to first order both are the same.

use super::landmark::{BEYOND_INFINITY, Landmark};
use super::problem::Problem;
use crate::backend::tangent_basis;
use crate::imu::{NavState, Vector15};
use nalgebra::Vector3;
use vidar_core::Se3;

/// Most change at once, in natural logarithms: the IMU's cost is linearised, too.
const MOST: f64 = 0.5;

/// Spread of the positions below which a change of scale means nothing, m².
const LEAST_SPREAD: f64 = 1e-6;

/// The part of a step that changes all distances from `centre` by one factor.
#[derive(Clone, Copy, Debug)]
pub(super) struct ScaleStep {
    ln: f64,
    centre: Vector3<f64>,
}

impl ScaleStep {
    /// The factor that explains most of the positions' steps, about the state that is held.
    pub(super) fn of(problem: &Problem, step: &[f64]) -> Self {
        let centre = problem.frames[problem.gauge.0].body.state.world_from_body.translation;
        let (mut along, mut spread) = (0.0, 0.0);
        for (k, frame) in problem.frames.iter().enumerate() {
            let from = frame.body.state.world_from_body.translation - centre;
            let at = problem.offset(k) + 3;
            along += from.dot(&Vector3::from_column_slice(&step[at..at + 3]));
            spread += from.norm_squared();
        }
        let ln = if spread > LEAST_SPREAD { (along / spread).clamp(-MOST, MOST) } else { 0.0 };
        Self { ln, centre }
    }

    /// What it changes ln(scale) by.
    pub(super) fn ln(&self) -> f64 {
        self.ln
    }

    /// The state after the whole step `delta`.
    pub(super) fn state(&self, state: &NavState, delta: &Vector15) -> NavState {
        let from = state.world_from_body.translation - self.centre;
        let mut rest = *delta;
        for axis in 0..3 {
            rest[3 + axis] -= self.ln * from[axis];
            rest[6 + axis] -= self.ln * state.velocity[axis];
        }
        let factor = self.ln.exp();
        let scaled = NavState {
            world_from_body: Se3::new(state.world_from_body.rotation, self.centre + from * factor),
            velocity: state.velocity * factor,
            bias: state.bias,
        };
        scaled.plus(&rest)
    }

    /// The landmark after the whole step `delta`.
    pub(super) fn landmark(&self, landmark: &Landmark, delta: &Vector3<f64>) -> Landmark {
        let (direction, inverse) = (&landmark.direction, landmark.inverse_distance);
        let from = landmark.origin - self.centre;
        // What the factor does to the point, times its inverse distance, in the coordinates of the landmark's steps, which hold the origin.
        let moved = (from * inverse + direction) * self.ln;
        let across = tangent_basis(direction).transpose() * moved;
        let along = -direction.dot(&moved) * inverse;
        self.scaled(landmark).plus(&(delta - Vector3::new(across.x, across.y, along)))
    }

    /// The landmark after the factor alone.
    pub(super) fn scaled(&self, landmark: &Landmark) -> Landmark {
        let factor = self.ln.exp();
        Landmark {
            direction: landmark.direction,
            inverse_distance: (landmark.inverse_distance / factor).max(BEYOND_INFINITY),
            origin: self.centre + (landmark.origin - self.centre) * factor,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::imu::Bias;
    use vidar_core::{LieGroup, So3};

    fn state() -> NavState {
        NavState {
            world_from_body: Se3::new(So3::exp(&Vector3::new(0.1, -0.2, 0.3)), Vector3::new(2.0, -1.0, 0.5)),
            velocity: Vector3::new(0.3, 0.7, -0.2),
            bias: Bias::ZERO,
        }
    }

    fn landmark() -> Landmark {
        let direction = Vector3::new(0.2, -0.5, 0.9).normalize();
        Landmark { direction, inverse_distance: 0.25, origin: Vector3::new(1.5, -0.8, 0.4) }
    }

    fn point(landmark: &Landmark) -> Vector3<f64> {
        landmark.origin + landmark.direction / landmark.inverse_distance
    }

    /// Multiplied or added, a small step leads to the same, but for terms of second order.
    #[test]
    fn a_step_is_the_same_to_first_order() {
        let scale = |ln| ScaleStep { ln, centre: Vector3::new(0.5, 0.2, -0.1) };
        for size in [1e-3, 1e-4] {
            let delta = Vector15::from_fn(|k, _| size * (1.3 * k as f64 + 0.4).sin());
            let (plain, multiplied) = (state().plus(&delta), scale(2.0 * size).state(&state(), &delta));
            assert!(
                plain.minus(&multiplied).norm() < 20.0 * size * size,
                "{size}: {:?}",
                plain.minus(&multiplied)
            );
            let step = Vector3::new(0.7, -0.4, 0.2) * size;
            let (plain, multiplied) =
                (landmark().plus(&step), scale(2.0 * size).landmark(&landmark(), &step));
            let apart = (point(&plain) - point(&multiplied)).norm();
            assert!(apart < 200.0 * size * size, "{size}: {apart}");
        }
    }

    /// Where a step is nothing but a factor, images see no change, however large it is.
    #[test]
    fn a_pure_change_of_scale_keeps_all_directions() {
        let (ln, centre) = (0.4, Vector3::new(0.5, 0.2, -0.1));
        let scale = ScaleStep { ln, centre };
        let mut delta = Vector15::zeros();
        let from = state().world_from_body.translation - centre;
        delta.fixed_rows_mut::<3>(3).copy_from(&(from * ln));
        delta.fixed_rows_mut::<3>(6).copy_from(&(state().velocity * ln));
        let moved = point(&landmark()) - centre;
        let direction = landmark().direction;
        let across = tangent_basis(&direction).transpose() * moved * (ln * 0.25);
        let along = -direction.dot(&moved) * ln * 0.25 * 0.25;
        let (after, seen) = (
            scale.state(&state(), &delta),
            scale.landmark(&landmark(), &Vector3::new(across.x, across.y, along)),
        );
        let before = point(&landmark()) - state().world_from_body.translation;
        let now = point(&seen) - after.world_from_body.translation;
        assert!((now - before * ln.exp()).norm() < 1e-12, "{now} {before}");
        assert!((after.velocity - state().velocity * ln.exp()).norm() < 1e-12);
    }
}
