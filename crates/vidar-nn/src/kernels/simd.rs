//! Vectors of `f32`, one type for each kernel set.

/// A kernel set as a token: its existence proves that the processor has the features, so its methods are safe.
///
/// Comparisons follow x86: `max(a, b)` and `min(a, b)` give `b` when either is NaN.
pub(crate) trait Simd: Copy + Send + Sync + 'static {
    /// `LANES` numbers.
    type V: Copy;
    const LANES: usize;
    /// Rows of a product's tile of two vectors: as many as the registers hold.
    const TILE_ROWS: usize;

    fn splat(self, x: f32) -> Self::V;
    /// The first `LANES` numbers of a slice that has at least as many.
    fn load(self, x: &[f32]) -> Self::V;
    fn store(self, x: &mut [f32], v: Self::V);
    /// A slice of at most `LANES` numbers, filled up with zeros.
    fn load_part(self, x: &[f32]) -> Self::V;
    /// Stores as many numbers as the slice holds, at most `LANES`.
    fn store_part(self, x: &mut [f32], v: Self::V);
    /// # Safety
    /// `x` must be readable for `LANES` numbers; no alignment is needed.
    unsafe fn load_at(self, x: *const f32) -> Self::V;

    fn add(self, a: Self::V, b: Self::V) -> Self::V;
    fn sub(self, a: Self::V, b: Self::V) -> Self::V;
    fn mul(self, a: Self::V, b: Self::V) -> Self::V;
    fn div(self, a: Self::V, b: Self::V) -> Self::V;
    /// `a * b + c`, rounded once where the processor can.
    fn fma(self, a: Self::V, b: Self::V, c: Self::V) -> Self::V;
    fn max(self, a: Self::V, b: Self::V) -> Self::V;
    fn min(self, a: Self::V, b: Self::V) -> Self::V;
    fn abs(self, a: Self::V) -> Self::V;
    /// To the nearest integer, ties to even; |a| below 2^22.
    fn round(self, a: Self::V) -> Self::V;
    /// `a * 2^n` for an integral `n` in -252..=252; results below the normal range may become zero.
    fn scale_by_power(self, a: Self::V, n: Self::V) -> Self::V;
    fn sum(self, a: Self::V) -> f32;
    fn maximum(self, a: Self::V) -> f32;
    /// `to[k * to_stride + j] = from[j * from_stride + k]` for j and k below `LANES`.
    ///
    /// # Safety
    /// These words must be readable and writable.
    #[inline(always)]
    unsafe fn transpose(self, from: *const u32, from_stride: usize, to: *mut u32, to_stride: usize) {
        for k in 0..Self::LANES {
            for j in 0..Self::LANES {
                // SAFETY: the caller's promise.
                unsafe { *to.add(k * to_stride + j) = *from.add(j * from_stride + k) };
            }
        }
    }
}

/// A kernel set that multiplies bf16.
pub(crate) trait SimdBf16: Simd {
    /// `LANES` pairs of bf16.
    type H: Copy;
    /// # Safety
    /// `x` must be readable for `LANES` words; no alignment is needed.
    unsafe fn load_pairs(self, x: *const u32) -> Self::H;
    fn splat_pair(self, pair: u32) -> Self::H;
    /// `acc + a.0 * b.0 + a.1 * b.1` in each lane.
    fn dot(self, a: Self::H, b: Self::H, acc: Self::V) -> Self::V;
    /// Rounds to nearest even and stores `LANES` numbers.
    ///
    /// # Safety
    /// `x` must be writable for `LANES` numbers; no alignment is needed.
    unsafe fn store_bf16(self, x: *mut u16, v: Self::V);
}

/// Plain Rust; the compiler vectorises it for the target's baseline.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Portable;

const LANES: usize = 8;

impl Portable {
    #[inline(always)]
    fn zip(a: [f32; LANES], b: [f32; LANES], f: impl Fn(f32, f32) -> f32) -> [f32; LANES] {
        std::array::from_fn(|i| f(a[i], b[i]))
    }
}

impl Simd for Portable {
    type V = [f32; LANES];
    const LANES: usize = LANES;
    const TILE_ROWS: usize = 3;

