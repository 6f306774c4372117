//! Attention block by block, in the manner of FlashAttention (Dao et al. 2022, Algorithm 1; the division at the end as in
//! FlashAttention-2).
//!
//! Keys and values are packed once per head as the right-hand sides of two products: K with panels over keys, V with
//! panels over channels. A task takes some queries of one head through all key blocks: scores, running maximum, weights,
//! and the weighted values, everything inside the second-level cache. Key blocks are fixed, so that a query's result does
//! not depend on which queries share its task.

use rayon::prelude::*;

use super::norm::{NormRef, norm_row};
use super::pack::transpose;
use super::scratch::{self, Role, as_floats_mut, as_words_mut};
use super::shared::SharedMut;
use super::simd::Simd;
use super::tile::{MAX_ROWS, Multiply, steps_of};
use super::{ProductKernel, math};
use crate::rope::RopeTable;

/// Keys of a block: a multiple of every panel width.
pub(crate) const BLOCK: usize = 128;
/// Words between the weights of neighbouring queries: rows would otherwise compete for the same cache sets.
const WEIGHT_GAP: usize = 16;
/// Queries of a task: a multiple of every tile height.
pub(crate) const QUERIES: usize = 48;

/// Rows of tokens, `width` numbers from `data[t * stride]` on.
#[derive(Clone, Copy)]
pub(crate) struct Tokens<'a> {
    pub(crate) data: &'a [f32],
    pub(crate) stride: usize,
}

/// What is done with a query or key of `d` channels before use.
#[derive(Clone, Copy)]
pub(crate) struct Prepare<'a> {
    pub(crate) norm: Option<NormRef<'a>>,
    pub(crate) rope: Option<&'a RopeTable>,
}

impl Prepare<'_> {
    #[inline(always)]
    fn row<S: Simd>(&self, s: S, token: usize, x: &[f32], out: &mut [f32]) {
        match self.norm {
            Some(norm) => norm_row(s, norm, x, out),
            None => out.copy_from_slice(x),
        }
        if let Some(rope) = self.rope {
            rope.rotate(token, out);
        }
    }
}

/// Sizes of a head's packed keys and values, in words.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct HeadLayout {
    pub(crate) d: usize,
    /// Keys there is room for: whole blocks.
    pub(crate) capacity: usize,
    panel: usize,
    step: usize,
    d_steps: usize,
}

impl HeadLayout {
    fn d_panels(&self) -> usize {
        self.d.div_ceil(self.panel)
    }
    fn key_words(&self) -> usize {
        self.capacity * self.d_steps
    }
    fn value_panel_words(&self) -> usize {
        self.capacity / self.step * self.panel
    }
    /// Words of a head.
    pub(crate) fn words(&self) -> usize {
        self.key_words() + self.d_panels() * self.value_panel_words()
    }
}

/// Asks for the layout of heads of `d` channels with room for `keys` keys.
pub(crate) struct LayoutOf {
    pub(crate) d: usize,
    pub(crate) keys: usize,
}

impl ProductKernel for LayoutOf {
    type Output = HeadLayout;
    fn run<M: Multiply>(self, _: M) -> HeadLayout {
        let capacity = self.keys.next_multiple_of(BLOCK);
        HeadLayout {
            d: self.d,
            capacity,
            panel: 2 * M::Simd::LANES,
            step: M::STEP,
            d_steps: steps_of::<M>(self.d),
        }
    }
}

/// Packs one block's share of some tokens of one head: keys `first..first + count` (counted from the head's start) come from
/// tokens `token..`. A block's unused places are set to zero when its first key arrives.
pub(crate) struct PackKeys<'a> {
    pub(crate) layout: HeadLayout,
    pub(crate) words: SharedMut<'a>,
    /// Where the head starts in `words`.
    pub(crate) base: usize,
    pub(crate) k: Tokens<'a>,
    pub(crate) v: Tokens<'a>,
    pub(crate) prepare: Prepare<'a>,
    /// Offset of the head's channels in a token's row.
    pub(crate) channel: usize,
    pub(crate) first: usize,
    pub(crate) token: usize,
    pub(crate) count: usize,
}

