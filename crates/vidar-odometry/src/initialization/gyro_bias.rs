//! Gyroscope bias from images alone.
//!
//! Rays `f_i`, `f_j` of one point in two views with relative rotation R span epipolar planes with normals
//! `n = f_i × R f_j` that are all orthogonal to the translation: the smallest eigenvalue of `Σ n nᵀ` vanishes for the right
//! rotation, whatever the translation, also for none (Kneip & Lynen, "Direct optimization of frame-to-frame rotation",
//! ICCV 2013). The rotations of all pairs hang on one bias.

use crate::imu::Bias;
use nalgebra::{Matrix3, Vector3};
use std::convert::Infallible;
use vidar_core::So3;
use vidar_solve::levenberg_marquardt::{self, Decrease, Increase, LeastSquares, Limits, Schedule, Trial};
use vidar_solve::statistics::median_upper;

/// Rays of common points in two views, with the rotation between the views as a function of the bias.
pub(crate) struct RayPair<F: Fn(&Bias) -> So3> {
    /// Unit rays in the cameras of both views.
    pub(crate) rays: Vec<(Vector3<f64>, Vector3<f64>)>,
    /// Rotation first_from_second between the cameras.
    pub(crate) rotation: F,
}

/// Steps of Newton's method, damped.
const LIMITS: Limits = Limits { trials: 12, ..Limits::NONE };
const SCHEDULE: Schedule = Schedule {
    first: 1e-3,
    least: 0.0,
    on_accepted: Decrease::Factor(0.2),
    on_rejected: Increase { least: 1e-3, ..Increase::by(10.0) },
    // Far from the solution the second derivatives need not be positive definite.
    on_unsolvable: Some(Increase { least: 1.0, ..Increase::by(10.0) }),
};

/// Step of the numeric derivatives, rad/s.
const H: f64 = 1e-4;

/// Farthest that the bias is looked for from the start, rad/s.
const REACH: f64 = 0.5;

/// Rays whose normal leaves the epipolar plane by more than this many medians are left out of the next round.
const OUTLIER_MEDIANS: f64 = 3.0;

/// Rounds of minimising and choosing rays.
const ROUNDS: usize = 4;

/// The bias that makes all pairs' epipolar planes agree best, from `start`. Every round uses the rays that fit the
/// solution of the round before.
pub(crate) fn gyro_bias<F: Fn(&Bias) -> So3 + Copy>(
    pairs: &[RayPair<F>],
    start: Vector3<f64>,
) -> Vector3<f64> {
    let mut found = minimise(pairs, start);
    for _ in 1..ROUNDS {
        let bias = Bias { gyro: found, accel: Vector3::zeros() };
        let kept: Vec<RayPair<F>> = pairs.iter().map(|p| fitting(p, &bias)).collect();
        found = minimise(&kept, found);
    }
    found
}

fn fitting<F: Fn(&Bias) -> So3 + Copy>(pair: &RayPair<F>, bias: &Bias) -> RayPair<F> {
    let rotation = (pair.rotation)(bias).matrix();
    let eigen = scatter(&pair.rays, &rotation).symmetric_eigen();
    let along = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned();
    let residual = |(a, b): &(Vector3<f64>, Vector3<f64>)| a.cross(&(rotation * b)).dot(&along).abs();
    let mut all: Vec<f64> = pair.rays.iter().map(residual).collect();
    let limit = OUTLIER_MEDIANS * median_upper(&mut all).unwrap_or(0.0);
    let rays = pair.rays.iter().filter(|r| residual(r) <= limit).copied().collect();
    RayPair { rays, rotation: pair.rotation }
}

fn minimise<F: Fn(&Bias) -> So3>(pairs: &[RayPair<F>], start: Vector3<f64>) -> Vector3<f64> {
    let cost = |gyro: &Vector3<f64>| -> f64 {
        let bias = Bias { gyro: *gyro, accel: Vector3::zeros() };
        pairs.iter().map(|p| smallest_eigenvalue(&p.rays, &(p.rotation)(&bias).matrix())).sum()
    };
    let (derivatives, value) = ((Vector3::zeros(), Matrix3::zeros()), cost(&start));
    let mut search = Search { cost, start, at: start, derivatives, step: 0.0 };
    let Ok(_) = levenberg_marquardt::minimise(&mut search, value, &SCHEDULE, &LIMITS);
    search.at
}

/// Newton's method from `start`.
struct Search<C> {
    cost: C,
    start: Vector3<f64>,
    at: Vector3<f64>,
    /// Gradient and second derivatives there.
    derivatives: (Vector3<f64>, Matrix3<f64>),
    /// Length of the last step, rad/s.
    step: f64,
}

impl<C: Fn(&Vector3<f64>) -> f64> LeastSquares for Search<C> {
    type Error = Infallible;
    /// The step.
    type Values = Vector3<f64>;

    fn linearise(&mut self, value: f64) -> Result<f64, Infallible> {
        self.derivatives = derivatives(&self.cost, &self.at, value);
        Ok(value)
    }

    fn try_step(&mut self, damping: f64) -> Result<Option<(f64, Vector3<f64>)>, Infallible> {
        let (gradient, hessian) = &self.derivatives;
        let mut damped = *hessian;
        for k in 0..3 {
            damped[(k, k)] += damping * hessian[(k, k)].abs() + 1e-12;
        }
        let Some(step) = damped.cholesky().map(|c| c.solve(&-gradient)) else { return Ok(None) };
        let next = self.at + step;
        let is_near = (next - self.start).norm() < REACH;
        Ok(Some((if is_near { (self.cost)(&next) } else { f64::INFINITY }, step)))
    }

    fn accept(&mut self, step: Vector3<f64>) {
        self.at += step;
        self.step = step.norm();
    }

    fn has_converged(&mut self, trial: &Trial) -> bool {
        trial.is_accepted && self.step < 1e-6
    }
}

fn smallest_eigenvalue(rays: &[(Vector3<f64>, Vector3<f64>)], rotation: &Matrix3<f64>) -> f64 {
    scatter(rays, rotation).symmetric_eigenvalues().min()
}

/// `Σ n nᵀ` of the epipolar planes' normals.
fn scatter(rays: &[(Vector3<f64>, Vector3<f64>)], rotation: &Matrix3<f64>) -> Matrix3<f64> {
    let mut m = Matrix3::zeros();
    for (a, b) in rays {
        let n = a.cross(&(rotation * b));
        m += n * n.transpose();
    }
    m
}

fn derivatives(
    cost: &impl Fn(&Vector3<f64>) -> f64,
    at: &Vector3<f64>,
    value: f64,
) -> (Vector3<f64>, Matrix3<f64>) {
    let unit = |k: usize| Vector3::ith(k, H);
    let (mut gradient, mut hessian) = (Vector3::zeros(), Matrix3::zeros());
    for k in 0..3 {
        let (plus, minus) = (cost(&(at + unit(k))), cost(&(at - unit(k))));
        gradient[k] = (plus - minus) / (2.0 * H);
        hessian[(k, k)] = (plus - 2.0 * value + minus) / (H * H);
        for j in 0..k {
            let (a, b) = (unit(k) + unit(j), unit(k) - unit(j));
            let mixed =
                (cost(&(at + a)) - cost(&(at + b)) - cost(&(at - b)) + cost(&(at - a))) / (4.0 * H * H);
            hessian[(k, j)] = mixed;
            hessian[(j, k)] = mixed;
        }
    }
    (gradient, hessian)
}
