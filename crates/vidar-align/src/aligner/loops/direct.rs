//! A loop measured from what is stored of its two chunks, without asking the model again.
//!
//! The frames of the two sides are different, so there are no pixel pairs: each point of the later side is projected into
//! the nearest views of the earlier one, the sample it meets is its partner, and the distance that counts is the one along
//! the partner's normal. Four closed steps of that (projective data association, point-to-plane) are followed by a fit of
//! the similarity with everything doubted as in an overlap.

use super::{Aligner, LoopCandidate};
use crate::aligner::memory::View;
use crate::overlap::{OverlapFit, PointPairs, judge};
use nalgebra::{SMatrix, SVector, Vector3};
use vidar_core::{LieGroup, Sim3};

/// Associations, each followed by one robust step.
const ROUNDS: usize = 25;
/// Distances along the normal beyond this share of depth are no partners; shrinks as the fit settles.
const FIRST_REACH: f64 = 0.25;
const LAST_REACH: f64 = 0.06;
const MIN_PARTNERS: usize = 60;
/// How far the similarity may wander from a prediction that is no more than a look-alike, ln(scale).
const PRIOR_LOG_SCALE: f64 = 0.1;
const PATCH_SHARE: usize = 4;

/// The better of two descents: from where the chunks are thought to be, and from both frames being at one place.
pub(super) fn measure(
    machine: &Aligner,
    later: usize,
    earlier: usize,
    candidate: &LoopCandidate,
) -> Option<OverlapFit> {
    let side = |chunk: usize, window: &[vidar_core::FrameId]| -> Vec<&View> {
        let views = &machine.chunks[chunk].views;
        views.iter().filter(|v| window.contains(&v.frame_id)).collect()
    };
    let (source, target) = (side(later, &candidate.later_window), side(earlier, &candidate.earlier_window));
    let (a, b) = (&machine.chunks[later], &machine.chunks[earlier]);
    let (in_a, in_b) = (a.view(candidate.later_frame)?, b.view(candidate.earlier_frame)?);
    let known = match (a.first_guess, b.first_guess) {
        (Some(a), Some(b)) => Some(b.inverse() * a),
        _ => None,
    };
    let scale = known.map_or(in_b.median_depth / in_a.median_depth, |k| k.scale);
    let a_pose = Sim3::from_se3(&in_a.chunk_from_camera);
    let together =
        Sim3::from_se3(&in_b.chunk_from_camera) * Sim3 { scale, ..Sim3::IDENTITY } * a_pose.inverse();
    [Some(together), known]
        .into_iter()
        .flatten()
        .filter_map(|start| descend(&source, &target, start))
        .max_by(|x, y| x.inlier_ratio.total_cmp(&y.inlier_ratio))
}

fn descend(source: &[&View], target: &[&View], start: Sim3) -> Option<OverlapFit> {
    let mut fit = start;
    for round in 0..ROUNDS {
        let reach = FIRST_REACH * (LAST_REACH / FIRST_REACH).powf((round as f64 / 12.0).min(1.0));
        let partners = associate(source, target, &fit, reach);
        if partners.len() < MIN_PARTNERS {
            return None;
        }
        let step = solve(&partners, &fit, &start)?;
        fit = fit.plus(&step);
        if !fit.is_finite() {
            return None;
        }
        if round >= 12 && step.norm() < 1e-7 {
            break;
        }
    }
    evidence(source, target, &fit)
}

/// A source point and the surface it should lie on.
struct Partner {
    source: Vector3<f64>,
    point: Vector3<f64>,
    normal: Vector3<f64>,
    depth: f64,
}

fn associate(source: &[&View], target: &[&View], fit: &Sim3, reach: f64) -> Vec<Partner> {
    let mut partners = Vec::new();
    for view in source {
        for (x, _, _) in view.thin.points() {
            let moved = fit.act(&x);
            // What lies behind or before the surface by much belongs to something else.
            let Some((cell, in_view, z)) = meet(target, &moved, 0.5) else { continue };
            let Some(normal) = in_view.thin.normal(cell) else { continue };
            let point = in_view.thin.point(cell);
            if (moved - point).dot(&normal).abs() <= reach * z {
                partners.push(Partner { source: x, point, normal, depth: z });
            }
        }
    }
    partners
}

