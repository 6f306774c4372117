//! The innermost loop: a tile of a few rows by two vectors of columns, held in registers over the whole inner dimension.

use super::simd::{Simd, SimdBf16};

/// The largest `ROWS` of any way to multiply.
pub(crate) const MAX_ROWS: usize = 12;

/// Sums of a tile; rows beyond the ones asked for are left alone.
pub(crate) type Sums<S> = [[<S as Simd>::V; 2]; MAX_ROWS];

/// A way to multiply: the number format of the factors and the kernel set.
pub(crate) trait Multiply: Copy + Send + Sync {
    type Simd: Simd;
    /// Format of A's numbers.
    type Number: Copy + Default + Send + Sync;
    /// Numbers of the inner dimension that one word of packed B holds.
    const STEP: usize;
    /// The tallest tile.
    const ROWS: usize;

    fn simd(self) -> Self::Simd;

    /// `f32` numbers as they are, if that is the number format.
    fn direct(x: &[f32]) -> Option<&[Self::Number]>;

    /// Rounds `from` into the number format.
    fn convert(self, from: &[f32], to: &mut [Self::Number]);

    /// Rounds `from - centre` into the number format.
    fn convert_around(self, from: &[f32], centre: &[f32], to: &mut [Self::Number]);

    /// Rounds a vector into the number format.
    fn store(self, to: &mut [Self::Number], v: <Self::Simd as Simd>::V);

    /// A word of packed B from `STEP` numbers of a column.
    fn word(values: &[f32]) -> u32;

    /// Words of scratch as numbers.
    fn numbers(words: &mut [u32]) -> &mut [Self::Number];

    /// `sums[r] = Σ a[r] b` over taps and `steps` words of each, for `rows` rows that lie `a.1` numbers apart.
    ///
    /// # Safety
    /// `rows` is between 1 and `ROWS`. For each row r below `rows` and each tap, `a.0 + r * a.1 + tap`
    /// must be readable for `steps * STEP` numbers, and `b` for `taps * steps * 2 * LANES` words.
    unsafe fn tile(
        self,
        rows: usize,
        a: (*const Self::Number, usize),
        taps: &[usize],
        steps: usize,
        b: *const u32,
        sums: &mut Sums<Self::Simd>,
    );
}

/// Words of a tap of `group` numbers.
pub(crate) fn steps_of<M: Multiply>(group: usize) -> usize {
    group.div_ceil(M::STEP)
}

/// Where tile `i` of a run of `n` rows starts. Heights are as equal as possible: a last tile of one row would cost as much as
/// one of four.
#[inline(always)]
pub(crate) fn tile_start(n: usize, i: usize, tiles: usize) -> usize {
    i * n / tiles
}

/// Calls a function for a number of rows that is only known at run time; numbers that the kernel set never asks for are not
/// compiled.
macro_rules! by_rows {
    ($simd:ty, $rows:expr, $function:ident($($argument:expr),*)) => {
        by_rows!(@ $simd, $rows, $function($($argument),*), 12 11 10 9 8 7 6 5 4 3 2 1)
    };
    (@ $simd:ty, $rows:expr, $function:ident $arguments:tt, $($r:literal)*) => {
        match $rows {
            $($r if $r <= <$simd>::TILE_ROWS => by_rows!(@@ $function, $r, $arguments),)*
            _ => debug_assert!(false, "a tile of {} rows", $rows),
        }
    };
    (@@ $function:ident, $r:literal, ($($argument:expr),*)) => {
        $function::<_, $r>($($argument),*)
    };
}

/// Factors in `f32`.
#[derive(Clone, Copy)]
pub(crate) struct InF32<S>(pub(crate) S);

impl<S: Simd> Multiply for InF32<S> {
    type Simd = S;
    type Number = f32;
    const STEP: usize = 1;
    const ROWS: usize = S::TILE_ROWS;

    #[inline(always)]
    fn simd(self) -> S {
        self.0
    }

    #[inline(always)]
    fn direct(x: &[f32]) -> Option<&[f32]> {
        Some(x)
    }

    #[inline(always)]
    fn convert(self, from: &[f32], to: &mut [f32]) {
        to.copy_from_slice(from);
    }

    #[inline(always)]
    fn convert_around(self, from: &[f32], centre: &[f32], to: &mut [f32]) {
        to.iter_mut().zip(from).zip(centre).for_each(|((to, x), c)| *to = x - c);
    }

    #[inline(always)]
    fn store(self, to: &mut [f32], v: S::V) {
        self.0.store(to, v);
    }

    #[inline(always)]
    fn word(values: &[f32]) -> u32 {
        values[0].to_bits()
    }

    #[inline(always)]
    fn numbers(words: &mut [u32]) -> &mut [f32] {
        super::scratch::as_floats_mut(words)
    }

    #[inline(always)]
    unsafe fn tile(
        self,
        rows: usize,
        (a, stride): (*const f32, usize),
        taps: &[usize],
        steps: usize,
        b: *const u32,
        sums: &mut Sums<S>,
    ) {
        // SAFETY: the caller's promise.
        unsafe { by_rows!(S, rows, f32_tile(self.0, a, stride, taps, steps, b.cast(), sums)) }
    }
}

