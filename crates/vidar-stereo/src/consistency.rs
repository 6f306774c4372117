//! Geometric consistency of the views' depths (Schönberger 2016, section 4.3).
//!
//! A pixel is projected into a neighbour with its depth, and the neighbour's depth there is projected back. The two agree
//! if this forward-backward reprojection error is small and the depths are similar. The inverse depths of agreeing
//! views are averaged, which reduces noise.

use crate::chunk::ViewDepth;
use crate::config::StereoConfig;
use crate::warp::{Warp, neighbour_from_reference};
use rayon::prelude::*;

/// Largest forward-backward reprojection error, working pixels.
const REPROJECTION_LIMIT_PX: f32 = 1.5;

/// Agreement of the views at a pixel.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Support {
    /// Inverse depth averaged over the views that agree, 1/m; NaN where the view itself has none.
    pub rho: f32,
    /// Views that agree.
    pub agreeing: u8,
    /// Views that have a depth at the point: agreeing, disagreeing, or occluded by a nearer surface.
    pub compared: u8,
    /// Root mean square of the relative differences of those that agree.
    pub rms_difference: f32,
}

/// Another view's estimate, with the warps to it and back.
struct Other<'a> {
    rho: &'a [f32],
    width: usize,
    height: usize,
    forward: Warp,
    backward: Warp,
}

/// Compares a view's own depth with that of `others`.
pub(crate) fn support(own: &ViewDepth, others: &[&ViewDepth], config: &StereoConfig) -> Vec<Support> {
    let others: Vec<Other<'_>> = others
        .iter()
        .map(|other| {
            let forward = neighbour_from_reference(&other.world_from_camera, &own.world_from_camera);
            let backward = neighbour_from_reference(&own.world_from_camera, &other.world_from_camera);
            Other {
                rho: &other.estimate.rho,
                width: other.intrinsics.width,
                height: other.intrinsics.height,
                forward: Warp::new(&own.intrinsics, &other.intrinsics, &forward),
                backward: Warp::new(&other.intrinsics, &own.intrinsics, &backward),
            }
        })
        .collect();
    let width = own.intrinsics.width;
    own.estimate
        .rho
        .par_iter()
        .enumerate()
        .map(|(i, &rho)| {
            at_pixel((i % width) as f32, (i / width) as f32, rho, &others, config.agreement_ratio as f32)
        })
        .collect()
}

fn at_pixel(x: f32, y: f32, rho: f32, others: &[Other<'_>], agreement: f32) -> Support {
    let mut support = Support { rho, agreeing: 0, compared: 0, rms_difference: 0.0 };
    if !(rho > 0.0) {
        support.rho = f32::NAN;
        return support;
    }
    let (mut sum, mut squares) = (rho, 0.0);
    for other in others {
        let Some((u, v, ratio)) = other.forward.project(x, y, rho) else { continue };
        let (ui, vi) = (u.round(), v.round());
        if !(ui >= 0.0 && vi >= 0.0 && ui < other.width as f32 && vi < other.height as f32) {
            continue;
        }
        let other_rho = other.rho[vi as usize * other.width + ui as usize];
        if !(other_rho > 0.0) {
            continue;
        }
        // The point's inverse depth in the neighbour would be rho / ratio.
        let expected = rho / ratio;
        if other_rho > expected * (1.0 + 3.0 * agreement) {
            // The neighbour has a nearer surface: an occlusion or an error, so it counts as compared.
            support.compared += 1;
            continue;
        }
        support.compared += 1;
        let Some((bx, by, back_ratio)) = other.backward.project(ui, vi, other_rho) else { continue };
        let own_again = other_rho / back_ratio;
        let difference = (own_again - rho) / rho;
        let (ex, ey) = (bx - x - (ui - u), by - y - (vi - v));
        if difference.abs() <= agreement && ex * ex + ey * ey <= REPROJECTION_LIMIT_PX * REPROJECTION_LIMIT_PX
        {
            support.agreeing += 1;
            sum += own_again;
            squares += difference * difference;
        }
    }
    if support.agreeing > 0 {
        support.rho = sum / f32::from(support.agreeing + 1);
        support.rms_difference = (squares / f32::from(support.agreeing)).sqrt();
    }
    support
}
