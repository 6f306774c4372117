//! Sweep (Collins 1996; Gallup 2007): matching costs of every pixel and label.
//!
//! A label moves a surface by a step of inverse depth. Over the surface ρ = 0 the labels are fronto-parallel planes; over
//! an estimate they are offsets from it, and a few of them suffice.

use crate::ncc::{Reference, Source, Strip, Surface};
use crate::window::HIDDEN;
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

/// The costs of the surface `rho + shift` at every pixel.
pub(crate) fn costs_of_surface(
    reference: &Reference,
    sources: &[Source<'_>],
    rho: &[f32],
    shift: f32,
) -> Vec<f32> {
    let width = reference.width;
    let mut costs = vec![HIDDEN; rho.len()];
    costs.par_chunks_mut(STRIP_ROWS * width).enumerate().for_each(|(i, costs)| {
        let mut strip = Strip::new(reference, i * STRIP_ROWS, costs.len() / width, sources.len());
        strip.costs(sources, Surface { rho, stride: width }, shift, costs);
    });
    costs
}
