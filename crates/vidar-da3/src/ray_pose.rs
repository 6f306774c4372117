//! Cameras from the ray map (DA3, ray branch): a homography per view, taken apart into orientation and intrinsics.
//!
//! The head writes, for each cell of a grid, the direction d and origin of its ray in the world and a confidence w.
//! With cell positions x on an image of size 2 × 2 about the origin, `d ~ H x`, so H is fitted by weighted RANSAC over
//! direct linear transforms and split as `H = R L` with R orthonormal (`world_from_camera`) and L lower triangular: its
//! diagonal holds the inverse focal lengths, its last row the principal point. The camera centre is the weighted mean
//! of the ray origins. Samples come from a fixed seed; the official code's are unseeded.

use crate::error::Da3Error;
use crate::pose::{compose, rigid_inverse};
use nalgebra::{Matrix3, Matrix4, SMatrix, SVector, Vector3};
use rayon::prelude::*;
use vidar_solve::pcg64::Pcg64;

/// Rays of one view on a grid of `rows` × `columns`.
#[derive(Clone, Debug, PartialEq)]
pub struct RayMap {
    /// Rows of the grid, 8 for each patch row.
    pub rows: usize,
    /// Columns of the grid.
    pub columns: usize,
    /// Direction (3) and origin (3) of each cell's ray in the world of the prediction, row-major.
    pub rays: Vec<[f32; 6]>,
    /// Confidence of each cell, at least 1.
    pub confidence: Vec<f32>,
}

/// A camera read from a ray map.
#[derive(Clone, Debug, PartialEq)]
pub struct RayCamera {
    /// Its pose.
    pub camera_from_world: Matrix4<f64>,
    /// Focal lengths x and y in halves of the image's sides.
    pub focal: [f64; 2],
    /// Principal point on an image of 2 × 2 with its origin at the top-left edge.
    pub principal_point: [f64; 2],
}

impl RayCamera {
    /// Intrinsics of an image of `width` × `height`, origin at the edge of the top-left pixel.
    pub fn intrinsics(&self, width: usize, height: usize) -> Matrix3<f64> {
        let (half_width, half_height) = (width as f64 / 2.0, height as f64 / 2.0);
        let [fx, fy] = self.focal;
        let [px, py] = self.principal_point;
        Matrix3::new(
            fx * half_width,
            0.0,
            px * half_width,
            0.0,
            fy * half_height,
            py * half_height,
            0.0,
            0.0,
            1.0,
        )
    }
}

const ROUNDS: usize = 100;
const SAMPLE: usize = 8;
/// Samples are drawn from this share of the points, the most confident ones.
const SAMPLED_SHARE: f64 = 0.3;
/// Largest distance of an inlier, in tangents.
const INLIER_DISTANCE: f64 = 0.2;
/// Directions with a smaller |z| have no place on the tangent plane.
const MIN_Z: f64 = 1e-4;
/// More inliers than this are thinned before the last fit.
const MAX_REFIT: usize = 8000;
const REFIT_SHARE: f64 = 0.95;
const SEED: u32 = 42;

/// The sample table for a grid of `cells`: rows of eight ranks among the most confident points, shared by all views.
pub fn sample_table(cells: usize) -> Vec<[usize; SAMPLE]> {
    let from = SAMPLE.max((SAMPLED_SHARE * cells as f64) as usize).min(cells);
    let mut generator = Pcg64::seed(SEED);
    (0..ROUNDS)
        .map(|_| {
            let drawn = generator.choose(from, SAMPLE);
            std::array::from_fn(|i| drawn.get(i).copied().unwrap_or(0))
        })
        .collect()
}

/// One cell: its position in the image, where its ray meets the plane z = 1, its weight.
#[derive(Clone, Copy)]
struct Point {
    x: f64,
    y: f64,
    u: f64,
    v: f64,
    weight: f64,
}

/// The camera of a view; `samples` is [`sample_table`]'s.
pub fn camera_from_rays(map: &RayMap, samples: &[[usize; SAMPLE]]) -> Result<RayCamera, Da3Error> {
    let points = points(map)?;
    let mut by_weight: Vec<usize> = (0..points.len()).collect();
    by_weight.sort_by(|&a, &b| points[b].weight.total_cmp(&points[a].weight));
    let scores: Vec<f64> = samples
        .par_iter()
        .map(|ranks| {
            let sample = ranks.map(|rank| points[by_weight[rank.min(points.len() - 1)]]);
            fit_homography(&sample)
                .map_or(-1.0, |h| points.iter().filter(|p| is_inlier(&h, p)).map(|p| p.weight).sum())
        })
        .collect();
    let best = (0..scores.len()).fold(0, |best, i| if scores[i] > scores[best] { i } else { best });
    let lost = |reason: &str| Da3Error::Degenerate { step: "camera from rays", reason: reason.into() };
    let ranks = samples.get(best).ok_or_else(|| lost("no samples"))?;
    let sample = ranks.map(|rank| points[by_weight[rank.min(points.len() - 1)]]);
    let first = fit_homography(&sample).ok_or_else(|| lost("no sample fixes a homography"))?;
    let inliers: Vec<Point> = points.iter().filter(|p| is_inlier(&first, p)).copied().collect();
    let homography = fit_homography(&thin(inliers)).ok_or_else(|| lost("the inliers fix no homography"))?;
    let (rotation, lower) = split(&homography).ok_or_else(|| lost("the homography is singular"))?;
    let weight: f64 = points.iter().map(|p| p.weight).sum();
    let mut position = Vector3::zeros();
    for (ray, point) in map.rays.iter().zip(&points) {
        position += Vector3::new(ray[3], ray[4], ray[5]).cast::<f64>() * (point.weight / weight);
    }
    Ok(RayCamera {
        camera_from_world: rigid_inverse(&compose(&rotation, &position)),
        focal: [1.0 / lower[(0, 0)], 1.0 / lower[(1, 1)]],
        principal_point: [lower[(2, 0)] + 1.0, lower[(2, 1)] + 1.0],
    })
}

