//! A loop measured from the stored samples of its two chunks, without another prediction.
//!
//! The frames of the two sides differ, so there are no pixel pairs. Each point of the later side is projected into the views
//! of the earlier side; the sample found there is its correspondence, and the residual is the distance along that sample's
//! normal (projective data association, point-to-plane ICP), as a share of depth. Each association is followed by one
//! Gauss-Newton step of the similarity with the Geman-McClure kernel.

use super::candidate::LoopCandidate;
use crate::aligner::chunk::View;
use crate::aligner::history::History;
use crate::overlap::{OverlapFit, PointPairs, evaluate_fit};
use nalgebra::{SMatrix, SVector, Vector3};
use vidar_core::{LieGroup, Sim3};
use vidar_solve::Kernel;
use vidar_solve::statistics::{STD_PER_MAD, median_upper};

/// Associations, each followed by one robust step.
const ROUNDS: usize = 25;
/// Distances along the normal beyond this share of depth are no correspondences; shrinks as the fit converges.
const FIRST_REACH: f64 = 0.25;
const LAST_REACH: f64 = 0.06;
const MIN_CORRESPONDENCES: usize = 60;
/// σ of ln(scale) about the start of the descent.
const PRIOR_LOG_SCALE: f64 = 0.1;
const PATCH_SHARE: usize = 4;

/// The better of two descents: from both frames at one place, and from the initial places of the chunks.
pub(super) fn measure(
    history: &History,
    later: usize,
    earlier: usize,
    candidate: &LoopCandidate,
) -> Option<OverlapFit> {
    let side = |chunk: usize, window: &[vidar_core::FrameId]| -> Vec<&View> {
        let views = &history.chunks[chunk].views;
        views.iter().filter(|v| window.contains(&v.frame_id)).collect()
    };
    let (source, target) = (side(later, &candidate.later_window), side(earlier, &candidate.earlier_window));
    let (a, b) = (&history.chunks[later], &history.chunks[earlier]);
    let (in_a, in_b) = (a.view(candidate.later_frame)?, b.view(candidate.earlier_frame)?);
    let initial = match (a.initial, b.initial) {
        (Some(a), Some(b)) => Some(b.inverse() * a),
        _ => None,
    };
    let scale = initial.map_or(in_b.median_depth / in_a.median_depth, |k| k.scale);
    let a_pose = Sim3::from_se3(&in_a.chunk_from_camera);
    let together =
        Sim3::from_se3(&in_b.chunk_from_camera) * Sim3 { scale, ..Sim3::IDENTITY } * a_pose.inverse();
    [Some(together), initial]
        .into_iter()
        .flatten()
        .filter_map(|start| descend(&source, &target, start))
        .max_by(|x, y| x.inlier_ratio.total_cmp(&y.inlier_ratio))
}

fn descend(source: &[&View], target: &[&View], start: Sim3) -> Option<OverlapFit> {
    let mut fit = start;
    for round in 0..ROUNDS {
        let reach = FIRST_REACH * (LAST_REACH / FIRST_REACH).powf((round as f64 / 12.0).min(1.0));
        let correspondences = associate(source, target, &fit, reach);
        if correspondences.len() < MIN_CORRESPONDENCES {
            return None;
        }
        let step = solve(&correspondences, &fit, &start)?;
        fit = fit.plus(&step);
        if !fit.is_finite() {
            return None;
        }
        if round >= 12 && step.norm() < 1e-7 {
            break;
        }
    }
    evaluate(source, target, &fit)
}

/// A source point and the surface it should lie on.
struct Correspondence {
    source: Vector3<f64>,
    point: Vector3<f64>,
    normal: Vector3<f64>,
    depth: f64,
}

fn associate(source: &[&View], target: &[&View], fit: &Sim3, reach: f64) -> Vec<Correspondence> {
    let mut correspondences = Vec::new();
    for view in source {
        for (x, _, _) in view.samples.points() {
            let moved = fit.act(&x);
            // A point far behind or before the surface belongs to another surface.
            let Some((cell, in_view, z)) = nearest_surface(target, &moved, 0.5) else { continue };
            let Some(normal) = in_view.samples.normal(cell) else { continue };
            let point = in_view.samples.point(cell);
            if (moved - point).dot(&normal).abs() <= reach * z {
                correspondences.push(Correspondence { source: x, point, normal, depth: z });
            }
        }
    }
    correspondences
}

