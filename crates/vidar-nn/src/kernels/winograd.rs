//! 3×3 convolutions with 2.25 times fewer multiplications (Lavin and Gray 2016, F(2×2, 3×3)).
//!
//! A tile of 2×2 output pixels depends on 4×4 input pixels d. With the kernel g turned into `U = G g Gᵀ` once and the input
//! into `V = Bᵀ d B`, the outputs are `Aᵀ [Σ U ∘ V] A`: sixteen products over channels instead of thirty-six, and each of the
//! sixteen places is a matrix product of its own over all tiles. The transforms are sums and differences (and halves, of
//! weights); in `f32` they cost about one digit's quarter, in bf16 they would cost most of the digits, so bf16 does without.
//!
//! A task takes some lines of tiles, a segment of a line at a time, so that V and the products stay in the second-level
//! cache. Tiles do not depend on how they are split into tasks.

mod plan;

pub(crate) use plan::Plan;

use std::ops::Range;

use rayon::prelude::*;

use super::pack::{Columns, transpose};
use super::product::{PACKED_WORDS, Product, Target};
use super::scratch::{self, Role};
use super::shape::ShapeOf;
use super::shared::SharedMut;
use super::simd::Simd;
use super::source::{Bands, Fill};
use super::tile::{MAX_ROWS, Multiply, tile_start};
use super::{Factors, ProductKernel, dispatch_product, math};
use crate::compute::{Compute, Precision};

/// Places of a transformed tile.
const PLACES: usize = 16;
/// Bytes of a segment's transformed input, roughly.
const SEGMENT_BYTES: usize = 192 << 10;
/// Tiles of a segment: multiples of every kernel set's tile height.
const SEGMENT_TILES: [usize; 2] = [24, 48];
/// With fewer tiles than this the transform of the weights does not pay.
const WORTHWHILE_TILES: usize = 64;
/// Numbers between the places of a segment: they would otherwise compete for the same cache sets.
const GAP: usize = 16;

/// Whether a convolution is computed this way.
pub(crate) fn is_for(bands: &Bands<'_>, factors: Factors) -> bool {
    factors == Factors::F32
        && bands.kernel == [3, 3]
        && (bands.stride, bands.padding) == (1, 1)
        && bands.channels.is_multiple_of(16)
        && bands.out_rows.div_ceil(2) * bands.out_cols.div_ceil(2) >= WORTHWHILE_TILES
}

/// Words of a packed panel of `panel` columns: `[place][channel][column]`.
pub(crate) fn panel_words(channels: usize, panel: usize) -> usize {
    PLACES * channels * panel
}

/// Transforms and packs one panel of columns.
struct PackPanel<'a> {
    /// Columns `[ky][kx][channel]`.
    columns: &'a dyn Columns,
    channels: usize,
    round_to_f16: bool,
    /// The columns, at most a panel's width.
    range: Range<usize>,
    to: &'a mut [u32],
}

impl ProductKernel for PackPanel<'_> {
    type Output = ();
    #[inline(always)]
    fn run<M: Multiply>(self, m: M) {
        let s = m.simd();
        let (n, panel) = (self.channels, 2 * M::Simd::LANES);
        let mut scratch = scratch::borrow(Role::Columns);
        let (read, rows) = scratch.floats((9 + 12 + PLACES * panel) * n).split_at_mut(9 * n);
        let (turned, rows) = rows.split_at_mut(12 * n);
        let rows = &mut rows[..PLACES * panel * n];
        rows.fill(0.0);
        for (j, column) in self.range.enumerate() {
            self.columns.read(column, read);
            if self.round_to_f16 {
                read.iter_mut().for_each(|x| *x = half::f16::from_f32(*x).to_f32());
            }
            // Along a kernel's columns, then along its rows.
            for kx in 0..3 {
                let g: [&[f32]; 3] = std::array::from_fn(|ky| &read[(3 * ky + kx) * n..][..n]);
                spread(s, g, |place, at, v| s.store(&mut turned[(3 * place + kx) * n..][..n][at..], v));
            }
            for row in 0..4 {
                let g: [&[f32]; 3] = std::array::from_fn(|kx| &turned[(3 * row + kx) * n..][..n]);
                spread(s, g, |place, at, v| {
                    s.store(&mut rows[((4 * row + place) * panel + j) * n..][..n][at..], v);
                });
            }
        }
        let rows = scratch::as_words_mut(rows);
        for (rows, to) in rows.chunks_exact(panel * n).zip(self.to.chunks_exact_mut(panel * n)) {
            transpose(s, rows, n, to);
        }
    }
}

