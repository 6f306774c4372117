//! AVX2 and AVX-512 vectors.
//!
//! Every method calls intrinsics of features that the token's existence proves; tokens are only made in
//! `dispatch`, after detection.

use std::arch::x86_64::*;

use super::simd::{Simd, SimdBf16};

/// AVX2 and FMA: eight lanes.
#[derive(Clone, Copy)]
pub(crate) struct Avx2(());

impl Avx2 {
    /// # Safety
    /// The processor must have AVX2 and FMA.
    #[inline(always)]
    pub(crate) unsafe fn new() -> Self {
        Self(())
    }
}

/// The first n of eight lanes, as a mask for `maskload`.
#[inline(always)]
fn mask8(n: usize) -> __m256i {
    static ONES: [i32; 16] = [-1, -1, -1, -1, -1, -1, -1, -1, 0, 0, 0, 0, 0, 0, 0, 0];
    // SAFETY: 8 - min(n, 8) + 8 <= 16 words are readable; AVX is proved by the callers' token.
    unsafe { _mm256_loadu_si256(ONES.as_ptr().add(8 - n.min(8)).cast()) }
}

// SAFETY of every block below: the token proves AVX2 and FMA; memory is inside the slices as checked, or promised by the
// callers of the unsafe methods.
impl Simd for Avx2 {
    type V = __m256;
    const LANES: usize = 8;
    const TILE_ROWS: usize = 6;