/// The target view that shows a point nearest to its own surface, up to `reach` (share of depth) from it.
fn meet<'a>(target: &[&'a View], moved: &Vector3<f64>, reach: f64) -> Option<(usize, &'a View, f64)> {
    let mut best: Option<(f64, usize, &View, f64)> = None;
    for view in target {
        let local = view.chunk_from_camera.inverse().act(moved);
        if !(local.z > 0.0) {
            continue;
        }
        let k = &view.thin.intrinsics;
        let (u, v) = (k.fx * local.x / local.z + k.cx, k.fy * local.y / local.z + k.cy);
        let Some((cell, z)) = view.thin.cell_at(u, v) else { continue };
        let apart = (local.z - z).abs() / z;
        if apart < reach && best.is_none_or(|b| apart < b.0) {
            best = Some((apart, cell, view, z));
        }
    }
    best.map(|(_, cell, view, z)| (cell, view, z))
}

/// One Gauss-Newton step of `Σ ρ(n · (S exp(δ) x − y) / z)`, held near `start` in scale by a weak prior.
fn solve(partners: &[Partner], fit: &Sim3, start: &Sim3) -> Option<SVector<f64, 7>> {
    let residual = |p: &Partner| (fit.act(&p.source) - p.point).dot(&p.normal) / p.depth;
    let mut sizes: Vec<f64> = partners.iter().map(|p| residual(p).abs()).collect();
    let middle = sizes.len() / 2;
    let width = 2.5 * 1.4826 * sizes.select_nth_unstable_by(middle, f64::total_cmp).1.max(1e-4);
    let mut information = SMatrix::<f64, 7, 7>::zeros();
    let mut gradient = SVector::<f64, 7>::zeros();
    for p in partners {
        let r = residual(p);
        let doubt = (width * width / (width * width + r * r)).powi(2) / (width * width);
        let j = fit.d_act_d_perturbation(&p.source).transpose() * (p.normal / p.depth);
        information += j * j.transpose() * doubt;
        gradient += j * (r * doubt);
    }
    let prior = 1.0 / (PRIOR_LOG_SCALE * PRIOR_LOG_SCALE);
    information[(6, 6)] += prior;
    gradient[6] += prior * (fit.scale / start.scale).ln();
    let damped = information + SMatrix::identity() * (information.diagonal().max() * 1e-9);
    damped.try_inverse().map(|inverse| -(inverse * gradient))
}

/// How well both sides agree. Every source point that falls into a target view counts, whether or not it found a partner;
/// and the same the other way round.
fn evidence(source: &[&View], target: &[&View], fit: &Sim3) -> Option<OverlapFit> {
    let agreeing = |from: &[&View], to: &[&View], by: &Sim3| {
        let (mut near, mut all) = (0usize, 0usize);
        let mut pairs = PointPairs::default();
        for view in from {
            for (x, zs, _) in view.thin.points() {
                let moved = by.act(&x);
                let Some((cell, in_view, z)) = meet(to, &moved, f64::INFINITY) else { continue };
                all += 1;
                let Some(normal) = in_view.thin.normal(cell) else { continue };
                let point = in_view.thin.point(cell);
                let off = (moved - point).dot(&normal);
                if off.abs() <= 0.05 * z {
                    near += 1;
                    // The foot on the partner's plane is the partner: along the surface nothing was measured.
                    pairs.push(x, moved - normal * off, zs, z, 1.0);
                }
            }
        }
        (near, all, pairs)
    };
    let (near, all, mut pairs) = agreeing(source, target, fit);
    let (near_back, all_back, _) = agreeing(target, source, &fit.inverse());
    // A tenth of the points must meet at all; else the two do not show the same place.
    let points: usize = source.iter().map(|v| v.thin.len()).sum();
    if pairs.len() < MIN_PARTNERS || all * 10 < points {
        return None;
    }
    let share = |near: usize, all: usize| near as f64 / all.max(1) as f64;
    pairs.independent = (pairs.len() / (PATCH_SHARE * source.len().max(1))).max(7);
    let mut fit = judge(&pairs, *fit);
    fit.inlier_ratio = share(near, all).min(share(near_back, all_back));
    fit.pairs = near;
    Some(fit)
}