    #[inline(always)]
    fn splat(self, x: f32) -> Self::V {
        [x; LANES]
    }
    #[inline(always)]
    fn load(self, x: &[f32]) -> Self::V {
        std::array::from_fn(|i| x[..LANES][i])
    }
    #[inline(always)]
    fn store(self, x: &mut [f32], v: Self::V) {
        x[..LANES].copy_from_slice(&v);
    }
    #[inline(always)]
    fn load_part(self, x: &[f32]) -> Self::V {
        let mut v = [0.0; LANES];
        v[..x.len()].copy_from_slice(x);
        v
    }
    #[inline(always)]
    fn store_part(self, x: &mut [f32], v: Self::V) {
        let n = x.len().min(LANES);
        x[..n].copy_from_slice(&v[..n]);
    }
    #[inline(always)]
    unsafe fn load_at(self, x: *const f32) -> Self::V {
        // SAFETY: readable for LANES numbers by the caller's promise; arrays of f32 may be read unaligned.
        unsafe { x.cast::<[f32; LANES]>().read_unaligned() }
    }
    #[inline(always)]
    fn add(self, a: Self::V, b: Self::V) -> Self::V {
        Self::zip(a, b, |a, b| a + b)
    }
    #[inline(always)]
    fn sub(self, a: Self::V, b: Self::V) -> Self::V {
        Self::zip(a, b, |a, b| a - b)
    }
    #[inline(always)]
    fn mul(self, a: Self::V, b: Self::V) -> Self::V {
        Self::zip(a, b, |a, b| a * b)
    }
    #[inline(always)]
    fn div(self, a: Self::V, b: Self::V) -> Self::V {
        Self::zip(a, b, |a, b| a / b)
    }
    #[inline(always)]
    fn fma(self, a: Self::V, b: Self::V, c: Self::V) -> Self::V {
        std::array::from_fn(|i| a[i] * b[i] + c[i])
    }
    #[inline(always)]
    fn max(self, a: Self::V, b: Self::V) -> Self::V {
        Self::zip(a, b, |a, b| if a > b { a } else { b })
    }
    #[inline(always)]
    fn min(self, a: Self::V, b: Self::V) -> Self::V {
        Self::zip(a, b, |a, b| if a < b { a } else { b })
    }
    #[inline(always)]
    fn abs(self, a: Self::V) -> Self::V {
        a.map(f32::abs)
    }
    #[inline(always)]
    fn round(self, a: Self::V) -> Self::V {
        const MAGIC: f32 = 12_582_912.0; // 1.5 * 2^23: adding it leaves no fraction bits, rounded to even
        a.map(|x| (x + MAGIC) - MAGIC)
    }
    #[inline(always)]
    fn scale_by_power(self, a: Self::V, n: Self::V) -> Self::V {
        Self::zip(a, n, |a, n| {
            let n = n as i32;
            let half = n >> 1;
            let power = |e: i32| f32::from_bits(((e + 127).cast_unsigned()) << 23);
            a * power(half) * power(n - half)
        })
    }
    #[inline(always)]
    fn sum(self, a: Self::V) -> f32 {
        ((a[0] + a[4]) + (a[2] + a[6])) + ((a[1] + a[5]) + (a[3] + a[7]))
    }
    #[inline(always)]
    fn maximum(self, a: Self::V) -> f32 {
        a.into_iter().fold(f32::NEG_INFINITY, |m, x| if x > m { x } else { m })
    }
}

/// Emulated, to prove the packing and the loops on machines without bf16 products.
impl SimdBf16 for Portable {
    type H = [u32; LANES];

    #[inline(always)]
    unsafe fn load_pairs(self, x: *const u32) -> Self::H {
        // SAFETY: readable for LANES words by the caller's promise.
        unsafe { x.cast::<[u32; LANES]>().read_unaligned() }
    }
    #[inline(always)]
    fn splat_pair(self, pair: u32) -> Self::H {
        [pair; LANES]
    }
    #[inline(always)]
    fn dot(self, a: Self::H, b: Self::H, acc: Self::V) -> Self::V {
        let (low, high) = (|x: u32| f32::from_bits(x << 16), |x: u32| f32::from_bits(x & 0xFFFF_0000));
        std::array::from_fn(|i| acc[i] + high(a[i]) * high(b[i]) + low(a[i]) * low(b[i]))
    }
    #[inline(always)]
    unsafe fn store_bf16(self, x: *mut u16, v: Self::V) {
        // SAFETY: writable for LANES numbers by the caller's promise.
        unsafe { x.cast::<[u16; LANES]>().write_unaligned(v.map(|x| half::bf16::from_f32(x).to_bits())) }
    }
}