impl ProductKernel for PackKeys<'_> {
    type Output = ();
    #[inline(always)]
    fn run<M: Multiply>(self, m: M) {
        let (s, layout) = (m.simd(), self.layout);
        let (d, panel, d_steps) = (layout.d, layout.panel, layout.d_steps);
        let block = self.first / BLOCK * BLOCK;
        let offset = self.first - block;
        debug_assert!(offset + self.count <= BLOCK);
        let mut scratch = scratch::borrow(Role::Block);
        let row_words = d.next_multiple_of(16);
        let (row, packed) = scratch.words(row_words + BLOCK * d_steps).split_at_mut(row_words);
        let row = &mut as_floats_mut(row)[..d];

        // Keys: rows of words, then transposed panel by panel. A block that is already begun is read back first.
        // SAFETY: each task has its own block of its own head.
        let keys = as_words_mut(unsafe { self.words.part(self.base + block * d_steps, BLOCK * d_steps) });
        let packed = &mut packed[..BLOCK * d_steps];
        packed.fill(0);
        if offset > 0 {
            for (words, rows) in
                keys.chunks_exact(panel * d_steps).zip(packed.chunks_exact_mut(panel * d_steps))
            {
                transpose(s, words, panel, rows);
            }
        }
        for i in 0..self.count {
            let x = &self.k.data[(self.token + i) * self.k.stride + self.channel..][..d];
            self.prepare.row(s, self.token + i, x, row);
            let to = &mut packed[(offset + i) * d_steps..(offset + i + 1) * d_steps];
            let whole = d / M::STEP;
            m.convert(&row[..whole * M::STEP], &mut M::numbers(&mut to[..whole])[..whole * M::STEP]);
            if whole * M::STEP < d {
                to[whole] = M::word(&row[whole * M::STEP..]);
            }
        }
        for (rows, words) in packed.chunks_exact(panel * d_steps).zip(keys.chunks_exact_mut(panel * d_steps))
        {
            transpose(s, rows, d_steps, words);
        }

        // Values: `STEP` keys of a channel to a word.
        for p in 0..layout.d_panels() {
            let start =
                self.base + layout.key_words() + p * layout.value_panel_words() + block / M::STEP * panel;
            // SAFETY: as above.
            let values = as_words_mut(unsafe { self.words.part(start, BLOCK / M::STEP * panel) });
            if offset == 0 {
                values.fill(0);
            }
            let channels = panel.min(d - p * panel);
            let numbers = M::numbers(values);
            for i in 0..self.count {
                let x =
                    &self.v.data[(self.token + i) * self.v.stride + self.channel + p * panel..][..channels];
                let key = offset + i;
                let to = &mut numbers[key / M::STEP * panel * M::STEP..];
                if M::STEP == 1 {
                    m.convert(x, &mut to[..channels]);
                } else {
                    let mut halves = [M::Number::default(); 64];
                    m.convert(x, &mut halves[..channels]);
                    for (j, half) in halves[..channels].iter().enumerate() {
                        to[j * M::STEP + key % M::STEP] = *half;
                    }
                }
            }
        }
    }
}

/// Takes queries `first..first + count` of one head through all keys.
pub(crate) struct Attend<'a> {
    pub(crate) layout: HeadLayout,
    /// The head's packed keys and values.
    pub(crate) words: &'a [u32],
    pub(crate) keys: usize,
    pub(crate) q: Tokens<'a>,
    pub(crate) prepare: Prepare<'a>,
    pub(crate) channel: usize,
    pub(crate) first: usize,
    pub(crate) count: usize,
    pub(crate) out: SharedMut<'a>,
    pub(crate) out_stride: usize,
}

