//! The evaluated points: finite, transformed, cropped, thinned.

use super::config::SurfaceEvalConfig;
use crate::error::EvalError;
use crate::nearest::NearestIndex;
use nalgebra::Vector3;
use rayon::prelude::*;
use vidar_core::{PointCloud, Sim3};

/// The finite points of `cloud`; fails when there is none.
pub(super) fn finite_positions(cloud: &PointCloud, which: &'static str) -> Result<Vec<[f32; 3]>, EvalError> {
    let points: Vec<[f32; 3]> =
        cloud.positions.iter().filter(|p| p.iter().all(|c| c.is_finite())).copied().collect();
    if points.is_empty() {
        return Err(EvalError::EmptyCloud { which, given: cloud.len() });
    }
    Ok(points)
}

/// The points in the other world frame.
pub(super) fn transformed(points: &[[f32; 3]], b_from_a: &Sim3) -> Vec<[f32; 3]> {
    if *b_from_a == Sim3::IDENTITY {
        return points.to_vec();
    }
    points.par_iter().map(moved(b_from_a)).collect()
}

/// The function that moves a point into the other world frame.
pub(super) fn moved(b_from_a: &Sim3) -> impl Fn(&[f32; 3]) -> [f32; 3] + Sync + Send + use<> {
    let (linear, offset) = (b_from_a.rotation.matrix() * b_from_a.scale, b_from_a.translation);
    move |p| {
        let moved: Vector3<f64> = linear * Vector3::from(*p).cast::<f64>() + offset;
        moved.cast::<f32>().into()
    }
}

/// The placed points that are evaluated, and how many were cropped.
pub(super) fn evaluated_points(
    mut placed: Vec<[f32; 3]>,
    reference: &NearestIndex,
    config: &SurfaceEvalConfig,
) -> Result<(Vec<[f32; 3]>, usize), EvalError> {
    let given = placed.len();
    if let (Some(margin_m), Some((min, max))) = (config.crop_margin_m, reference.bounds()) {
        let inside = |p: &[f32; 3]| {
            (0..3).all(|k| {
                let v = f64::from(p[k]);
                v >= f64::from(min[k]) - margin_m && v <= f64::from(max[k]) + margin_m
            })
        };
        placed.retain(inside);
        if placed.is_empty() {
            return Err(EvalError::NothingInBounds { margin_m });
        }
    }
    let cropped = given - placed.len();
    Ok((thinned(&placed, config.voxel_size_m)?, cropped))
}

/// One point per voxel, the mean of those in it, in the order of voxels; all points without a voxel size.
pub(super) fn thinned(points: &[[f32; 3]], voxel_m: Option<f64>) -> Result<Vec<[f32; 3]>, EvalError> {
    let Some(voxel_m) = voxel_m else { return Ok(points.to_vec()) };
    let mut min = [f64::INFINITY; 3];
    let mut max = [f64::NEG_INFINITY; 3];
    for p in points {
        for k in 0..3 {
            min[k] = min[k].min(f64::from(p[k]));
            max[k] = max[k].max(f64::from(p[k]));
        }
    }
    let extent_m = (0..3).map(|k| max[k] - min[k]).fold(0.0, f64::max);
    // 21 bits a side make a 63-bit key.
    if extent_m / voxel_m >= f64::from(1 << 21) || points.len() > u32::MAX as usize {
        return Err(EvalError::VoxelTooSmall { voxel_m, extent_m });
    }
    let mut keyed: Vec<(u64, u32)> = points
        .par_iter()
        .enumerate()
        .map(|(i, p)| {
            let cell = |k: usize| ((f64::from(p[k]) - min[k]) / voxel_m) as u64;
            (cell(0) << 42 | cell(1) << 21 | cell(2), i as u32)
        })
        .collect();
    keyed.par_sort_unstable();
    let mean = |group: &[(u64, u32)]| -> [f32; 3] {
        let sum: Vector3<f64> =
            group.iter().map(|&(_, i)| Vector3::from(points[i as usize]).cast::<f64>()).sum();
        (sum / group.len() as f64).cast::<f32>().into()
    };
    Ok(keyed.chunk_by(|a, b| a.0 == b.0).map(mean).collect())
}

/// At most `count` points, taken at even steps of the given order.
pub(super) fn subset(points: &[[f32; 3]], count: usize) -> Vec<[f32; 3]> {
    let n = points.len();
    if n <= count {
        return points.to_vec();
    }
    (0..count).map(|k| points[(k as u128 * n as u128 / count as u128) as usize]).collect()
}