/// `G g` for slices of equal length, whole vectors of every kernel set.
#[inline(always)]
fn spread<S: Simd>(s: S, g: [&[f32]; 3], mut store: impl FnMut(usize, usize, S::V)) {
    let half = s.splat(0.5);
    for at in (0..g[0].len()).step_by(S::LANES) {
        let (a, b, c) = (s.load(&g[0][at..]), s.load(&g[1][at..]), s.load(&g[2][at..]));
        let (outer, middle) = (s.mul(s.add(a, c), half), s.mul(b, half));
        store(0, at, a);
        store(1, at, s.add(outer, middle));
        store(2, at, s.sub(outer, middle));
        store(3, at, c);
    }
}

/// Packed columns: panels from `first` on.
#[derive(Clone, Copy)]
pub(crate) struct Panels<'a> {
    pub(crate) words: &'a [u32],
    pub(crate) first: usize,
    pub(crate) count: usize,
}

/// Convolves some lines of tiles. Row m of the product (an output pixel) goes to row `m - out_start` of the target.
#[inline(always)]
pub(crate) fn convolve<M: Multiply>(
    m: M,
    bands: &Bands<'_>,
    tile_lines: Range<usize>,
    out_start: usize,
    panels: Panels<'_>,
    target: &Target<'_>,
) {
    let (s, n, panel) = (m.simd(), bands.channels, 2 * M::Simd::LANES);
    let tiles = bands.out_cols.div_ceil(2);
    let segment =
        (SEGMENT_BYTES / (4 * PLACES * n).max(1)).clamp(SEGMENT_TILES[0], SEGMENT_TILES[1]) / 12 * 12;
    let stride = n + GAP;
    let place = segment * stride + GAP;
    assert!(panels.words.len() >= panels.count * panel_words(n, panel));

    let mut scratch = scratch::borrow(Role::Block);
    let (v, products) = scratch.words(PLACES * (place + segment * panel)).split_at_mut(PLACES * place);
    let (v, products) = (M::numbers(v), scratch::as_floats_mut(products));
    let products = &mut products[..PLACES * segment * panel];
    let mut made = scratch::borrow(Role::Rows);
    let first = 2 * tile_lines.start;
    let lines = Lines::new(m, bands, first, 2 * tile_lines.len() + 2, &mut made);

    let mut sums = [[s.splat(0.0); 2]; MAX_ROWS];
    let gates = sums;
    for line in tile_lines {
        let rows: [&[f32]; 4] = std::array::from_fn(|i| lines.get(2 * line + i));
        for from in (0..tiles).step_by(segment) {
            let count = segment.min(tiles - from);
            for t in 0..count {
                transform(m, bands, rows, 2 * (from + t), n, &mut v[t * stride..], place);
            }
            for p in 0..panels.count {
                let words = &panels.words[p * panel_words(n, panel)..][..panel_words(n, panel)];
                let parts = count.div_ceil(M::ROWS);
                for i in 0..parts {
                    let start = tile_start(count, i, parts);
                    let height = tile_start(count, i + 1, parts) - start;
                    for at in 0..PLACES {
                        // SAFETY: `height` rows of `n` numbers, and a panel of `n` words.
                        unsafe {
                            let a = v[at * place + start * stride..][..(height - 1) * stride + n].as_ptr();
                            let b = words[at * n * panel..][..n * panel].as_ptr();
                            m.tile(height, (a, stride), &[0], n, b, &mut sums);
                        }
                        let to = &mut products[(at * segment + start) * panel..];
                        for (sums, to) in sums[..height].iter().zip(to.chunks_exact_mut(panel)) {
                            s.store(to, sums[0]);
                            s.store(&mut to[M::Simd::LANES..], sums[1]);
                        }
                    }
                }
                let column = (panels.first + p) * panel;
                for row in 0..2usize.min(bands.out_rows - 2 * line) {
                    let pixels = (2 * from)..(2 * (from + count)).min(bands.out_cols);
                    let start = (2 * line + row) * bands.out_cols - out_start;
                    for x in pixels.clone().step_by(MAX_ROWS) {
                        let wide = MAX_ROWS.min(pixels.end - x);
                        for t in 0..wide.div_ceil(2) {
                            let tile = (x - 2 * from) / 2 + t;
                            let pair = gather(s, &products[tile * panel..], segment * panel, row);
                            sums[2 * t] = pair[0];
                            sums[2 * t + 1] = pair[1];
                        }
                        target.finish(m, &gates, &sums, start + x, wide, column);
                    }
                }
            }
        }
    }
}

