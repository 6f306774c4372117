//! Velocity, gravity and accelerometer bias from one linear system.
//!
//! In the first body's frame the camera of view k is at `c_k = v t_k + ½ g t_k² + Δp_k + J_k b_a + R_k p_bc`, and a point X
//! seen along the unit ray `u` fulfils `(I − u uᵀ)(X − c_k) = 0`. Points are eliminated one by one; of v, g, b_a the length
//! of g is known (Dong-Si & Mourikis, "Estimator initialization in vision-aided inertial navigation", IROS 2012).

use nalgebra::{Matrix3, SMatrix, SVector, Vector3};
use vidar_solve::statistics::median_upper;

/// A view as the linear system needs it, in the first body's frame.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LinearView {
    /// Time after the first view, s.
    pub(crate) secs: f64,
    /// Camera's place from IMU measurements alone: `Δp + R p_bc`.
    pub(crate) offset: Vector3<f64>,
    /// Derivative of `Δp` by the accelerometer bias.
    pub(crate) by_accel_bias: Matrix3<f64>,
}

/// Rays of one point: view and unit direction in the first body's axes.
pub(crate) type Rays = Vec<(usize, Vector3<f64>)>;

/// The solution, in the first body's frame.
#[derive(Clone, Debug)]
pub(crate) struct LinearSolution {
    pub(crate) velocity: Vector3<f64>,
    pub(crate) gravity: Vector3<f64>,
    pub(crate) accel_bias: Vector3<f64>,
    /// Points; `None` where the rays do not meet.
    pub(crate) points: Vec<Option<Vector3<f64>>>,
}

impl LinearSolution {
    /// The same with path and scene `scale` times as large; gravity stays.
    pub(crate) fn scaled(&self, scale: f64) -> Self {
        let points = self.points.iter().map(|p| p.map(|p| p * scale)).collect();
        Self { velocity: self.velocity * scale, points, ..self.clone() }
    }
}

/// Rounds of reweighting by distance and residual.
const ROUNDS: usize = 4;

type Matrix9 = SMatrix<f64, 9, 9>;
type Vector9 = SVector<f64, 9>;
type By = SMatrix<f64, 3, 9>;

/// Solves for motion and points. `ray_sigma_rad` is the noise of rays, `accel_bias_sigma` that of the bias about zero,
/// `gravity_mps2` the strength of gravity.
pub(crate) fn solve(
    views: &[LinearView],
    tracks: &[Rays],
    ray_sigma_rad: f64,
    accel_bias_sigma: f64,
    gravity_mps2: f64,
) -> Option<LinearSolution> {
    let mut weights: Vec<Vec<f64>> = tracks.iter().map(|rays| vec![1.0; rays.len()]).collect();
    let mut best = None;
    for _ in 0..ROUNDS {
        let motion = solve_motion(views, tracks, &weights, ray_sigma_rad, accel_bias_sigma, gravity_mps2)?;
        let points: Vec<_> =
            tracks.iter().zip(&weights).map(|(rays, w)| point(views, rays, w, &motion)).collect();
        reweight(views, tracks, &points, &motion, ray_sigma_rad, &mut weights);
        best = Some(LinearSolution {
            velocity: motion.fixed_rows::<3>(0).into_owned(),
            gravity: motion.fixed_rows::<3>(3).into_owned(),
            accel_bias: motion.fixed_rows::<3>(6).into_owned(),
            points,
        });
    }
    best
}

/// Derivative of a camera's place by velocity, gravity and bias.
fn by_motion(view: &LinearView) -> By {
    let mut by = By::zeros();
    by.fixed_view_mut::<3, 3>(0, 0).copy_from(&(Matrix3::identity() * view.secs));
    by.fixed_view_mut::<3, 3>(0, 3).copy_from(&(Matrix3::identity() * (0.5 * view.secs * view.secs)));
    by.fixed_view_mut::<3, 3>(0, 6).copy_from(&view.by_accel_bias);
    by
}

fn across(ray: &Vector3<f64>) -> Matrix3<f64> {
    Matrix3::identity() - ray * ray.transpose()
}

fn solve_motion(
    views: &[LinearView],
    tracks: &[Rays],
    weights: &[Vec<f64>],
    ray_sigma_rad: f64,
    accel_bias_sigma: f64,
    gravity_mps2: f64,
) -> Option<Vector9> {
    let (mut n, mut d) = (Matrix9::zeros(), Vector9::zeros());
    for (rays, weights) in tracks.iter().zip(weights) {
        let (mut pp, mut px, mut pr) = (Matrix3::zeros(), By::zeros(), Vector3::zeros());
        let (mut xx, mut xr) = (Matrix9::zeros(), Vector9::zeros());
        for ((view, ray), w) in rays.iter().zip(weights) {
            let view = &views[*view];
            let p = across(ray) * (w / (ray_sigma_rad * ray_sigma_rad));
            let by = by_motion(view);
            pp += p;
            px -= p * by;
            pr += p * view.offset;
            xx += by.transpose() * p * by;
            xr -= by.transpose() * p * view.offset;
        }
        // Rays that are nearly parallel leave the point's distance open; the floor keeps the inverse finite.
        let floor = 1e-9 * pp.trace();
        let Some(inverse) = (pp + Matrix3::identity() * floor).try_inverse() else { continue };
        n += xx - px.transpose() * inverse * px;
        d += xr - px.transpose() * inverse * pr;
    }
    for k in 6..9 {
        n[(k, k)] += 1.0 / (accel_bias_sigma * accel_bias_sigma);
    }
    with_gravity_length(&n, &d, gravity_mps2)
}

