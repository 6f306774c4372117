//! A pair's translation up to its length, from the normals of its matches.
//!
//! Two rows that were exposed `Δ` after the centre rows of their images are `t + Δ (v_j − v_i)` apart, where `v` is the camera's
//! velocity at both: with a rolling shutter and a velocity that changes, the direction of translation depends on the row.

use crate::backend::tangent_basis;
use nalgebra::{Matrix3, Matrix3x2, Matrix4, Vector2, Vector3, Vector4};
use vidar_solve::Kernel;

/// Whitened residual from which a match loses weight (Cauchy).
pub(super) const CAUCHY: f64 = 2.0;
const KERNEL: Kernel = Kernel::Cauchy { k: CAUCHY };

/// Standard deviation of the change of the direction from the first to the last row. A lively hand's acceleration over its velocity is 3 per second, which
/// changes it by 0.06 within 20 ms: a readout of 21 ms in a corridor was found as 36 without it and as 24 with it. Wider ones found slow hands' readouts up to
/// 20 ms too long at 2.7 σ. Not in proportion to the readout that is estimated: a longer one would explain more of any noise.
const CHANGE_SIGMA: f64 = 0.06;

/// Direction of translation between centre rows, and its change from the first to the last row.
#[derive(Clone, Copy)]
pub(super) struct Translation {
    direction: Vector3<f64>,
    change: Vector3<f64>,
    /// Two directions at right angles to `direction`.
    tangents: Matrix3x2<f64>,
}

/// A match in common axes: the normal `a × b`, both rays, and the mean of their rows as a share of the height from the centre row.
#[derive(Clone, Copy)]
pub(super) struct Match {
    pub normal: Vector3<f64>,
    pub rays: [Vector3<f64>; 2],
    pub row: f64,
}

/// How far a match is from the epipolar constraint.
pub(super) struct Residual {
    /// Whitened: `normal · by_normal / sigma`.
    pub value: f64,
    pub weight: f64,
    /// Derivatives of `value` by the direction's two tangents and by those of its change.
    pub by_translation: Vector4<f64>,
    /// The translation at the match's row.
    pub by_normal: Vector3<f64>,
    pub sigma: f64,
}

impl Default for Translation {
    fn default() -> Self {
        Self::along(Vector3::z(), Vector3::zeros())
    }
}

impl Translation {
    /// One direction for all rows, as if they were the centre rows.
    pub fn of_centre_rows(seen: impl Iterator<Item = Match> + Clone, ray_sigma: f64) -> Self {
        Self::along(direction(seen, ray_sigma), Vector3::zeros())
    }

    /// That direction, then direction and change by a step of Gauss-Newton from the change `before`, which was found where the rays were nearly the same.
    pub fn of(seen: impl Iterator<Item = Match> + Clone, ray_sigma: f64, before: &Self) -> Self {
        let start = Self::along(direction(seen.clone(), ray_sigma), before.change);
        let (mut h, mut g) = start.prior();
        for m in seen {
            let r = start.residual(&m, ray_sigma);
            let j = r.by_translation;
            h += j * j.transpose() * r.weight;
            g -= j * (r.value * r.weight);
        }
        let Some(step) = h.cholesky().map(|c| c.solve(&g)) else { return start };
        let moved = start.direction + start.tangents * step.fixed_rows::<2>(0);
        Self::along(moved.normalize(), start.change + start.tangents * step.fixed_rows::<2>(2))
    }

    fn along(direction: Vector3<f64>, change: Vector3<f64>) -> Self {
        Self { direction, change, tangents: tangent_basis(&direction) }
    }

    /// Between rows at `row`, a share of the height from the centre row.
    pub fn at(&self, row: f64) -> Vector3<f64> {
        self.direction + self.change * row
    }

    /// Residual of a match.
    pub fn residual(&self, m: &Match, ray_sigma: f64) -> Residual {
        let t = self.at(m.row);
        let sigma = residual_sigma(m, &t, ray_sigma);
        let r = m.normal.dot(&t) / sigma;
        let by_direction: Vector2<f64> = self.tangents.tr_mul(&m.normal) / sigma;
        let by_change = by_direction * m.row;
        let by_translation = Vector4::new(by_direction.x, by_direction.y, by_change.x, by_change.y);
        Residual { value: r, weight: KERNEL.weight(r * r), by_translation, by_normal: t, sigma }
    }

    /// Normal equations of the derivatives of [`Translation::residual`] before any match. A pair without parallax says nothing of the
    /// direction: the unit information keeps that harmless.
    pub fn prior(&self) -> (Matrix4<f64>, Vector4<f64>) {
        let information = 1.0 / (CHANGE_SIGMA * CHANGE_SIGMA);
        let towards_zero = self.tangents.tr_mul(&self.change) * -information;
        let h = Matrix4::from_diagonal(&Vector4::new(1.0, 1.0, information, information));
        (h, Vector4::new(0.0, 0.0, towards_zero.x, towards_zero.y))
    }
}

/// Standard deviation of `(a × b) · t` for rays with independent errors.
fn residual_sigma(m: &Match, t: &Vector3<f64>, ray_sigma: f64) -> f64 {
    let [a, b] = m.rays;
    ray_sigma * (b.cross(t).norm_squared() + a.cross(t).norm_squared() + 1e-4).sqrt()
}

/// Direction of translation: the least eigenvector of Σ w n nᵀ, weighted anew three times.
fn direction(seen: impl Iterator<Item = Match> + Clone, ray_sigma: f64) -> Vector3<f64> {
    let mut t: Option<Vector3<f64>> = None;
    for _ in 0..3 {
        let mut sum = Matrix3::zeros();
        for m in seen.clone() {
            let weight = t.map_or(1.0, |t| {
                let sigma = residual_sigma(&m, &t, ray_sigma);
                let r = m.normal.dot(&t) / sigma;
                KERNEL.weight(r * r) / (sigma * sigma)
            });
            sum += m.normal * m.normal.transpose() * weight;
        }
        let eigen = sum.symmetric_eigen();
        t = Some(eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned());
    }
    t.unwrap_or_else(Vector3::z)
}
