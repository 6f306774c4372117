//! What the views say about each other's depths (the geometric check of Schönberger 2016, section 4.3).
//!
//! A pixel's point is carried into a neighbour, the neighbour's own depth there is carried back, and the two agree if
//! the way there and back ends within a pixel or so of its start and the depths differ by little. Where views agree
//! their inverse depths are averaged, which removes part of each one's noise.

use crate::chunk::ViewDepth;
use crate::config::StereoConfig;
use crate::warp::{Warp, neighbour_from_reference};
use rayon::prelude::*;

/// Largest distance between a pixel and where the way there and back ends, working pixels.
const REPROJECTION_LIMIT_PX: f32 = 1.5;

/// What was found at a pixel.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Support {
    /// Inverse depth averaged over the views that agree, 1/m; NaN where the view itself has none.
    pub rho: f32,
    /// Views that agree.
    pub agreeing: u8,
    /// Views that have a depth where the point falls: agreeing, disagreeing, or with something nearer in the way.
    pub asked: u8,
    /// Root mean square of the relative differences of those that agree.
    pub spread: f32,
}

/// Another view's estimate, with the ways there and back.
struct Other<'a> {
    rho: &'a [f32],
    width: usize,
    height: usize,
    there: Warp,
    back: Warp,
}

/// Compares a view's own depth with that of `others`.
pub(crate) fn support(own: &ViewDepth, others: &[&ViewDepth], config: &StereoConfig) -> Vec<Support> {
    let others: Vec<Other<'_>> = others
        .iter()
        .map(|other| {
            let there = neighbour_from_reference(&other.world_from_camera, &own.world_from_camera);
            let back = neighbour_from_reference(&own.world_from_camera, &other.world_from_camera);
            Other {
                rho: &other.estimate.rho,
                width: other.intrinsics.width,
                height: other.intrinsics.height,
                there: Warp::new(&own.intrinsics, &other.intrinsics, &there),
                back: Warp::new(&other.intrinsics, &own.intrinsics, &back),
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
    let mut found = Support { rho, agreeing: 0, asked: 0, spread: 0.0 };
    if !(rho > 0.0) {
        found.rho = f32::NAN;
        return found;
    }
    let (mut sum, mut squares) = (rho, 0.0);
    for other in others {
        let Some((u, v, ratio)) = other.there.project(x, y, rho) else { continue };
        let (ui, vi) = (u.round(), v.round());
        if !(ui >= 0.0 && vi >= 0.0 && ui < other.width as f32 && vi < other.height as f32) {
            continue;
        }
        let theirs = other.rho[vi as usize * other.width + ui as usize];
        if !(theirs > 0.0) {
            continue;
        }
        // Their inverse depth of our point would be rho / ratio.
        let expected = rho / ratio;
        if theirs > expected * (1.0 + 3.0 * agreement) {
            // Something nearer stands in their way: perhaps hidden, perhaps wrong, so it counts as asked.
            found.asked += 1;
            continue;
        }
        found.asked += 1;
        let Some((bx, by, back_ratio)) = other.back.project(ui, vi, theirs) else { continue };
        let own_again = theirs / back_ratio;
        let difference = (own_again - rho) / rho;
        let (ex, ey) = (bx - x - (ui - u), by - y - (vi - v));
        if difference.abs() <= agreement && ex * ex + ey * ey <= REPROJECTION_LIMIT_PX * REPROJECTION_LIMIT_PX
        {
            found.agreeing += 1;
            sum += own_again;
            squares += difference * difference;
        }
    }
    if found.agreeing > 0 {
        found.rho = sum / f32::from(found.agreeing + 1);
        found.spread = (squares / f32::from(found.agreeing)).sqrt();
    }
    found
}