    #[inline(always)]
    fn splat(self, x: f32) -> __m256 {
        // SAFETY: see above.
        unsafe { _mm256_set1_ps(x) }
    }
    #[inline(always)]
    fn load(self, x: &[f32]) -> __m256 {
        assert!(x.len() >= 8);
        // SAFETY: see above; eight numbers are readable.
        unsafe { _mm256_loadu_ps(x.as_ptr()) }
    }
    #[inline(always)]
    fn store(self, x: &mut [f32], v: __m256) {
        assert!(x.len() >= 8);
        // SAFETY: see above; eight numbers are writable.
        unsafe { _mm256_storeu_ps(x.as_mut_ptr(), v) }
    }
    #[inline(always)]
    fn load_part(self, x: &[f32]) -> __m256 {
        if x.len() >= 8 {
            return self.load(x);
        }
        // SAFETY: see above; masked lanes are not touched.
        unsafe { _mm256_maskload_ps(x.as_ptr(), mask8(x.len())) }
    }
    #[inline(always)]
    fn store_part(self, x: &mut [f32], v: __m256) {
        // Masked stores are slow on some processors, so whole vectors do without.
        if x.len() >= 8 {
            return self.store(x, v);
        }
        // SAFETY: see above; masked lanes are not touched.
        unsafe { _mm256_maskstore_ps(x.as_mut_ptr(), mask8(x.len()), v) }
    }
    #[inline(always)]
    unsafe fn load_at(self, x: *const f32) -> __m256 {
        // SAFETY: see above.
        unsafe { _mm256_loadu_ps(x) }
    }
    #[inline(always)]
    fn add(self, a: __m256, b: __m256) -> __m256 {
        // SAFETY: see above.
        unsafe { _mm256_add_ps(a, b) }
    }
    #[inline(always)]
    fn sub(self, a: __m256, b: __m256) -> __m256 {
        // SAFETY: see above.
        unsafe { _mm256_sub_ps(a, b) }
    }
    #[inline(always)]
    fn mul(self, a: __m256, b: __m256) -> __m256 {
        // SAFETY: see above.
        unsafe { _mm256_mul_ps(a, b) }
    }
    #[inline(always)]
    fn div(self, a: __m256, b: __m256) -> __m256 {
        // SAFETY: see above.
        unsafe { _mm256_div_ps(a, b) }
    }
    #[inline(always)]
    fn fma(self, a: __m256, b: __m256, c: __m256) -> __m256 {
        // SAFETY: see above.
        unsafe { _mm256_fmadd_ps(a, b, c) }
    }
    #[inline(always)]
    fn max(self, a: __m256, b: __m256) -> __m256 {
        // SAFETY: see above.
        unsafe { _mm256_max_ps(a, b) }
    }
    #[inline(always)]
    fn min(self, a: __m256, b: __m256) -> __m256 {
        // SAFETY: see above.
        unsafe { _mm256_min_ps(a, b) }
    }
    #[inline(always)]
    fn abs(self, a: __m256) -> __m256 {
        // SAFETY: see above.
        unsafe { _mm256_andnot_ps(_mm256_set1_ps(-0.0), a) }
    }
    #[inline(always)]
    fn round(self, a: __m256) -> __m256 {
        // SAFETY: see above.
        unsafe { _mm256_round_ps::<{ _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC }>(a) }
    }
    #[inline(always)]
    fn scale_by_power(self, a: __m256, n: __m256) -> __m256 {
        // SAFETY: see above.
        unsafe {
            let n = _mm256_cvtps_epi32(n);
            let half = _mm256_srai_epi32::<1>(n);
            let rest = _mm256_sub_epi32(n, half);
            let bias = _mm256_set1_epi32(127);
            let p = _mm256_castsi256_ps(_mm256_slli_epi32::<23>(_mm256_add_epi32(half, bias)));
            let q = _mm256_castsi256_ps(_mm256_slli_epi32::<23>(_mm256_add_epi32(rest, bias)));
            _mm256_mul_ps(_mm256_mul_ps(a, p), q)
        }
    }
    #[inline(always)]
    fn sum(self, a: __m256) -> f32 {
        // SAFETY: see above.
        unsafe {
            let x = _mm_add_ps(_mm256_castps256_ps128(a), _mm256_extractf128_ps::<1>(a));
            let x = _mm_add_ps(x, _mm_movehl_ps(x, x));
            _mm_cvtss_f32(_mm_add_ss(x, _mm_movehdup_ps(x)))
        }
    }
    #[inline(always)]
    fn maximum(self, a: __m256) -> f32 {
        // SAFETY: see above.
        unsafe {
            let x = _mm_max_ps(_mm256_castps256_ps128(a), _mm256_extractf128_ps::<1>(a));
            let x = _mm_max_ps(x, _mm_movehl_ps(x, x));
            _mm_cvtss_f32(_mm_max_ss(x, _mm_movehdup_ps(x)))
        }
    }
    #[inline(always)]
    unsafe fn transpose(self, from: *const u32, from_stride: usize, to: *mut u32, to_stride: usize) {
        // SAFETY: see above, and the caller's promise.
        unsafe {
            let r: [__m256i; 8] =
                std::array::from_fn(|j| _mm256_loadu_si256(from.add(j * from_stride).cast()));
            // Row pairs, then fours: lane l of four[i][c] is column 4l + c of rows 4i to 4i + 3.
            let pairs: [[__m256i; 2]; 4] = std::array::from_fn(|i| {
                let (a, b) = (r[2 * i], r[2 * i + 1]);
                [_mm256_unpacklo_epi32(a, b), _mm256_unpackhi_epi32(a, b)]
            });
            let four: [[__m256i; 4]; 2] = std::array::from_fn(|i| {
                let (a, b) = (pairs[2 * i], pairs[2 * i + 1]);
                [
                    _mm256_unpacklo_epi64(a[0], b[0]),
                    _mm256_unpackhi_epi64(a[0], b[0]),
                    _mm256_unpacklo_epi64(a[1], b[1]),
                    _mm256_unpackhi_epi64(a[1], b[1]),
                ]
            });
            for (c, (a, b)) in four[0].into_iter().zip(four[1]).enumerate() {
                let columns =
                    [_mm256_permute2x128_si256::<0x20>(a, b), _mm256_permute2x128_si256::<0x31>(a, b)];
                for (lane, column) in columns.into_iter().enumerate() {
                    _mm256_storeu_si256(to.add((4 * lane + c) * to_stride).cast(), column);
                }
            }
        }
    }
}