/// Input lines of a task; those outside of the map are zeros.
struct Lines<'a> {
    /// Either the map itself or lines that were made, from line `first` (of the map with its border) on.
    map: Option<&'a [f32]>,
    made: &'a [f32],
    zeros: &'a [f32],
    first: usize,
    width: usize,
    rows: usize,
}

impl<'a> Lines<'a> {
    #[inline(always)]
    fn new<M: Multiply>(
        m: M,
        bands: &Bands<'a>,
        first: usize,
        count: usize,
        scratch: &'a mut scratch::Scratch,
    ) -> Self {
        let width = bands.cols * bands.channels;
        let (map, count) = match bands.fill {
            Fill::Copy(x) | Fill::Relu(x) => (Some(x), 0),
            Fill::Resampled(_) => (None, count),
        };
        let (zeros, made) = scratch.floats((count + 1) * width).split_at_mut(width);
        zeros.fill(0.0);
        if let Fill::Resampled(resampled) = bands.fill {
            for (i, to) in made.chunks_exact_mut(width).take(count).enumerate() {
                if let Some(row) = (first + i).checked_sub(1).filter(|row| *row < bands.rows) {
                    resampled.line(m.simd(), row, to);
                }
            }
        }
        Self { map, made, zeros, first, width, rows: bands.rows }
    }

    /// Line `line` of the map with its border of one.
    #[inline(always)]
    fn get(&self, line: usize) -> &[f32] {
        let Some(row) = line.checked_sub(1).filter(|row| *row < self.rows) else {
            return self.zeros;
        };
        match self.map {
            Some(map) => &map[row * self.width..(row + 1) * self.width],
            None => &self.made[(line - self.first) * self.width..][..self.width],
        }
    }
}

/// `Bᵀ d B` of the tile whose first column is `x` (of the map with its border); place i goes to `to[i * place..]`.
#[inline(always)]
fn transform<M: Multiply>(
    m: M,
    bands: &Bands<'_>,
    rows: [&[f32]; 4],
    x: usize,
    n: usize,
    to: &mut [M::Number],
    place: usize,
) {
    let s = m.simd();
    let is_relu = matches!(bands.fill, Fill::Relu(_));
    // Columns of the map, where there are any.
    let columns: [Option<usize>; 4] =
        std::array::from_fn(|i| (x + i).checked_sub(1).filter(|x| *x < bands.cols).map(|x| x * n));
    let zero = s.splat(0.0);
    for at in (0..n).step_by(M::Simd::LANES) {
        let mut half = [[zero; 4]; 4];
        for (j, column) in columns.iter().enumerate() {
            let Some(column) = column else { continue };
            let at = column + at;
            let mut d = [
                s.load(&rows[0][at..]),
                s.load(&rows[1][at..]),
                s.load(&rows[2][at..]),
                s.load(&rows[3][at..]),
            ];
            if is_relu {
                d = [math::relu(s, d[0]), math::relu(s, d[1]), math::relu(s, d[2]), math::relu(s, d[3])];
            }
            let w = turn(s, d);
            for i in 0..4 {
                half[i][j] = w[i];
            }
        }
        for (i, half) in half.into_iter().enumerate() {
            for (j, v) in turn(s, half).into_iter().enumerate() {
                m.store(&mut to[(4 * i + j) * place + at..], v);
            }
        }
    }
}

