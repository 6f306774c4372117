//! Weights into panels: `[taps][steps][2 LANES]` words, in the order in which a tile reads them.

use rayon::prelude::*;

use super::centre::dot_repeated;
use super::scratch::{self, Role};
use super::shape::{Shape, ShapeOf};
use super::shared::SharedMut;
use super::simd::Simd;
use super::source::Inner;
use super::tile::Multiply;
use super::{Factors, ProductKernel, dispatch_product};
use crate::isa::Isa;

/// Where the columns of B come from.
pub(crate) trait Columns: Sync {
    /// Writes column `column` of B (its whole inner dimension, tap after tap) to `out`.
    fn read(&self, column: usize, out: &mut [f32]);
}

/// Packs the given columns, a panel's width of them at a time (the last panel is filled up with zeros).
pub(crate) struct Pack<'a> {
    pub(crate) columns: &'a dyn Columns,
    /// The column of B for each column of the panels; `None` gives zeros.
    pub(crate) column: &'a (dyn Fn(usize) -> Option<usize> + Sync),
    pub(crate) inner: Inner,
    /// Whether the numbers are rounded to f16 on the way.
    pub(crate) round_to_f16: bool,
    /// A row of A around which the product is, and where its own products with the columns are added.
    pub(crate) centre: Option<(&'a [f32], SharedMut<'a>)>,
    /// The first column, and a whole number of panels to fill.
    pub(crate) first: usize,
    pub(crate) to: &'a mut [u32],
}

impl Pack<'_> {
    pub(crate) fn run(self, isa: Isa, factors: Factors) {
        let Self { columns, column, inner, round_to_f16, centre, first, to } = self;
        let Shape { panel, words } = dispatch_product(isa, factors, ShapeOf { inner });
        if words == 0 {
            return;
        }
        to.par_chunks_exact_mut(panel * words).enumerate().for_each(|(p, to)| {
            let first = first + p * panel;
            dispatch_product(isa, factors, Panel { columns, column, inner, round_to_f16, centre, first, to });
        });
    }
}

/// One panel; fields as in [`Pack`].
struct Panel<'a> {
    columns: &'a dyn Columns,
    column: &'a (dyn Fn(usize) -> Option<usize> + Sync),
    inner: Inner,
    round_to_f16: bool,
    centre: Option<(&'a [f32], SharedMut<'a>)>,
    first: usize,
    to: &'a mut [u32],
}

impl ProductKernel for Panel<'_> {
    type Output = ();
    #[inline(always)]
    fn run<M: Multiply>(self, m: M) {
        let panel = 2 * M::Simd::LANES;
        let Self { columns, column, inner, round_to_f16, centre, first, to } = self;
        let words = inner.words::<M>();
        let numbers = inner.taps * inner.group;
        let mut scratch = scratch::borrow(Role::Columns);
        let (read, packed) = scratch
            .words(numbers.next_multiple_of(16) + panel * words)
            .split_at_mut(numbers.next_multiple_of(16));
        let read = &mut scratch::as_floats_mut(read)[..numbers];
        for j in 0..panel {
            let packed = &mut packed[j * words..(j + 1) * words];
            let Some(column) = column(first + j) else {
                packed.fill(0);
                continue;
            };
            columns.read(column, read);
            if let Some((centre, products)) = centre {
                // SAFETY: every column is packed once.
                let product = unsafe { products.part(column, 1) };
                product[0] += dot_repeated(m.simd(), read, centre);
            }
            if round_to_f16 {
                read.iter_mut().for_each(|x| *x = half::f16::from_f32(*x).to_f32());
            }
            let whole = inner.group / M::STEP;
            for (read, packed) in
                read.chunks_exact(inner.group).zip(packed.chunks_exact_mut(words / inner.taps))
            {
                let (even, rest) = read.split_at(whole * M::STEP);
                m.convert(even, M::numbers(&mut packed[..whole]));
                packed[whole..].fill(0);
                if !rest.is_empty() {
                    packed[whole] = M::word(rest);
                }
            }
        }
        transpose(m.simd(), &packed[..panel * words], words, to);
    }
}

/// `to[k][j] = from[j][k]` for rows of `words`.
#[inline(always)]
pub(crate) fn transpose<S: Simd>(s: S, from: &[u32], words: usize, to: &mut [u32]) {
    let rows = from.len() / words;
    let to = &mut to[..rows * words];
    let (whole_rows, whole_words) = (rows / S::LANES * S::LANES, words / S::LANES * S::LANES);
    for k in (0..whole_words).step_by(S::LANES) {
        for j in (0..whole_rows).step_by(S::LANES) {
            // SAFETY: LANES rows of `from` from j on have LANES words from k on, and the other way round.
            unsafe {
                s.transpose(from.as_ptr().add(j * words + k), words, to.as_mut_ptr().add(k * rows + j), rows);
            }
        }
    }
    for (j, row) in from.chunks_exact(words).enumerate() {
        let first = if j < whole_rows { whole_words } else { 0 };
        for (k, word) in row.iter().enumerate().skip(first) {
            to[k * rows + j] = *word;
        }
    }
}
