//! Planes through the measured depth in and around untextured regions.
//!
//! A plane in space is linear in inverse depth over the image: ρ = a·x + b·y + c at the ray (x, y, 1). It is found by random
//! sampling (Fischler & Bolles 1981), fitted to its inliers by least squares, and accepted only if nearly all of what is
//! measured around the region lies on it; on a curved surface that fails.

use super::regions::Regions;
use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};
use vidar_core::Pinhole;

/// Least number of measured pixels.
const LEAST_ANCHORS: usize = 80;
/// Most of them that are used: a region's border says no more with a million.
const MOST_ANCHORS: usize = 1500;
/// Relative difference of an inlier, and least share of inliers; measured on recordings of RGB-D cameras.
const INLIER_RATIO: f64 = 0.03;
const LEAST_INLIERS: f64 = 0.7;
/// Largest Mahalanobis distance of a pixel from the inliers: a plane is not continued far beyond what it was fitted to.
const MOST_MAHALANOBIS: f64 = 3.0;
/// Samples of three. With 70 % inliers a third of the samples is right; 40 fail together once in 10⁷ times.
const SAMPLES: usize = 40;
/// Measured pixels of a region err together: so many of them say as much as all.
const INDEPENDENT_ANCHORS: f64 = 12.0;
/// Least stated standard deviation: what stereo's errors share (calibration, poses), half of its tolerance.
const SHARED_STD: f64 = 0.5 * crate::confidence::TOLERANCE_RATIO as f64;

/// The pixels that a plane fills: index, ln(depth), and its standard deviation as the fit has it.
pub(super) struct FilledPlane {
    pub pixels: Vec<(usize, f32, f32)>,
}

/// A measured pixel: its ray, and its inverse depth.
#[derive(Clone, Copy)]
struct Anchor {
    ray: Vector3<f64>,
    inverse_depth: f64,
}

impl Anchor {
    fn lies_on(&self, plane: &Vector3<f64>) -> bool {
        (plane.dot(&self.ray) / self.inverse_depth - 1.0).abs() < INLIER_RATIO
    }
}

/// Planes of all regions that have one, for the pixels without depth.
pub(super) fn fit_all(regions: &Regions, log_depth: &[f32], k: &Pinhole) -> Vec<FilledPlane> {
    let ray = |i: usize| {
        let (u, v) = ((i % regions.width) as f64, (i / regions.width) as f64);
        Vector3::new((u - k.cx) / k.fx, (v - k.cy) / k.fy, 1.0)
    };
    let fill = |members: &Vec<(u32, bool)>| {
        let empty: Vec<usize> = members
            .iter()
            .filter(|m| m.1 && log_depth[m.0 as usize].is_nan())
            .map(|m| m.0 as usize)
            .collect();
        if empty.is_empty() {
            return None;
        }
        let measured: Vec<usize> =
            members.iter().map(|m| m.0 as usize).filter(|i| log_depth[*i].is_finite()).collect();
        let stride = measured.len().div_ceil(MOST_ANCHORS).max(1);
        let anchor = |i: &usize| Anchor {
            ray: ray(*i),
            inverse_depth: f64::from(crate::elementary::exp(-log_depth[*i])),
        };
        let anchors: Vec<Anchor> = measured.iter().step_by(stride).map(anchor).collect();
        let plane = Plane::through(&anchors)?;
        let pixels: Vec<_> =
            empty.iter().filter_map(|i| plane.at(&ray(*i)).map(|(d, s)| (*i, d, s))).collect();
        Some(FilledPlane { pixels })
    };
    regions.members.iter().filter_map(fill).collect()
}

/// An accepted plane.
struct Plane {
    inverse_depth: Vector3<f64>,
    /// Root mean square of the inliers' relative errors.
    residual: f64,
    center: Vector2<f64>,
    information: Matrix2<f64>,
    /// Inverse depths beyond these are not continued to.
    bounds: [f64; 2],
}

impl Plane {
    fn through(anchors: &[Anchor]) -> Option<Self> {
        if anchors.len() < LEAST_ANCHORS {
            return None;
        }
        let mut random = Sequence(anchors.len() as u64);
        let mut best: Option<(usize, Vector3<f64>)> = None;
        for _ in 0..SAMPLES {
            let three = [(); 3].map(|()| anchors[random.below(anchors.len())]);
            let Some(plane) = fitted(three.iter()) else { continue };
            let inliers = anchors.iter().filter(|a| a.lies_on(&plane)).count();
            if best.is_none_or(|(most, _)| inliers > most) {
                best = Some((inliers, plane));
            }
        }
        let (_, mut plane) = best?;
        for _ in 0..2 {
            plane = fitted(anchors.iter().filter(|a| a.lies_on(&plane)))?;
        }
        let inliers: Vec<&Anchor> = anchors.iter().filter(|a| a.lies_on(&plane)).collect();
        if (inliers.len() as f64) < LEAST_INLIERS * anchors.len() as f64 || inliers.len() < LEAST_ANCHORS {
            return None;
        }
        let n = inliers.len() as f64;
        let error = |a: &&Anchor| plane.dot(&a.ray) / a.inverse_depth - 1.0;
        let center = inliers.iter().map(|a| a.ray.xy()).sum::<Vector2<f64>>() / n;
        let scatter = |a: &&Anchor| (a.ray.xy() - center) * (a.ray.xy() - center).transpose();
        let covariance = inliers.iter().map(scatter).sum::<Matrix2<f64>>() / n;
        let depths = || inliers.iter().map(|a| a.inverse_depth);
        let (low, high) = (depths().fold(f64::INFINITY, f64::min), depths().fold(0.0, f64::max));
        Some(Self {
            inverse_depth: plane,
            residual: (inliers.iter().map(|a| error(a).powi(2)).sum::<f64>() / n).sqrt(),
            center,
            information: covariance.try_inverse()?,
            bounds: [low / 2.0, high * 2.0],
        })
    }

    /// ln(depth) along a ray and its standard deviation; `None` too far from where the plane was measured.
    fn at(&self, ray: &Vector3<f64>) -> Option<(f32, f32)> {
        let off = ray.xy() - self.center;
        let squared = off.dot(&(self.information * off));
        let inverse_depth = self.inverse_depth.dot(ray);
        let is_near = squared <= MOST_MAHALANOBIS * MOST_MAHALANOBIS;
        if !is_near || !(self.bounds[0]..=self.bounds[1]).contains(&inverse_depth) {
            return None;
        }
        let log_depth = -crate::elementary::ln(inverse_depth as f32);
        // Of a plane of three parameters fitted to N points: σ²(1 + Mahalanobis²)/N.
        let fit = self.residual * self.residual * (1.0 + squared) / INDEPENDENT_ANCHORS;
        Some((log_depth, (fit + SHARED_STD * SHARED_STD).sqrt() as f32))
    }
}

/// Least squares of the relative error of inverse depth; `None` where the rays lie on a line.
fn fitted<'a>(anchors: impl Iterator<Item = &'a Anchor>) -> Option<Vector3<f64>> {
    let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
    for a in anchors {
        let row = a.ray / a.inverse_depth;
        normal += row * row.transpose();
        right += row;
    }
    let plane = normal.cholesky()?.solve(&right);
    plane.iter().all(|v| v.is_finite()).then_some(plane)
}

/// Knuth's linear congruence of 64 bits. Not `vidar_core::random`: other samples would find other planes, and published
/// depth was completed by these.
struct Sequence(u64);

impl Sequence {
    fn below(&mut self, end: usize) -> usize {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((self.0 >> 33) % end as u64) as usize
    }
}