/// Minimises `xᵀ N x − 2 dᵀ x` with |x₃…₅| = g: velocity and bias eliminated, then the secular equation for gravity.
fn with_gravity_length(n: &Matrix9, d: &Vector9, strength: f64) -> Option<Vector9> {
    let keep = [0, 1, 2, 6, 7, 8];
    let rest = SMatrix::<f64, 6, 6>::from_fn(|i, j| n[(keep[i], keep[j])]);
    let cross = SMatrix::<f64, 6, 3>::from_fn(|i, j| n[(keep[i], 3 + j)]);
    let rest_d = SVector::<f64, 6>::from_fn(|i, _| d[keep[i]]);
    let mut regular = rest;
    for k in 0..6 {
        regular[(k, k)] += 1e-9 * rest.trace();
    }
    let factor = regular.cholesky()?;
    let s = n.fixed_view::<3, 3>(3, 3) - cross.transpose() * factor.solve(&cross);
    let b = d.fixed_rows::<3>(3) - cross.transpose() * factor.solve(&rest_d);
    let eigen = ((s + s.transpose()) * 0.5).symmetric_eigen();
    let along = eigen.eigenvectors.transpose() * b;
    let length = |lambda: f64| {
        (0..3).map(|k| (along[k] / (eigen.eigenvalues[k] + lambda)).powi(2)).sum::<f64>().sqrt()
    };
    // The global minimum has the only root above −λ_min, where the length falls from infinity to zero.
    let lowest = -eigen.eigenvalues.min();
    let spread = eigen.eigenvalues.max().abs().max(along.norm() / strength).max(1e-12);
    let (mut low, mut high) = (lowest, lowest + spread);
    for _ in 0..200 {
        if length(high) < strength {
            break;
        }
        high = lowest + (high - lowest) * 2.0;
    }
    for _ in 0..200 {
        let middle = 0.5 * (low + high);
        if length(middle) > strength { low = middle } else { high = middle }
    }
    let lambda = 0.5 * (low + high);
    let scaled = Vector3::from_fn(|k, _| along[k] / (eigen.eigenvalues[k] + lambda));
    let gravity = (eigen.eigenvectors * scaled).try_normalize(1e-9)? * strength;
    let others = factor.solve(&(rest_d - cross * gravity));
    let mut x = Vector9::zeros();
    for (k, &at) in keep.iter().enumerate() {
        x[at] = others[k];
    }
    x.fixed_rows_mut::<3>(3).copy_from(&gravity);
    x.iter().all(|v| v.is_finite()).then_some(x)
}

fn place(view: &LinearView, motion: &Vector9) -> Vector3<f64> {
    view.offset + by_motion(view) * motion
}

/// The point nearest to all rays of a track, before all cameras.
fn point(views: &[LinearView], rays: &Rays, weights: &[f64], motion: &Vector9) -> Option<Vector3<f64>> {
    let (mut pp, mut pr) = (Matrix3::zeros(), Vector3::zeros());
    for ((view, ray), w) in rays.iter().zip(weights) {
        let p = across(ray) * *w;
        pp += p;
        pr += p * place(&views[*view], motion);
    }
    let point = pp.try_inverse()? * pr;
    let ahead = rays.iter().all(|(view, ray)| (point - place(&views[*view], motion)).dot(ray) > 0.0);
    (ahead && point.iter().all(|v| v.is_finite())).then_some(point)
}

/// Weights 1/distance² make the residual an angle; rays that miss their point by many sigmas lose weight.
fn reweight(
    views: &[LinearView],
    tracks: &[Rays],
    points: &[Option<Vector3<f64>>],
    motion: &Vector9,
    ray_sigma_rad: f64,
    weights: &mut [Vec<f64>],
) {
    let typical = median_distance(views, tracks, points, motion).unwrap_or(1.0);
    for ((rays, point), weights) in tracks.iter().zip(points).zip(weights) {
        for ((view, ray), w) in rays.iter().zip(weights) {
            let Some(point) = point else {
                // Behind a camera: for now as far as the others, with little say.
                *w = 0.1 / (typical * typical);
                continue;
            };
            let to = point - place(&views[*view], motion);
            let distance = to.norm().max(0.05 * typical);
            let residual = (across(ray) * to).norm() / distance;
            // The rotation is only approximate in the linear stage: residuals up to ten sigmas keep their full weight.
            let robust = (10.0 * ray_sigma_rad / residual.max(1e-12)).min(1.0);
            *w = robust / (distance * distance);
        }
    }
}

fn median_distance(
    views: &[LinearView],
    tracks: &[Rays],
    points: &[Option<Vector3<f64>>],
    motion: &Vector9,
) -> Option<f64> {
    let mut all: Vec<f64> = tracks
        .iter()
        .zip(points)
        .filter_map(|(rays, p)| Some(((*p)? - place(&views[rays.first()?.0], motion)).norm()))
        .collect();
    median_upper(&mut all).filter(|m| *m > 0.0)
}