/// AVX-512 F, BW, DQ and VL: sixteen lanes. `BF16` says that AVX-512-BF16 is there too.
#[derive(Clone, Copy)]
pub(crate) struct Avx512<const BF16: bool>(());

impl<const BF16: bool> Avx512<BF16> {
    /// # Safety
    /// The processor must have the features named above.
    #[inline(always)]
    pub(crate) unsafe fn new() -> Self {
        Self(())
    }
}

#[inline(always)]
fn mask16(n: usize) -> u16 {
    if n >= 16 { u16::MAX } else { (1 << n) - 1 }
}

// SAFETY of every block below: the token proves AVX-512; memory is inside the slices as checked, or promised by the
// callers of the unsafe methods.
impl<const BF16: bool> Simd for Avx512<BF16> {
    type V = __m512;
    const LANES: usize = 16;
    const TILE_ROWS: usize = 12;

    #[inline(always)]
    fn splat(self, x: f32) -> __m512 {
        // SAFETY: see above.
        unsafe { _mm512_set1_ps(x) }
    }
    #[inline(always)]
    fn load(self, x: &[f32]) -> __m512 {
        assert!(x.len() >= 16);
        // SAFETY: see above; sixteen numbers are readable.
        unsafe { _mm512_loadu_ps(x.as_ptr()) }
    }
    #[inline(always)]
    fn store(self, x: &mut [f32], v: __m512) {
        assert!(x.len() >= 16);
        // SAFETY: see above; sixteen numbers are writable.
        unsafe { _mm512_storeu_ps(x.as_mut_ptr(), v) }
    }
    #[inline(always)]
    fn load_part(self, x: &[f32]) -> __m512 {
        // SAFETY: see above; masked lanes are not touched.
        unsafe { _mm512_maskz_loadu_ps(mask16(x.len()), x.as_ptr()) }
    }
    #[inline(always)]
    fn store_part(self, x: &mut [f32], v: __m512) {
        // SAFETY: see above; masked lanes are not touched.
        unsafe { _mm512_mask_storeu_ps(x.as_mut_ptr(), mask16(x.len()), v) }
    }
    #[inline(always)]
    unsafe fn load_at(self, x: *const f32) -> __m512 {
        // SAFETY: see above.
        unsafe { _mm512_loadu_ps(x) }
    }
    #[inline(always)]
    fn add(self, a: __m512, b: __m512) -> __m512 {
        // SAFETY: see above.
        unsafe { _mm512_add_ps(a, b) }
    }
    #[inline(always)]
    fn sub(self, a: __m512, b: __m512) -> __m512 {
        // SAFETY: see above.
        unsafe { _mm512_sub_ps(a, b) }
    }
    #[inline(always)]
    fn mul(self, a: __m512, b: __m512) -> __m512 {
        // SAFETY: see above.
        unsafe { _mm512_mul_ps(a, b) }
    }
    #[inline(always)]
    fn div(self, a: __m512, b: __m512) -> __m512 {
        // SAFETY: see above.
        unsafe { _mm512_div_ps(a, b) }
    }
    #[inline(always)]
    fn fma(self, a: __m512, b: __m512, c: __m512) -> __m512 {
        // SAFETY: see above.
        unsafe { _mm512_fmadd_ps(a, b, c) }
    }
    #[inline(always)]
    fn max(self, a: __m512, b: __m512) -> __m512 {
        // SAFETY: see above.
        unsafe { _mm512_max_ps(a, b) }
    }
    #[inline(always)]
    fn min(self, a: __m512, b: __m512) -> __m512 {
        // SAFETY: see above.
        unsafe { _mm512_min_ps(a, b) }
    }
    #[inline(always)]
    fn abs(self, a: __m512) -> __m512 {
        // SAFETY: see above.
        unsafe { _mm512_abs_ps(a) }
    }
    #[inline(always)]
    fn round(self, a: __m512) -> __m512 {
        // SAFETY: see above.
        unsafe { _mm512_roundscale_ps::<{ _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC }>(a) }
    }
    #[inline(always)]
    fn scale_by_power(self, a: __m512, n: __m512) -> __m512 {
        // SAFETY: see above.
        unsafe { _mm512_scalef_ps(a, n) }
    }
    #[inline(always)]
    fn sum(self, a: __m512) -> f32 {
        // SAFETY: see above.
        unsafe { _mm512_reduce_add_ps(a) }
    }
    #[inline(always)]
    fn maximum(self, a: __m512) -> f32 {
        // SAFETY: see above.
        unsafe { _mm512_reduce_max_ps(a) }
    }
    #[inline(always)]
    unsafe fn transpose(self, from: *const u32, from_stride: usize, to: *mut u32, to_stride: usize) {
        // SAFETY: see above, and the caller's promise.
        unsafe {
            let r: [__m512i; 16] =
                std::array::from_fn(|j| _mm512_loadu_si512(from.add(j * from_stride).cast()));
            // Row pairs, then fours: lane l of four[i][c] is column 4l + c of rows 4i to 4i + 3.
            let pairs: [[__m512i; 2]; 8] = std::array::from_fn(|i| {
                let (a, b) = (r[2 * i], r[2 * i + 1]);
                [_mm512_unpacklo_epi32(a, b), _mm512_unpackhi_epi32(a, b)]
            });
            let four: [[__m512i; 4]; 4] = std::array::from_fn(|i| {
                let (a, b) = (pairs[2 * i], pairs[2 * i + 1]);
                [
                    _mm512_unpacklo_epi64(a[0], b[0]),
                    _mm512_unpackhi_epi64(a[0], b[0]),
                    _mm512_unpacklo_epi64(a[1], b[1]),
                    _mm512_unpackhi_epi64(a[1], b[1]),
                ]
            });
            for c in 0..4 {
                // Even lanes (0x88) and odd ones (0xdd), twice: columns c and 8 + c, 4 + c and 12 + c.
                let [a, b, e, f] = [four[0][c], four[1][c], four[2][c], four[3][c]];
                let even = [_mm512_shuffle_i32x4::<0x88>(a, b), _mm512_shuffle_i32x4::<0x88>(e, f)];
                let odd = [_mm512_shuffle_i32x4::<0xdd>(a, b), _mm512_shuffle_i32x4::<0xdd>(e, f)];
                let columns = [
                    _mm512_shuffle_i32x4::<0x88>(even[0], even[1]),
                    _mm512_shuffle_i32x4::<0x88>(odd[0], odd[1]),
                    _mm512_shuffle_i32x4::<0xdd>(even[0], even[1]),
                    _mm512_shuffle_i32x4::<0xdd>(odd[0], odd[1]),
                ];
                for (lane, column) in columns.into_iter().enumerate() {
                    _mm512_storeu_si512(to.add((4 * lane + c) * to_stride).cast(), column);
                }
            }
        }
    }
}

