//! Matrix products with a fused end: the one loop behind linear layers and convolutions.
//!
//! `out = end(A B)`, where B's columns are output channels. A is never gathered: a row of A is addressed by an offset, and
//! the inner dimension is a list of *taps*, each a run of consecutive numbers at a fixed offset from the row's start. A
//! linear layer has one tap; a k×k convolution over an NHWC map has k taps (the k pixels of a kernel row are consecutive),
//! so that no im2col copy exists, only the input band with its border of zeros.
//!
//! B is packed panel by panel as it is needed, a few megabytes at a time; packing costs 1/rows of the work and spares a
//! second copy of the weights. Work is split into tasks of row chunks × panel ranges. Every output number is one
//! accumulation over the inner dimension in its order, whatever the split and whatever the height of its tile: the bits do
//! not depend on the number of threads.

use std::ops::Range;

use rayon::prelude::*;

use super::centre::{Bias, centre_of};
use super::pack::Pack;
use super::product::{End, PACKED_WORDS, Product, Target};
use super::scratch::{self, Role};
use super::shape::{Shape, ShapeOf};
use super::shared::SharedMut;
use super::simd::Simd;
use super::source::{Geometry, Source};
use super::tile::{MAX_ROWS, Multiply, Sums, steps_of, tile_start};
use super::{Factors, ProductKernel, dispatch_product, math, winograd};
use crate::compute::{Compute, Precision};

/// Tasks per thread that make their different speeds even out.
const TASKS_PER_THREAD: usize = 8;

impl Product<'_> {
    /// Computes it into `out`.
    pub(crate) fn run(&self, c: &Compute, out: &mut [f32]) {
        let inner = self.source.inner();
        let chunks = self.source.chunks();
        if self.width == 0 || chunks == 0 {
            return;
        }
        let (isa, factors) = (c.isa(), Factors::of(c));
        if let Source::Bands(bands) = &self.source
            && winograd::is_for(bands, factors)
        {
            return winograd::run(self, bands, c, out);
        }
        let Shape { panel, words } = dispatch_product(isa, factors, ShapeOf { inner });
        let panel_words = panel * words;
        let gated = matches!(self.end, End::SwiGlu);
        let width = if gated { self.width / 2 } else { self.width };
        // For a gated unit panels come in pairs, gate and value.
        let per_unit = if gated { 2 } else { 1 };
        let units = width.div_ceil(panel);
        let units_at_once = (PACKED_WORDS / (panel_words * per_unit).max(1)).clamp(1, units);
        let column = |at: usize| -> Option<usize> {
            let (p, j) = (at / panel, at % panel);
            let i = p / per_unit * panel + j;
            (i < width).then_some(i + p % per_unit * width)
        };
        let out = SharedMut::new(out);
        let centre = centre_of(isa, factors, &self.source);
        let centre = centre.as_deref();
        let mut bias = Bias::new(self.bias, centre, self.width);
        let mut packed = scratch::borrow(Role::Panels);
        for first in (0..units).step_by(units_at_once) {
            let count = units_at_once.min(units - first);
            let packed = &mut packed.words(count * per_unit * panel_words)[..count * per_unit * panel_words];
            let pack = Pack {
                columns: self.columns,
                column: &column,
                inner,
                round_to_f16: c.precision() == Precision::F16,
                centre: centre.zip(bias.products()),
                first: first * per_unit * panel,
                to: packed,
            };
            pack.run(isa, factors);
            let bias = bias.get();
            let panels = Panels { words: packed, first, count, per_unit };
            let splits = (TASKS_PER_THREAD * rayon::current_num_threads()).div_ceil(chunks).clamp(1, count);
            (0..chunks * splits).into_par_iter().for_each(|task| {
                let (chunk, split) = (task / splits, task % splits);
                let units = split * count / splits..(split + 1) * count / splits;
                dispatch_product(
                    isa,
                    factors,
                    Task { product: self, bias, centre, chunk, panels, units, width, out },
                );
            });
        }
    }
}

/// Packed columns: `count` units of one panel (or a pair) from unit `first` on.
#[derive(Clone, Copy)]
pub(crate) struct Panels<'a> {
    pub(crate) words: &'a [u32],
    pub(crate) first: usize,
    pub(crate) count: usize,
    pub(crate) per_unit: usize,
}

struct Task<'a> {
    product: &'a Product<'a>,
    bias: Option<&'a [f32]>,
    centre: Option<&'a [f32]>,
    chunk: usize,
    panels: Panels<'a>,
    units: Range<usize>,
    width: usize,
    out: SharedMut<'a>,
}

impl ProductKernel for Task<'_> {
    type Output = ();
    #[inline(always)]
    fn run<M: Multiply>(self, m: M) {
        let product = self.product;
        let mut scratch = scratch::borrow(Role::Rows);
        let rows = product.source.rows(self.chunk);
        let geometry = product.source.geometry::<M>();
        let a = product.source.prepare(m, &geometry, self.chunk, self.centre, &mut scratch);
        let target = Target {
            width: self.width,
            bias: self.bias,
            end: product.end,
            layout: product.layout,
            out: self.out,
        };
        multiply(m, a, &geometry, rows, 0, self.panels, self.units, &target);
    }
}

