//! Products of bf16 factors around a centre.
//!
//! Rounding to bf16 is relative, so what all rows of A have in common costs the precision of what distinguishes them, and that
//! is what a network's answer depends on: tokens and pixels share most of their size. For any row c
//! `A B = (A - 1 c) B + 1 (c B)`: with c near the mean row, only differences are rounded, on either side of the product;
//! `c B` is one row in `f32`, added to the bias while B is packed. Zeros around a map become `-c`.
//!
//! The centre is a mean over some rows at fixed places: it depends on the input only.

use super::resample::add;
use super::shared::SharedMut;
use super::simd::Simd;
use super::source::{Fill, Source};
use super::{Factors, Kernel, dispatch};
use crate::isa::Isa;

/// Rows that the centre is the mean of, at most.
const SAMPLES: usize = 64;

/// Pixels of a centre are repeated to this many numbers, so that lines of narrow ones are taken in long runs.
const LENGTH: usize = 256;

/// The centre of a product's rows (of a map's pixels, several times over): nothing where factors are not rounded.
pub(crate) fn centre_of(isa: Isa, factors: Factors, source: &Source<'_>) -> Option<Vec<f32>> {
    if factors == Factors::F32 || source.channels() == 0 {
        return None;
    }
    let mut centre = vec![0.0; source.channels()];
    dispatch(isa, Centre { source, out: &mut centre });
    match source {
        Source::Flat { .. } => Some(centre),
        Source::Bands(bands) => Some(centre.repeat(LENGTH.div_ceil(bands.channels))),
    }
}

/// What is added to a product's sums: the layer's bias, and with a centre its products with the columns.
pub(crate) enum Bias<'a> {
    Given(Option<&'a [f32]>),
    WithCentre(Vec<f32>),
}

impl<'a> Bias<'a> {
    pub(crate) fn new(bias: Option<&'a [f32]>, centre: Option<&[f32]>, width: usize) -> Self {
        match centre {
            None => Self::Given(bias),
            Some(_) => Self::WithCentre(bias.map_or_else(|| vec![0.0; width], <[f32]>::to_vec)),
        }
    }

    /// Where the centre's products are added.
    pub(crate) fn products(&mut self) -> Option<SharedMut<'_>> {
        match self {
            Self::Given(_) => None,
            Self::WithCentre(sum) => Some(SharedMut::new(sum)),
        }
    }

    /// The columns packed so far are complete.
    pub(crate) fn get(&self) -> Option<&[f32]> {
        match self {
            Self::Given(bias) => *bias,
            Self::WithCentre(sum) => Some(sum),
        }
    }
}

/// Writes the centre of a source, one number per channel, to a slice of that many.
struct Centre<'a> {
    source: &'a Source<'a>,
    out: &'a mut [f32],
}

impl Kernel for Centre<'_> {
    type Output = ();
    #[inline(always)]
    fn run<S: Simd>(self, s: S) {
        let Self { source, out } = self;
        let width = out.len();
        out.fill(0.0);
        let mut line = vec![0.0; width];
        match source {
            Source::Flat { x, .. } => mean(s, x, out, |row, out| add(s, out, row)),
            Source::Bands(bands) => match bands.fill {
                Fill::Copy(x) => mean(s, x, out, |pixel, out| add(s, out, pixel)),
                Fill::Relu(x) => mean(s, x, out, |pixel, out| {
                    line.iter_mut().zip(pixel).for_each(|(to, x)| *to = x.max(0.0));
                    add(s, out, &line);
                }),
                Fill::Resampled(resampled) => {
                    mean(s, resampled.x, out, |pixel, out| add(s, out, pixel));
                    if let Some((by_col, by_row)) = resampled.embedding {
                        let (first, second) = line.split_at_mut(width / 2);
                        mean(s, by_col, first, |row, out| add(s, out, row));
                        mean(s, by_row, second, |row, out| add(s, out, row));
                        add(s, out, &line);
                    }
                }
            },
        }
        // A number that is not finite concerns its own rows only.
        out.iter_mut().filter(|x| !x.is_finite()).for_each(|x| *x = 0.0);
    }
}

/// The mean of some rows of `x`, as wide as `out`, which is zero.
#[inline(always)]
fn mean<S: Simd>(s: S, x: &[f32], out: &mut [f32], mut add_row: impl FnMut(&[f32], &mut [f32])) {
    let width = out.len();
    let rows = x.len().checked_div(width).unwrap_or(0);
    if rows == 0 {
        return;
    }
    let samples = rows.min(SAMPLES);
    for i in 0..samples {
        // In the middle of each of as many equal parts.
        let row = (2 * i + 1) * rows / (2 * samples);
        add_row(&x[row * width..(row + 1) * width], out);
    }
    let scale = s.splat(1.0 / samples as f32);
    for out in out.chunks_mut(S::LANES) {
        s.store_part(out, s.mul(s.load_part(out), scale));
    }
}

/// `Σ x c`, where c is repeated as often as needed.
#[inline(always)]
pub(crate) fn dot_repeated<S: Simd>(s: S, x: &[f32], c: &[f32]) -> f32 {
    let mut sum = s.splat(0.0);
    for x in x.chunks(c.len().max(1)) {
        for (x, c) in x.chunks(S::LANES).zip(c[..x.len()].chunks(S::LANES)) {
            sum = s.fma(s.load_part(x), s.load_part(c), sum);
        }
    }
    s.sum(sum)
}
