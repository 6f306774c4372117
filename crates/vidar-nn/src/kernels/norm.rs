//! Layer normalisation of one row, in vectors.

use super::simd::Simd;

/// A layer norm's numbers.
#[derive(Debug, Clone, Copy)]
pub(crate) struct NormRef<'a> {
    pub(crate) weight: &'a [f32],
    pub(crate) bias: &'a [f32],
    pub(crate) eps: f32,
}

/// `out = (x - mean) / sqrt(variance + eps) * weight + bias`; all slices have the row's length.
///
/// The variance is taken around the mean in a second pass: the one-pass form loses all digits when the mean is large.
#[inline(always)]
pub(crate) fn norm_row<S: Simd>(s: S, norm: NormRef<'_>, x: &[f32], out: &mut [f32]) {
    let n = x.len();
    // Heads of 64 channels, by far the most rows, fit into registers.
    if n == 4 * S::LANES {
        return norm_short::<S, 4>(s, norm, x, out);
    }
    if n == 8 * S::LANES {
        return norm_short::<S, 8>(s, norm, x, out);
    }
    let whole = n / S::LANES * S::LANES;
    let (body, tail) = x.split_at(whole);
    let mut sums = [s.splat(0.0); 4];
    for (i, x) in body.chunks_exact(S::LANES).enumerate() {
        sums[i % 4] = s.add(sums[i % 4], s.load(x));
    }
    sums[0] = s.add(sums[0], s.load_part(tail));
    let centre = s.sum(s.add(s.add(sums[0], sums[1]), s.add(sums[2], sums[3]))) / n as f32;
    let mean = s.splat(centre);
    let mut squares = [s.splat(0.0); 4];
    for (i, x) in body.chunks_exact(S::LANES).enumerate() {
        let d = s.sub(s.load(x), mean);
        squares[i % 4] = s.fma(d, d, squares[i % 4]);
    }
    let mut total = s.sum(s.add(s.add(squares[0], squares[1]), s.add(squares[2], squares[3])));
    for x in tail {
        total += (x - centre) * (x - centre);
    }
    let scale = s.splat(1.0 / (total / n as f32 + norm.eps).sqrt());
    let (out, weight, bias) = (&mut out[..n], &norm.weight[..n], &norm.bias[..n]);
    let mut at = 0;
    while at < n {
        let to = (at + S::LANES).min(n);
        let d = s.mul(s.sub(s.load_part(&x[at..to]), mean), scale);
        s.store_part(&mut out[at..to], s.fma(d, s.load_part(&weight[at..to]), s.load_part(&bias[at..to])));
        at = to;
    }
}

/// A row of `K` vectors, in the same order of sums.
#[inline(always)]
fn norm_short<S: Simd, const K: usize>(s: S, norm: NormRef<'_>, x: &[f32], out: &mut [f32]) {
    let n = K * S::LANES;
    let (x, out, weight, bias) = (&x[..n], &mut out[..n], &norm.weight[..n], &norm.bias[..n]);
    let mut v = [s.splat(0.0); K];
    let mut sums = [s.splat(0.0); 4];
    for i in 0..K {
        v[i] = s.load(&x[i * S::LANES..]);
        sums[i % 4] = s.add(sums[i % 4], v[i]);
    }
    let centre = s.sum(s.add(s.add(sums[0], sums[1]), s.add(sums[2], sums[3]))) / n as f32;
    let mean = s.splat(centre);
    let mut squares = [s.splat(0.0); 4];
    for i in 0..K {
        v[i] = s.sub(v[i], mean);
        squares[i % 4] = s.fma(v[i], v[i], squares[i % 4]);
    }
    let total = s.sum(s.add(s.add(squares[0], squares[1]), s.add(squares[2], squares[3])));
    let scale = s.splat(1.0 / (total / n as f32 + norm.eps).sqrt());
    for i in 0..K {
        let at = i * S::LANES;
        s.store(&mut out[at..], s.fma(s.mul(v[i], scale), s.load(&weight[at..]), s.load(&bias[at..])));
    }
}