/// # Safety
/// As [`Multiply::tile`], for `R` rows.
#[inline(always)]
unsafe fn f32_tile<S: Simd, const R: usize>(
    s: S,
    a: *const f32,
    stride: usize,
    taps: &[usize],
    steps: usize,
    mut b: *const f32,
    sums: &mut Sums<S>,
) {
    let mut acc = [[s.splat(0.0); 2]; R];
    for tap in taps {
        // SAFETY: all addresses are inside what the caller promises.
        unsafe {
            let a = a.add(*tap);
            for k in 0..steps {
                let (left, right) = (s.load_at(b), s.load_at(b.add(S::LANES)));
                b = b.add(2 * S::LANES);
                for r in 0..R {
                    let x = s.splat(*a.add(r * stride + k));
                    acc[r] = [s.fma(x, left, acc[r][0]), s.fma(x, right, acc[r][1])];
                }
            }
        }
    }
    sums[..R].copy_from_slice(&acc);
}

/// Factors in bf16, two to a word; sums in `f32`.
#[derive(Clone, Copy)]
pub(crate) struct InBf16<S>(pub(crate) S);

impl<S: SimdBf16> Multiply for InBf16<S> {
    type Simd = S;
    type Number = u16;
    const STEP: usize = 2;
    const ROWS: usize = S::TILE_ROWS;

    #[inline(always)]
    fn simd(self) -> S {
        self.0
    }

    #[inline(always)]
    fn direct(_: &[f32]) -> Option<&[u16]> {
        None
    }

    #[inline(always)]
    fn convert(self, from: &[f32], to: &mut [u16]) {
        let s = self.0;
        let whole = from.len() / S::LANES * S::LANES;
        for (from, to) in from.chunks_exact(S::LANES).zip(to.chunks_exact_mut(S::LANES)) {
            // SAFETY: the chunk has room for LANES numbers.
            unsafe { s.store_bf16(to.as_mut_ptr(), s.load(from)) };
        }
        for (from, to) in from[whole..].iter().zip(&mut to[whole..]) {
            *to = half::bf16::from_f32(*from).to_bits();
        }
    }

    #[inline(always)]
    fn convert_around(self, from: &[f32], centre: &[f32], to: &mut [u16]) {
        let s = self.0;
        let whole = from.len() / S::LANES * S::LANES;
        for ((from, centre), to) in
            from.chunks_exact(S::LANES).zip(centre.chunks_exact(S::LANES)).zip(to.chunks_exact_mut(S::LANES))
        {
            // SAFETY: the chunk has room for LANES numbers.
            unsafe { s.store_bf16(to.as_mut_ptr(), s.sub(s.load(from), s.load(centre))) };
        }
        for ((from, centre), to) in from[whole..].iter().zip(&centre[whole..]).zip(&mut to[whole..]) {
            *to = half::bf16::from_f32(*from - *centre).to_bits();
        }
    }

    #[inline(always)]
    fn store(self, to: &mut [u16], v: S::V) {
        assert!(to.len() >= S::LANES);
        // SAFETY: there is room for LANES numbers.
        unsafe { self.0.store_bf16(to.as_mut_ptr(), v) };
    }

    #[inline(always)]
    fn word(values: &[f32]) -> u32 {
        let half = |i: usize| values.get(i).map_or(0, |x| u32::from(half::bf16::from_f32(*x).to_bits()));
        half(0) | half(1) << 16
    }

    #[inline(always)]
    fn numbers(words: &mut [u32]) -> &mut [u16] {
        super::scratch::as_halves_mut(words)
    }

    #[inline(always)]
    unsafe fn tile(
        self,
        rows: usize,
        (a, stride): (*const u16, usize),
        taps: &[usize],
        steps: usize,
        b: *const u32,
        sums: &mut Sums<S>,
    ) {
        // SAFETY: the caller's promise.
        unsafe { by_rows!(S, rows, bf16_tile(self.0, a, stride, taps, steps, b, sums)) }
    }
}

/// # Safety
/// As [`Multiply::tile`], for `R` rows.
#[inline(always)]
unsafe fn bf16_tile<S: SimdBf16, const R: usize>(
    s: S,
    a: *const u16,
    stride: usize,
    taps: &[usize],
    steps: usize,
    mut b: *const u32,
    sums: &mut Sums<S>,
) {
    let mut acc = [[s.splat(0.0); 2]; R];
    for tap in taps {
        // SAFETY: all addresses are inside what the caller promises; pairs need no alignment.
        unsafe {
            let a = a.add(*tap);
            for k in 0..steps {
                let (left, right) = (s.load_pairs(b), s.load_pairs(b.add(S::LANES)));
                b = b.add(2 * S::LANES);
                for r in 0..R {
                    let x = s.splat_pair(a.add(r * stride + 2 * k).cast::<u32>().read_unaligned());
                    acc[r] = [s.dot(x, left, acc[r][0]), s.dot(x, right, acc[r][1])];
                }
            }
        }
    }
    sums[..R].copy_from_slice(&acc);
}
