//! The surface at the full size: its edges, its last fraction of a step, and how well it matches.
//!
//! The coarse size places the edge between two surfaces to a few pixels of the full one. A pixel beside an edge therefore
//! also tries the surfaces around it, continued to it, and takes one that matches clearly better (the propagation of
//! PatchMatch stereo, Bleyer 2011, of whole images at once). The vertex of the parabola through three costs settles the rest.

use crate::ncc::{HIDDEN, Reference, Source, Strip, Surface};
use crate::sweep::STRIP_ROWS;
use rayon::prelude::*;

/// Offsets of the pixels whose surfaces are tried, about as far as the coarse size's windows misplace an edge. On HoloLens
/// keyframes 0 to 15, poses registered, AbsRel is .0203, .0198 and .0193, completeness .645, .640 and .635 at 4, 6 and 8.
const FROM: [(isize, isize); 4] = [(-6, 0), (6, 0), (0, -6), (0, 6)];
/// How much less another surface must cost. On the same keyframes with registered poses AbsRel is .0221 without other
/// surfaces, .0213 at 0.1 and .0209 at 0.05.
const CLEARLY_BETTER: f32 = 0.05;
/// Another surface differs by more than this many coarse planes.
const OTHER_SURFACE_PLANES: f32 = 0.7;
/// Step of the scores in coarse planes: somewhat more than a pixel at the full size.
const STEP_PLANES: f32 = 0.2;

/// Least second difference of the costs for a vertex: a flatter one is noise.
const FLAT: f32 = 1e-3;

/// The surface at the full size with its scores.
pub(crate) struct Settled {
    /// Inverse depth, 1/m; NaN where there is none.
    pub rho: Vec<f32>,
    /// Matching cost, 0 (perfect) to 1 (none, or not visible).
    pub cost: Vec<f32>,
    /// Second derivative of the cost by inverse depth, m².
    pub bend: Vec<f32>,
}

/// Settles `rho`; `plane` is the coarse sweep's step, 1/m.
pub(crate) fn settle(reference: &Reference, sources: &[Source<'_>], rho: Vec<f32>, plane: f32) -> Settled {
    let rho = with_sharp_edges(reference, sources, rho, plane);
    let step = STEP_PLANES * plane;
    let costs = |shift: f32| costs(reference, sources, &rho, shift);
    let (mut cost, further, nearer) = (costs(0.0), costs(-step), costs(step));
    let mut bend = vec![0.0; rho.len()];
    let mut settled = rho.clone();
    for i in 0..rho.len() {
        let (f, c, n) = (further[i], cost[i], nearer[i]);
        if f <= 1.0 && c <= 1.0 && n <= 1.0 {
            let second = f - 2.0 * c + n;
            bend[i] = second / (step * step);
            if second > FLAT {
                settled[i] += step * (0.5 * (f - n) / second).clamp(-0.5, 0.5);
            }
        }
        cost[i] = c.min(1.0);
    }
    Settled { rho: settled, cost, bend }
}

/// The costs of `rho + shift` at every pixel.
fn costs(reference: &Reference, sources: &[Source<'_>], rho: &[f32], shift: f32) -> Vec<f32> {
    let width = reference.width;
    let mut costs = vec![HIDDEN; rho.len()];
    costs.par_chunks_mut(STRIP_ROWS * width).enumerate().for_each(|(i, costs)| {
        let mut strip = Strip::new(reference, i * STRIP_ROWS, costs.len() / width, sources.len());
        strip.costs(sources, Surface { rho, stride: width }, shift, costs);
    });
    costs
}

/// `rho` with the surfaces around where they match clearly better.
fn with_sharp_edges(reference: &Reference, sources: &[Source<'_>], rho: Vec<f32>, plane: f32) -> Vec<f32> {
    let other = OTHER_SURFACE_PLANES * plane;
    let mut best = costs(reference, sources, &rho, 0.0);
    let mut sharp = rho.clone();
    for from in FROM {
        let tried = continued_from(&rho, reference.width, from, other);
        let found = costs(reference, sources, &tried, 0.0);
        for i in 0..rho.len() {
            if found[i] < best[i] - CLEARLY_BETTER {
                // The next one needs to match better than this one, not clearly so.
                best[i] = found[i] + CLEARLY_BETTER;
                sharp[i] = tried[i];
            }
        }
    }
    sharp
}

/// At every pixel the surface that lies at `from` it, continued to it where that is another surface.
fn continued_from(rho: &[f32], width: usize, (dx, dy): (isize, isize), other: f32) -> Vec<f32> {
    let height = rho.len() / width;
    let at = |x: isize, y: isize| {
        let (x, y) = (x.clamp(0, width as isize - 1) as usize, y.clamp(0, height as isize - 1) as usize);
        rho[y * width + x]
    };
    let value = |i: usize| {
        let (x, y) = ((i % width) as isize, (i / width) as isize);
        let (near, far) = (at(x + dx, y + dy), at(x + 2 * dx, y + 2 * dy));
        let slope = if (near - far).abs() < other { near - far } else { 0.0 };
        let there = near + slope;
        if (there - rho[i]).abs() > other && there > 0.0 { there } else { rho[i] }
    };
    (0..rho.len()).into_par_iter().map(value).collect()
}