impl ProductKernel for Attend<'_> {
    type Output = ();
    #[inline(always)]
    fn run<M: Multiply>(self, m: M) {
        let (s, layout) = (m.simd(), self.layout);
        let lanes = M::Simd::LANES;
        let (d, panel, d_steps) = (layout.d, layout.panel, layout.d_steps);
        let d_wide = layout.d_panels() * panel;
        let (n, tile_rows) = (self.count, M::ROWS);
        assert!(n <= QUERIES && self.words.len() >= layout.words() && self.keys <= layout.capacity);

        let mut scratch = scratch::borrow(Role::Block);
        let q_stride = d.next_multiple_of(32); // in words: room enough for either format
        // Scores and weights are of one tile, weights with room for the rows that a tile reads beyond it.
        let words = scratch
            .words(q_stride + QUERIES * (q_stride + d_wide + lanes) + MAX_ROWS * (2 * BLOCK + WEIGHT_GAP));
        let (row, words) = words.split_at_mut(q_stride);
        let (q, words) = words.split_at_mut(QUERIES * q_stride);
        let (scores, words) = words.split_at_mut(MAX_ROWS * BLOCK);
        let (weights, words) = words.split_at_mut(MAX_ROWS * (BLOCK + WEIGHT_GAP));
        let (sums, totals) = words.split_at_mut(QUERIES * d_wide);
        let (row, scores) = (&mut as_floats_mut(row)[..d], as_floats_mut(scores));
        let (sums, totals) = (as_floats_mut(sums), &mut as_floats_mut(totals)[..QUERIES * lanes]);
        let (q_stride, weight_stride) = (q_stride * M::STEP, BLOCK + WEIGHT_GAP * M::STEP);
        let (q, weights) = (M::numbers(q), M::numbers(weights));
        let mut tops = [f32::NEG_INFINITY; QUERIES];
        sums[..n * d_wide].fill(0.0);
        totals.fill(0.0);

        // exp(q k / sqrt d) = 2^(q' k) with the factor taken into the query.
        let factor = std::f32::consts::LOG2_E / (d as f32).sqrt();
        for i in 0..n {
            let token = self.first + i;
            self.prepare.row(s, token, &self.q.data[token * self.q.stride + self.channel..][..d], row);
            row.iter_mut().for_each(|x| *x *= factor);
            let to = &mut q[i * q_stride..(i + 1) * q_stride];
            m.convert(row, &mut to[..d]);
            to[d..].fill(M::Number::default());
        }

        let mut tile_sums = [[s.splat(0.0); 2]; MAX_ROWS];
        for block in (0..self.keys).step_by(BLOCK) {
            let count = BLOCK.min(self.keys - block);
            let wide = count.next_multiple_of(panel);
            // One tile of queries at a time: its scores and weights stay in the first-level cache beside the block.
            for from in (0..n).step_by(tile_rows) {
                let rows = tile_rows.min(n - from);
                for p in (0..wide).step_by(panel) {
                    let k = &self.words[(block + p) * d_steps..][..panel * d_steps];
                    // SAFETY: `rows` rows of q with d_steps words each, and a whole panel of keys.
                    unsafe {
                        let here = (q[from * q_stride..].as_ptr(), q_stride);
                        m.tile(rows, here, &[0], d_steps, k.as_ptr(), &mut tile_sums);
                    }
                    for (scores, sums) in scores.chunks_exact_mut(BLOCK).zip(&tile_sums[..rows]) {
                        let to = &mut scores[p..][..panel];
                        s.store(to, sums[0]);
                        s.store(&mut to[lanes..], sums[1]);
                    }
                }
                let mut shrinks = [1.0f32; MAX_ROWS];
                for r in 0..rows {
                    let (i, row) = (from + r, &mut scores[r * BLOCK..(r + 1) * BLOCK]);
                    let total = &mut totals[i * lanes..(i + 1) * lanes];
                    let weights = &mut weights[r * weight_stride..];
                    shrinks[r] = soften::<M>(m, row, count, wide, &mut tops[i], total, weights);
                }
                for p in 0..layout.d_panels() {
                    let start = layout.key_words() + p * layout.value_panel_words() + block / M::STEP * panel;
                    let v = &self.words[start..][..wide / M::STEP * panel];
                    // SAFETY: `rows` rows of `wide` weights, and as many packed values.
                    unsafe {
                        let here = (weights.as_ptr(), weight_stride);
                        m.tile(rows, here, &[0], wide / M::STEP, v.as_ptr(), &mut tile_sums);
                    }
                    for (r, add) in tile_sums[..rows].iter().enumerate() {
                        let to = &mut sums[(from + r) * d_wide + p * panel..][..panel];
                        let shrink = s.splat(shrinks[r]);
                        let (a, b) = to.split_at_mut(lanes);
                        s.store(a, s.fma(s.load(a), shrink, add[0]));
                        s.store(b, s.fma(s.load(b), shrink, add[1]));
                    }
                }
            }
        }
        for i in 0..n {
            let scale = s.splat(1.0 / s.sum(s.load(&totals[i * lanes..])));
            // SAFETY: every task has its own queries of its own head.
            let out = unsafe { self.out.part((self.first + i) * self.out_stride + self.channel, d) };
            for (out, sum) in out.chunks_mut(lanes).zip(sums[i * d_wide..].chunks(lanes)) {
                s.store_part(out, s.mul(s.load_part(sum), scale));
            }
        }
    }
}

/// Turns a row of scores into weights 2^(score - top), zeros beyond `count`; gives the factor by which everything before
/// shrinks because the maximum rose.
#[inline(always)]
fn soften<M: Multiply>(
    m: M,
    row: &mut [f32],
    count: usize,
    wide: usize,
    top: &mut f32,
    total: &mut [f32],
    weights: &mut [M::Number],
) -> f32 {
    let s = m.simd();
    let lanes = M::Simd::LANES;
    row[count..wide].fill(f32::NEG_INFINITY);
    let row = &mut row[..wide];
    let mut highest = [s.splat(*top); 2];
    for pair in row.chunks_exact(2 * lanes) {
        highest = [s.max(s.load(pair), highest[0]), s.max(s.load(&pair[lanes..]), highest[1])];
    }
    // A NaN score must not hide: the comparison keeps the running maximum, and exp2 of NaN makes the row NaN.
    let new = s.maximum(s.max(highest[0], highest[1]));
    let shrink = match *top {
        top if top == new => 1.0,
        f32::NEG_INFINITY => 0.0,
        top => (top - new).exp2(),
    };
    *top = new;
    let new = s.splat(new);
    let mut sum = s.mul(s.load(total), s.splat(shrink));
    for (scores, weights) in row.chunks_exact(lanes).zip(weights.chunks_exact_mut(lanes)) {
        let difference = s.sub(s.load(scores), new);
        let w = if M::STEP == 1 {
            math::exp2_below(s, difference)
        } else {
            math::exp2_below_coarse(s, difference)
        };
        sum = s.add(sum, w);
        m.store(weights, w);
    }
    s.store(total, sum);
    shrink
}

/// Runs `task` for each (head, part) pair.
pub(crate) fn for_each_part(heads: usize, parts: usize, task: impl Fn(usize, usize) + Sync) {
    (0..heads * parts).into_par_iter().for_each(|i| task(i / parts, i % parts));
}