/// The sample of the target views whose surface is nearest to a point along the ray, up to `reach` (share of depth) from it.
fn nearest_surface<'a>(
    target: &[&'a View],
    moved: &Vector3<f64>,
    reach: f64,
) -> Option<(usize, &'a View, f64)> {
    let mut best: Option<(f64, usize, &View, f64)> = None;
    for view in target {
        let local = view.chunk_from_camera.inverse().act(moved);
        if !(local.z > 0.0) {
            continue;
        }
        let k = &view.samples.intrinsics;
        let (u, v) = (k.fx * local.x / local.z + k.cx, k.fy * local.y / local.z + k.cy);
        let Some((cell, z)) = view.samples.cell_at(u, v) else { continue };
        let apart = (local.z - z).abs() / z;
        if apart < reach && best.is_none_or(|b| apart < b.0) {
            best = Some((apart, cell, view, z));
        }
    }
    best.map(|(_, cell, view, z)| (cell, view, z))
}

/// One Gauss-Newton step of `Σ ρ(n · (S exp(δ) x − y) / z)`, held near `start` in scale by a weak prior.
fn solve(correspondences: &[Correspondence], fit: &Sim3, start: &Sim3) -> Option<SVector<f64, 7>> {
    let residual = |p: &Correspondence| (fit.act(&p.source) - p.point).dot(&p.normal) / p.depth;
    let mut sizes: Vec<f64> = correspondences.iter().map(|p| residual(p).abs()).collect();
    let width = 2.5 * STD_PER_MAD * median_upper(&mut sizes)?.max(1e-4);
    let kernel = Kernel::GemanMcClure { k: width };
    let mut information = SMatrix::<f64, 7, 7>::zeros();
    let mut gradient = SVector::<f64, 7>::zeros();
    for p in correspondences {
        let r = residual(p);
        let weight = kernel.weight(r * r) / (width * width);
        let j = fit.d_act_d_perturbation(&p.source).transpose() * (p.normal / p.depth);
        information += j * j.transpose() * weight;
        gradient += j * (r * weight);
    }
    let prior = 1.0 / (PRIOR_LOG_SCALE * PRIOR_LOG_SCALE);
    information[(6, 6)] += prior;
    gradient[6] += prior * (fit.scale / start.scale).ln();
    let damped = information + SMatrix::identity() * (information.diagonal().max() * 1e-9);
    damped.try_inverse().map(|inverse| -(inverse * gradient))
}

/// The fit with its inlier ratio. Every source point that projects into a target view counts, with or without a
/// correspondence, and the same in the other direction.
fn evaluate(source: &[&View], target: &[&View], fit: &Sim3) -> Option<OverlapFit> {
    let agreeing = |from: &[&View], to: &[&View], by: &Sim3| {
        let (mut near, mut all) = (0usize, 0usize);
        let mut pairs = PointPairs::default();
        for view in from {
            for (x, zs, _) in view.samples.points() {
                let moved = by.act(&x);
                let Some((cell, in_view, z)) = nearest_surface(to, &moved, f64::INFINITY) else { continue };
                all += 1;
                let Some(normal) = in_view.samples.normal(cell) else { continue };
                let point = in_view.samples.point(cell);
                let off = (moved - point).dot(&normal);
                if off.abs() <= 0.05 * z {
                    near += 1;
                    // Paired with its foot on the tangent plane: along the surface nothing was measured.
                    pairs.push(x, moved - normal * off, zs, z, 1.0);
                }
            }
        }
        (near, all, pairs)
    };
    let (near, all, mut pairs) = agreeing(source, target, fit);
    let (near_back, all_back, _) = agreeing(target, source, &fit.inverse());
    // A tenth of the points must project into the other side; else the two do not show the same place.
    let points: usize = source.iter().map(|v| v.samples.len()).sum();
    if pairs.len() < MIN_CORRESPONDENCES || all * 10 < points {
        return None;
    }
    let share = |near: usize, all: usize| near as f64 / all.max(1) as f64;
    pairs.independent = (pairs.len() / (PATCH_SHARE * source.len().max(1))).max(7);
    let mut fit = evaluate_fit(&pairs, *fit);
    fit.inlier_ratio = share(near, all).min(share(near_back, all_back));
    fit.pairs = near;
    Some(fit)
}
