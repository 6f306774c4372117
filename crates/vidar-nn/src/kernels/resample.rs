//! Bilinear resampling line by line, with an embedding of the grid added.

use super::simd::Simd;

/// One output index: two inputs and the weight of the second.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Tap {
    pub(crate) low: usize,
    pub(crate) high: usize,
    pub(crate) t: f32,
}

/// A map of `cols` pixels a row, resampled to the taps' grid.
pub(crate) struct Resampled<'a> {
    pub(crate) x: &'a [f32],
    pub(crate) cols: usize,
    pub(crate) channels: usize,
    pub(crate) ys: &'a [Tap],
    pub(crate) xs: &'a [Tap],
    /// Added: the first half of the channels by column (`[cols][channels / 2]`), the second by row.
    pub(crate) embedding: Option<(&'a [f32], &'a [f32])>,
}

impl Resampled<'_> {
    /// Output row `row`.
    #[inline(always)]
    pub(crate) fn line<S: Simd>(&self, s: S, row: usize, out: &mut [f32]) {
        let c = self.channels;
        let y = self.ys[row];
        let line = self.cols * c;
        let (top, bottom) = (&self.x[y.low * line..][..line], &self.x[y.high * line..][..line]);
        let ty = s.splat(y.t);
        for (x, (out, tap)) in out.chunks_exact_mut(c).zip(self.xs).enumerate() {
            let (l, r) = (tap.low * c, tap.high * c);
            let (tl, tr, bl, br) = (&top[l..l + c], &top[r..r + c], &bottom[l..l + c], &bottom[r..r + c]);
            let tx = s.splat(tap.t);
            let lerp = |a: S::V, b: S::V, t: S::V| s.fma(s.sub(b, a), t, a);
            let mut at = 0;
            while at + S::LANES <= c {
                let upper = lerp(s.load(&tl[at..]), s.load(&tr[at..]), tx);
                let lower = lerp(s.load(&bl[at..]), s.load(&br[at..]), tx);
                s.store(&mut out[at..], lerp(upper, lower, ty));
                at += S::LANES;
            }
            if at < c {
                let upper = lerp(s.load_part(&tl[at..]), s.load_part(&tr[at..]), tx);
                let lower = lerp(s.load_part(&bl[at..]), s.load_part(&br[at..]), tx);
                s.store_part(&mut out[at..], lerp(upper, lower, ty));
            }
            if let Some((by_col, by_row)) = self.embedding {
                let half = c / 2;
                let (first, second) = out.split_at_mut(half);
                add(s, first, &by_col[x * half..][..half]);
                add(s, second, &by_row[row * half..][..half]);
            }
        }
    }
}

/// `out += x`.
#[inline(always)]
pub(crate) fn add<S: Simd>(s: S, out: &mut [f32], x: &[f32]) {
    for (out, x) in out.chunks_mut(S::LANES).zip(x.chunks(S::LANES)) {
        s.store_part(out, s.add(s.load_part(out), s.load_part(x)));
    }
}