/// `Bᵀ d`.
#[inline(always)]
fn turn<S: Simd>(s: S, d: [S::V; 4]) -> [S::V; 4] {
    [s.sub(d[0], d[2]), s.add(d[1], d[2]), s.sub(d[2], d[1]), s.sub(d[1], d[3])]
}

/// Row `row` of `Aᵀ m A` of a tile whose place i is at `products[i * place..]`: two pixels.
#[inline(always)]
fn gather<S: Simd>(s: S, products: &[f32], place: usize, row: usize) -> [[S::V; 2]; 2] {
    let mut pixels = [[s.splat(0.0); 2]; 2];
    for half in 0..2 {
        let mut c = [s.splat(0.0); 4];
        for (j, c) in c.iter_mut().enumerate() {
            let of = |i: usize| &products[(4 * i + j) * place + half * S::LANES..];
            let middle = (s.load(of(1)), s.load(of(2)));
            *c = match row {
                0 => s.add(s.add(s.load(of(0)), middle.0), middle.1),
                _ => s.sub(s.sub(middle.0, middle.1), s.load(of(3))),
            };
        }
        pixels[0][half] = s.add(s.add(c[0], c[1]), c[2]);
        pixels[1][half] = s.sub(s.sub(c[1], c[2]), c[3]);
    }
    pixels
}

/// Computes a whole convolution.
pub(crate) fn run(product: &Product<'_>, bands: &Bands<'_>, c: &Compute, out: &mut [f32]) {
    let (isa, factors) = (c.isa(), Factors::of(c));
    let inner = product.source.inner();
    let panel = dispatch_product(isa, factors, ShapeOf { inner }).panel;
    let words = panel_words(bands.channels, panel);
    let all = product.width.div_ceil(panel);
    let at_once = (PACKED_WORDS / words.max(1)).clamp(1, all);
    let target = Target {
        width: product.width,
        bias: product.bias,
        end: product.end,
        layout: product.layout,
        out: SharedMut::new(out),
    };
    let plan = Plan::new(bands);
    let mut packed = scratch::borrow(Role::Panels);
    for first in (0..all).step_by(at_once) {
        let count = at_once.min(all - first);
        let packed = &mut packed.words(count * words)[..count * words];
        pack(c, product.columns, bands.channels, first * panel..product.width, panel, packed);
        let panels = Panels { words: packed, first, count };
        (0..plan.tasks).into_par_iter().for_each(|task| {
            let lines = plan.range(task, bands);
            dispatch_product(isa, factors, Task { bands, lines, panels, target: &target });
        });
    }
}

/// Packs whole panels of columns; those beyond `columns.end` are zeros.
pub(crate) fn pack(
    c: &Compute,
    source: &dyn Columns,
    channels: usize,
    columns: Range<usize>,
    panel: usize,
    to: &mut [u32],
) {
    let (isa, factors) = (c.isa(), Factors::of(c));
    to.par_chunks_exact_mut(panel_words(channels, panel)).enumerate().for_each(|(p, to)| {
        let start = (columns.start + p * panel).min(columns.end);
        let range = start..(start + panel).min(columns.end);
        let round_to_f16 = c.precision() == Precision::F16;
        dispatch_product(isa, factors, PackPanel { columns: source, channels, round_to_f16, range, to });
    });
}

struct Task<'a> {
    bands: &'a Bands<'a>,
    lines: Range<usize>,
    panels: Panels<'a>,
    target: &'a Target<'a>,
}

impl ProductKernel for Task<'_> {
    type Output = ();
    #[inline(always)]
    fn run<M: Multiply>(self, m: M) {
        convolve(m, self.bands, self.lines, 0, self.panels, self.target);
    }
}