/// Multiplies rows `rows` of A (in `a`, which starts with the first of them) with some units of the panels. Row m of A goes to
/// row `m - out_start` of the target.
#[inline(always)]
#[allow(clippy::too_many_arguments)] // two callers; each argument is a thing of its own
pub(crate) fn multiply<M: Multiply>(
    m: M,
    a: &[M::Number],
    geometry: &Geometry,
    rows: Range<usize>,
    out_start: usize,
    panels: Panels<'_>,
    units: Range<usize>,
    target: &Target<'_>,
) {
    let s = m.simd();
    let panel = 2 * M::Simd::LANES;
    let steps = steps_of::<M>(geometry.inner.group);
    let panel_words = panel * geometry.inner.taps * steps;
    if rows.is_empty() || units.is_empty() {
        return;
    }
    // Every address that a tile reads lies below this one.
    let reach = geometry.at(rows.end - 1) - geometry.at(rows.start)
        + geometry.taps.iter().max().copied().unwrap_or(0)
        + steps * M::STEP;
    assert!(panel_words == 0 || reach <= a.len(), "rows of a product: {reach} of {}", a.len());
    assert!(units.end <= panels.count && panels.words.len() >= panels.count * panels.per_unit * panel_words);
    let mut sums = [[s.splat(0.0); 2]; MAX_ROWS];
    let mut gates = sums;
    for unit in units {
        let words = &panels.words[unit * panels.per_unit * panel_words..][..panels.per_unit * panel_words];
        let first = (panels.first + unit) * panel;
        let mut row = rows.start;
        while row < rows.end {
            let line_end = (row / geometry.line + 1) * geometry.line;
            let run = row..line_end.min(rows.end);
            let tiles = run.len().div_ceil(M::ROWS);
            for i in 0..tiles {
                let from = run.start + tile_start(run.len(), i, tiles);
                let count = run.start + tile_start(run.len(), i + 1, tiles) - from;
                let at = geometry.at(from) - geometry.at(rows.start);
                let here = (a[at..].as_ptr(), geometry.row_stride);
                // SAFETY: `reach` bounds every row and tap, and each panel has panel_words words.
                unsafe {
                    m.tile(count, here, &geometry.taps, steps, words.as_ptr(), &mut sums);
                    if panels.per_unit == 2 {
                        std::mem::swap(&mut gates, &mut sums);
                        m.tile(count, here, &geometry.taps, steps, words[panel_words..].as_ptr(), &mut sums);
                    }
                }
                target.finish(m, &gates, &sums, from - out_start, count, first);
            }
            row = run.end;
        }
    }
}

impl Target<'_> {
    /// Bias, end and store of a tile.
    #[inline(always)]
    pub(crate) fn finish<M: Multiply>(
        &self,
        m: M,
        gates: &Sums<M::Simd>,
        sums: &Sums<M::Simd>,
        row: usize,
        count: usize,
        first: usize,
    ) {
        let (s, lanes) = (m.simd(), M::Simd::LANES);
        let columns = (2 * lanes).min(self.width - first);
        // Rows of a tile mostly lie in one line: dividing for each of them would cost a tenth of the product.
        let (base, in_line) = (self.layout.at(row), row % self.layout.line + count <= self.layout.line);
        let start_of =
            |r: usize| if in_line { base + r * self.layout.row_stride } else { self.layout.at(row + r) };
        for half in 0..2 {
            let from = half * lanes;
            if from >= columns {
                return;
            }
            let to = (from + lanes).min(columns);
            let of = |v: &[f32], base: usize| s.load_part(&v[base + first + from..base + first + to]);
            let bias = self.bias.map_or(s.splat(0.0), |bias| of(bias, 0));
            // Each end has its own loop over rows, so that the choice is made once per tile.
            macro_rules! rows {
                (|$start:ident, $out:ident, $v:ident, $r:ident| $value:expr) => {
                    for $r in 0..count {
                        let $start = start_of($r) + first + from;
                        // SAFETY: rows and panels are disjoint between tasks and within one.
                        let $out = unsafe { self.out.part($start, to - from) };
                        let $v = s.add(sums[$r][half], bias);
                        let value = $value;
                        s.store_part($out, value);
                    }
                };
            }
            match self.end {
                End::Store => rows!(|_at, out, v, r| v),
                // What is rounded to bf16 next needs no more than that.
                End::Gelu if M::STEP == 2 => rows!(|_at, out, v, r| math::gelu_coarse(s, v)),
                End::Gelu => rows!(|_at, out, v, r| math::gelu(s, v)),
                End::Relu => rows!(|_at, out, v, r| math::relu(s, v)),
                End::Accumulate(None) => rows!(|_at, out, v, r| s.add(s.load_part(out), v)),
                End::Accumulate(Some(gamma)) => {
                    let gamma = of(gamma, 0);
                    rows!(|_at, out, v, r| s.fma(gamma, v, s.load_part(out)));
                }
                End::Add(other) => rows!(|at, out, v, r| s.add(s.load_part(&other[at..at + to - from]), v)),
                End::SwiGlu => {
                    // `bias` is the gate's here; the value's lies `width` further.
                    let value_bias = self.bias.map_or(s.splat(0.0), |bias| of(bias, self.width));
                    for r in 0..count {
                        let start = start_of(r) + first + from;
                        // SAFETY: rows and panels are disjoint between tasks and within one.
                        let out = unsafe { self.out.part(start, to - from) };
                        let gate = math::silu(s, s.add(gates[r][half], bias));
                        s.store_part(out, s.mul(gate, s.add(sums[r][half], value_bias)));
                    }
                }
            }
        }
    }
}
