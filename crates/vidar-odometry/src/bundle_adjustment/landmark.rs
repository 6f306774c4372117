//! A landmark, and the bound of its inverse distance.

use crate::backend::bearing_plus;
use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};

/// Where a landmark has to be somewhere it is 10 km away at most, 1/m.
pub(super) const MIN_INVERSE_DISTANCE: f64 = 1e-4;

/// The inverse distance of what is far, seen from hardly apart, errs to both sides, and past infinity too. Held there, landmarks do not go along with
/// the states' step: of a phone that moved by 0.6 m in 23 s a step that promised 26 cost 190 000, and rounds ended by their limit.
pub(super) const BEYOND_INFINITY: f64 = -0.1;

/// A landmark this near to the bound is at it, 1/m: a change of scale moves it a little off.
const AT_THE_BOUND: f64 = 1e-3;

/// A landmark.
#[derive(Clone, Copy, Debug)]
pub(super) struct Landmark {
    /// Unit vector, world axes.
    pub(super) direction: Vector3<f64>,
    /// 1/m.
    pub(super) inverse_distance: f64,
    /// Where direction and distance are counted from, world, m. It is no unknown.
    pub(super) origin: Vector3<f64>,
}

impl Landmark {
    /// The landmark moved by a step: two coordinates of the direction's tangent plane, one of the inverse distance.
    pub(super) fn plus(&self, step: &Vector3<f64>) -> Self {
        let direction = bearing_plus(&self.direction, &Vector2::new(step.x, step.y));
        Self { direction, inverse_distance: (self.inverse_distance + step.z).max(BEYOND_INFINITY), ..*self }
    }

    /// For who wants a place, 1/m.
    pub(super) fn positive_inverse(&self) -> f64 {
        self.inverse_distance.max(MIN_INVERSE_DISTANCE)
    }

    /// Inverse of the block `own` of its normal equations; `gradient` is that of the cost. Where the inverse distance is at its bound and a lower one
    /// would fit better, the distance is no unknown: its row and column are zero (two-metric projection: Bertsekas 1982, "Projected Newton methods for
    /// optimization problems with simple constraints"). A step that counts on a distance that cannot change is no descent: of a corridor filmed through a
    /// stabiliser four such landmarks of 3000 had nearly every step rejected.
    pub(super) fn inverse_of(&self, own: &Matrix3<f64>, gradient: &Vector3<f64>) -> Option<Matrix3<f64>> {
        let is_held = self.inverse_distance < BEYOND_INFINITY + AT_THE_BOUND && gradient.z > 0.0;
        if !is_held {
            return own.try_inverse();
        }
        let mut inverse = Matrix3::zeros();
        let direction: Matrix2<f64> = own.fixed_view::<2, 2>(0, 0).into_owned();
        inverse.fixed_view_mut::<2, 2>(0, 0).copy_from(&direction.try_inverse()?);
        Some(inverse)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_distance_at_its_bound_is_an_unknown_only_where_it_would_come_nearer() {
        let own = Matrix3::new(5.0, 1.0, 2.0, 1.0, 4.0, -1.0, 2.0, -1.0, 3.0);
        let at = |inverse_distance| Landmark {
            direction: Vector3::z(),
            inverse_distance,
            origin: Vector3::zeros(),
        };
        let free = own.try_inverse().unwrap();
        let (farther, nearer) = (Vector3::new(1.0, -2.0, 0.5), Vector3::new(1.0, -2.0, -0.5));
        for landmark in [at(0.2), at(0.0), at(-0.05)] {
            assert_eq!(landmark.inverse_of(&own, &farther), Some(free));
        }
        // A change of scale by 0.1 % has moved it.
        for bound in [at(BEYOND_INFINITY), at(0.999 * BEYOND_INFINITY)] {
            assert_eq!(bound.inverse_of(&own, &nearer), Some(free));
            let held = bound.inverse_of(&own, &farther).unwrap();
            assert_eq!((held.row(2).norm(), held.column(2).norm()), (0.0, 0.0));
            let direction = own.fixed_view::<2, 2>(0, 0) * held.fixed_view::<2, 2>(0, 0);
            assert!((direction - Matrix2::identity()).norm() < 1e-12, "{direction}");
            // Its step is a descent, and moves nothing that cannot move.
            let step = -(held * farther);
            assert!(step.dot(&farther) < 0.0 && bound.plus(&step).inverse_distance == bound.inverse_distance);
        }
    }
}
