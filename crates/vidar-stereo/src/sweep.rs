//! Sweep (Collins 1996; Gallup 2007): matching costs of every pixel and label.
//!
//! A label moves a surface by a step of inverse depth. Over the surface ρ = 0 the labels are fronto-parallel planes; over
//! an estimate they are offsets from it, and a few of them suffice.

use crate::ncc::{HIDDEN, Reference, Source, Strip, Surface};
use rayon::prelude::*;

/// Cost of a label that no neighbour sees.
pub(crate) const INVISIBLE: u8 = 255;
/// Cost of no correlation at all.
pub(crate) const WORST: f32 = 254.0;
/// Rows of one task: each strip also warps the radius above and below it, and its costs stay in the cache.
const STRIP_ROWS: usize = 24;
/// Labels of a pixel are padded to a multiple of this, for the vectors of semi-global matching.
pub(crate) const LANES: usize = 16;

/// Inverse depths `first + step·k`, k = 0…count−1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Labels {
    pub first: f32,
    pub step: f32,
    pub count: usize,
}

impl Labels {
    /// The inverse depth of a (fractional) label.
    pub fn rho(&self, label: f32) -> f32 {
        self.first + self.step * label
    }
}

/// Costs by row, column, label (label fastest): `WORST·cost`, or [`INVISIBLE`].
pub(crate) struct Volume {
    /// Labels of each pixel.
    pub count: usize,
    /// Bytes of each pixel: `count` and, up to a multiple of [`LANES`], invisible labels.
    pub stride: usize,
    pub costs: Vec<u8>,
}

/// The costs of `labels` over `surface`.
pub(crate) fn sweep(
    reference: &Reference,
    sources: &[Source<'_>],
    surface: Surface<'_>,
    labels: &Labels,
) -> Volume {
    let stride = labels.count.next_multiple_of(LANES);
    let row_len = reference.width * stride;
    let mut costs = vec![INVISIBLE; reference.height * row_len];
    costs.par_chunks_mut(STRIP_ROWS * row_len).enumerate().for_each(|(i, costs)| {
        let rows = costs.len() / row_len;
        let mut strip = Strip::new(reference, i * STRIP_ROWS, rows, sources.len());
        let mut of_label = vec![HIDDEN; reference.width * rows];
        for label in 0..labels.count {
            strip.costs(sources, surface, labels.rho(label as f32), &mut of_label);
            for (pixel, &cost) in costs.chunks_exact_mut(stride).zip(&of_label) {
                pixel[label] = if cost > 1.0 { INVISIBLE } else { (WORST * cost) as u8 };
            }
        }
    });
    Volume { count: labels.count, stride, costs }
}

/// How well a surface matches, without moving it.
pub(crate) struct Scores {
    /// Matching cost, 0 (perfect) to 1 (none, or not visible).
    pub cost: Vec<f32>,
    /// Second derivative of the cost by inverse depth, m².
    pub bend: Vec<f32>,
}

/// Scores of a surface from its costs there and `step` to both sides.
pub(crate) fn score(reference: &Reference, sources: &[Source<'_>], rho: &[f32], step: f32) -> Scores {
    let width = reference.width;
    let (mut cost, mut bend) = (vec![1.0; rho.len()], vec![0.0; rho.len()]);
    let surface = Surface { rho, stride: width };
    let strips = cost.par_chunks_mut(STRIP_ROWS * width).zip(bend.par_chunks_mut(STRIP_ROWS * width));
    strips.enumerate().for_each(|(i, (cost, bend))| {
        let mut strip = Strip::new(reference, i * STRIP_ROWS, cost.len() / width, sources.len());
        let mut sides = [vec![HIDDEN; cost.len()], vec![HIDDEN; cost.len()]];
        let [further, nearer] = &mut sides;
        strip.costs(sources, surface, 0.0, cost);
        strip.costs(sources, surface, -step, further);
        strip.costs(sources, surface, step, nearer);
        for ((c, b), (f, n)) in cost.iter_mut().zip(bend).zip(further.iter().zip(nearer.iter())) {
            let visible = *c <= 1.0 && *f <= 1.0 && *n <= 1.0;
            *b = if visible { (f - 2.0 * *c + n) / (step * step) } else { 0.0 };
            *c = c.min(1.0);
        }
    });
    Scores { cost, bend }
}
