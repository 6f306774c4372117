//! The end of a dense head, band by band: resampling, embedding, convolution, activation and the last 1×1 convolution without
//! any map of full size in between.

use std::ops::Range;

use super::gemm::{Panels, multiply};
use super::norm::{NormRef, norm_row};
use super::product::{End, OutLayout, Target};
use super::scratch::{self, Role};
use super::shared::SharedMut;
use super::simd::Simd;
use super::source::{Bands, Source};
use super::tile::Multiply;
use super::{ProductKernel, math, winograd};

/// One branch: a convolution to `middle` channels, a norm where there is one, relu, and a linear map of each pixel.
pub(crate) struct Branch<'a> {
    pub(crate) panels: &'a [u32],
    pub(crate) middle: usize,
    pub(crate) bias: Option<&'a [f32]>,
    pub(crate) norm: Option<NormRef<'a>>,
    /// `[outputs][middle]`
    pub(crate) point: &'a [f32],
    pub(crate) point_bias: Option<&'a [f32]>,
    pub(crate) outputs: usize,
    pub(crate) out: SharedMut<'a>,
}

/// One band of all branches.
pub(crate) struct Band<'a> {
    pub(crate) bands: Bands<'a>,
    pub(crate) branches: &'a [Branch<'a>],
    pub(crate) part: Part,
    pub(crate) centre: Option<&'a [f32]>,
}

/// Which band, by the way in which it is convolved.
pub(crate) enum Part {
    /// A chunk of the product.
    Chunk(usize),
    /// Lines of tiles ([`winograd`]).
    Tiles(Range<usize>),
}

impl ProductKernel for Band<'_> {
    type Output = ();
    #[inline(always)]
    fn run<M: Multiply>(self, m: M) {
        let s = m.simd();
        let source = Source::Bands(self.bands);
        let geometry = source.geometry::<M>();
        let mut scratch = scratch::borrow(Role::Band);
        let width = self.bands.out_cols;
        let (rows, a) = match &self.part {
            Part::Chunk(chunk) => {
                (source.rows(*chunk), source.prepare(m, &geometry, *chunk, self.centre, &mut scratch))
            }
            Part::Tiles(lines) => {
                let end = (2 * lines.end).min(self.bands.out_rows);
                (2 * lines.start * width..end * width, &[][..])
            }
        };
        let panel = 2 * M::Simd::LANES;
        for branch in self.branches {
            let n = branch.middle;
            let mut between = scratch::borrow(Role::Middle);
            let between = between.floats(rows.len() * n + n);
            let (line, between) = between.split_at_mut(n);
            let between = &mut between[..rows.len() * n];
            let layout = OutLayout { line: usize::MAX, line_stride: 0, row_stride: n, offset: 0 };
            let end = if branch.norm.is_some() { End::Store } else { End::Relu };
            let target = Target { width: n, bias: branch.bias, end, layout, out: SharedMut::new(between) };
            let count = n.div_ceil(panel);
            match &self.part {
                Part::Chunk(_) => {
                    let panels = Panels { words: branch.panels, first: 0, count, per_unit: 1 };
                    multiply(m, a, &geometry, rows.clone(), rows.start, panels, 0..count, &target);
                }
                Part::Tiles(lines) => {
                    let panels = winograd::Panels { words: branch.panels, first: 0, count };
                    winograd::convolve(m, &self.bands, lines.clone(), rows.start, panels, &target);
                }
            }
            // SAFETY: the bands' pixels are disjoint.
            let out = unsafe { branch.out.part(rows.start * branch.outputs, rows.len() * branch.outputs) };
            for (middle, out) in between.chunks_exact_mut(n).zip(out.chunks_exact_mut(branch.outputs)) {
                if let Some(norm) = branch.norm {
                    norm_row(s, norm, middle, line);
                    for (to, from) in middle.chunks_mut(M::Simd::LANES).zip(line.chunks(M::Simd::LANES)) {
                        s.store_part(to, math::relu(s, s.load_part(from)));
                    }
                }
                point(s, branch, middle, out);
            }
        }
    }
}

/// The linear map of one pixel.
#[inline(always)]
fn point<S: Simd>(s: S, branch: &Branch<'_>, x: &[f32], out: &mut [f32]) {
    for (o, (out, weights)) in out.iter_mut().zip(branch.point.chunks_exact(branch.middle)).enumerate() {
        let mut sum = s.splat(0.0);
        for (x, w) in x.chunks(S::LANES).zip(weights.chunks(S::LANES)) {
            sum = s.fma(s.load_part(x), s.load_part(w), sum);
        }
        *out = s.sum(sum) + branch.point_bias.map_or(0.0, |bias| bias[o]);
    }
}