fn points(map: &RayMap) -> Result<Vec<Point>, Da3Error> {
    let cells = map.rows * map.columns;
    if cells < SAMPLE || map.rays.len() != cells || map.confidence.len() != cells {
        let reason = format!("{}x{} cells with {} rays", map.columns, map.rows, map.rays.len());
        return Err(Da3Error::BadInput { what: "ray map", reason });
    }
    let step = |i: usize, n: usize| (2 * i + 1) as f64 / n as f64 - 1.0;
    let point = |i: usize| {
        let [dx, dy, dz] = [0, 1, 2].map(|c| f64::from(map.rays[i][c]));
        let is_ahead = dz.abs() > MIN_Z;
        let divisor = if is_ahead { dz } else { 1.0 };
        Point {
            x: step(i % map.columns, map.columns),
            y: step(i / map.columns, map.rows),
            u: dx / divisor,
            v: dy / divisor,
            weight: if is_ahead { f64::from(map.confidence[i]) } else { 0.0 },
        }
    };
    let points: Vec<Point> = (0..cells).map(point).collect();
    if !points.iter().all(|p| p.u.is_finite() && p.v.is_finite() && p.weight.is_finite()) {
        return Err(Da3Error::Degenerate { step: "camera from rays", reason: "a ray is not finite".into() });
    }
    if !points.iter().any(|p| p.weight > 0.0) {
        let reason = "every ray is parallel to the picture".into();
        return Err(Da3Error::Degenerate { step: "camera from rays", reason });
    }
    Ok(points)
}

fn is_inlier(h: &Matrix3<f64>, p: &Point) -> bool {
    let q = h * Vector3::new(p.x, p.y, 1.0);
    (q.x / q.z - p.u).hypot(q.y / q.z - p.v) < INLIER_DISTANCE
}

/// The weighted direct linear transform: the eigenvector of `AᵀA` (9 × 9) with the least eigenvalue, over `H₃₃`.
fn fit_homography(points: &[Point]) -> Option<Matrix3<f64>> {
    let mut normal = SMatrix::<f64, 9, 9>::zeros();
    for p in points {
        let rows = [
            [-p.x, -p.y, -1.0, 0.0, 0.0, 0.0, p.x * p.u, p.y * p.u, p.u],
            [0.0, 0.0, 0.0, -p.x, -p.y, -1.0, p.x * p.v, p.y * p.v, p.v],
        ];
        for row in rows.map(SVector::<f64, 9>::from) {
            normal.ger(p.weight, &row, &row, 1.0);
        }
    }
    let eigen = normal.symmetric_eigen();
    let least = eigen.eigenvalues.imin();
    let h = eigen.eigenvectors.column(least);
    let matrix = Matrix3::new(h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], h[8]) / h[8];
    matrix.iter().all(|v| v.is_finite()).then_some(matrix)
}

/// Thins many inliers: the most confident 95 %, and 8000 of those at random.
fn thin(mut inliers: Vec<Point>) -> Vec<Point> {
    if inliers.len() <= MAX_REFIT {
        return inliers;
    }
    inliers.sort_by(|a, b| b.weight.total_cmp(&a.weight));
    let keep = MAX_REFIT.max((inliers.len() as f64 * REFIT_SHARE) as usize);
    let mut chosen = Pcg64::seed(SEED).choose(keep, MAX_REFIT);
    // In a fixed order of summation.
    chosen.sort_unstable();
    chosen.into_iter().map(|i| inliers[i]).collect()
}

/// `H = R L` with R orthonormal and L lower triangular with positive diagonal and `L₃₃ = 1`.
///
/// The QR decomposition of H with its columns reversed; reversing back turns the upper triangle into a lower one.
pub fn split(homography: &Matrix3<f64>) -> Option<(Matrix3<f64>, Matrix3<f64>)> {
    let h = if homography.determinant() < 0.0 { -homography } else { *homography };
    let reversal = Matrix3::new(0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0);
    let qr = (h * reversal).qr();
    let (mut rotation, mut lower) = (qr.q() * reversal, reversal * qr.r() * reversal);
    for i in 0..3 {
        if lower[(i, i)] < 0.0 {
            rotation.column_mut(i).neg_mut();
            lower.row_mut(i).neg_mut();
        }
    }
    let scale = lower[(2, 2)];
    let is_regular = (0..3).all(|i| lower[(i, i)] > 0.0) && scale.is_finite();
    is_regular.then(|| (rotation, lower / scale))
}