// SAFETY of every block below: the token proves AVX-512-BF16 as well.
impl SimdBf16 for Avx512<true> {
    type H = __m512bh;

    #[inline(always)]
    unsafe fn load_pairs(self, x: *const u32) -> __m512bh {
        // SAFETY: see above; both types are 64 bytes of any content.
        unsafe { std::mem::transmute::<__m512i, __m512bh>(_mm512_loadu_si512(x.cast())) }
    }
    #[inline(always)]
    fn splat_pair(self, pair: u32) -> __m512bh {
        // SAFETY: see above.
        unsafe { std::mem::transmute::<__m512i, __m512bh>(_mm512_set1_epi32(pair.cast_signed())) }
    }
    #[inline(always)]
    fn dot(self, a: __m512bh, b: __m512bh, acc: __m512) -> __m512 {
        // SAFETY: see above.
        unsafe { _mm512_dpbf16_ps(acc, a, b) }
    }
    #[inline(always)]
    unsafe fn store_bf16(self, x: *mut u16, v: __m512) {
        // SAFETY: see above; 32 bytes are writable by the caller's promise.
        unsafe {
            let h = std::mem::transmute::<__m256bh, __m256i>(_mm512_cvtneps_pbh(v));
            _mm256_storeu_si256(x.cast(), h);
        }
    }
}
