//! Elementary functions on vectors.

use super::simd::Simd;

const LOG2_E: f32 = std::f32::consts::LOG2_E;
/// ln 2 in two parts, the first with few bits so that n * LN2_HIGH is exact.
const LN2_HIGH: f32 = 0.693_359_4;
const LN2_LOW: f32 = -2.121_944_4e-4;

/// e^x with a relative error below 2e-7; 0 below -103.97, infinity above 88.73, NaN stays NaN.
#[inline(always)]
pub(crate) fn exp<S: Simd>(s: S, x: S::V) -> S::V {
    // max(a, b) gives b for NaN, so the limits come first and NaN passes through.
    let x = s.min(s.splat(89.0), s.max(s.splat(-104.0), x));
    let n = s.round(s.mul(x, s.splat(LOG2_E)));
    let r = s.fma(n, s.splat(-LN2_LOW), s.fma(n, s.splat(-LN2_HIGH), x));
    // Taylor coefficients on |r| <= ln 2 / 2: the first term left out is r^8 / 8! < 6e-9.
    let mut p = s.splat(1.0 / 5040.0);
    for c in [1.0 / 720.0, 1.0 / 120.0, 1.0 / 24.0, 1.0 / 6.0, 0.5, 1.0, 1.0] {
        p = s.fma(p, r, s.splat(c));
    }
    s.scale_by_power(p, n)
}

/// 2^x for x <= 0 with a relative error below 2e-7; 0 below -150, NaN stays NaN.
#[inline(always)]
pub(crate) fn exp2_below<S: Simd>(s: S, x: S::V) -> S::V {
    // Least largest relative error on |f| <= 1/2 for this degree: 7.5e-8.
    exp2_polynomial(
        s,
        x,
        [1.327_646_9e-3, 9.675_541e-3, 5.550_713_3e-2, 2.402_212e-1, std::f32::consts::LN_2, 1.000_000_1],
    )
}

/// 2^x for x <= 0 with a relative error below 1e-4: enough for a weight that is rounded to bf16 (4e-3) next.
#[inline(always)]
pub(crate) fn exp2_below_coarse<S: Simd>(s: S, x: S::V) -> S::V {
    exp2_polynomial(s, x, [5.517_164e-2, 2.426_111_2e-1, 6.932_61e-1, 9.999_281e-1])
}

#[inline(always)]
fn exp2_polynomial<S: Simd, const N: usize>(s: S, x: S::V, coefficients: [f32; N]) -> S::V {
    // max(a, b) gives b for NaN, so NaN passes.
    let x = s.max(s.splat(-151.0), x);
    let n = s.round(x);
    let f = s.sub(x, n);
    let mut p = s.splat(coefficients[0]);
    for c in &coefficients[1..] {
        p = s.fma(p, f, s.splat(*c));
    }
    s.scale_by_power(p, n)
}

/// The complementary error function for x >= 0, relative error below 3e-7 + x² 2^-24.
///
/// erfc(x) = e^(-x²) t Q(2t - 1) with t = 1 / (1 + 0.4 x): t Q is the scaled function erfcx, Q a polynomial of degree 8
/// fitted to it for least largest relative error (1.3e-7) over all x >= 0.
#[inline(always)]
pub(crate) fn erfc_positive<S: Simd>(s: S, x: S::V) -> S::V {
    let t = s.div(s.splat(1.0), s.fma(x, s.splat(0.4), s.splat(1.0)));
    let u = s.fma(t, s.splat(2.0), s.splat(-1.0));
    let mut q = s.splat(1.963_364_5e-4);
    for c in [
        1.417_737_2e-4,
        -1.863_044_2e-3,
        -3.335_908_3e-3,
        1.132_411_5e-2,
        6.849_517e-2,
        1.815_679e-1,
        3.218_611e-1,
        4.216_127e-1,
    ] {
        q = s.fma(q, u, s.splat(c));
    }
    s.mul(s.mul(t, q), exp(s, s.mul(s.sub(s.splat(0.0), x), x)))
}

/// GELU in its exact form, x Φ(x) = x/2 · erfc(-x/√2).
///
/// For x < 0 the complement is taken directly, so that the far tail keeps its relative accuracy.
#[inline(always)]
pub(crate) fn gelu<S: Simd>(s: S, x: S::V) -> S::V {
    let zero = s.splat(0.0);
    let tail = erfc_positive(s, s.mul(s.abs(x), s.splat(std::f32::consts::FRAC_1_SQRT_2)));
    // x Φ(x) = max(x, 0) - |x|/2 erfc(|x|/√2) for either sign.
    s.sub(s.max(zero, x), s.mul(s.mul(s.abs(x), s.splat(0.5)), tail))
}

/// GELU with an absolute error below 1e-4: enough for a number that is rounded to bf16 next.
///
/// x Φ(x) with Φ - 1/2 an odd polynomial on |x| <= 4.25, fitted for least largest error under the condition that it ends at
/// ±1/2, and constant beyond.
#[inline(always)]
pub(crate) fn gelu_coarse<S: Simd>(s: S, x: S::V) -> S::V {
    // max(a, b) and min(a, b) give b for NaN, so NaN passes.
    let t = s.min(s.splat(4.25), s.max(s.splat(-4.25), x));
    let u = s.mul(t, t);
    let mut p = s.splat(-8.460_904e-10);
    for c in [
        7.571_187_4e-8,
        -2.938_905_7e-6,
        6.552_866_4e-5,
        -9.404_609_4e-4,
        9.257_885e-3,
        -6.545_364e-2,
        3.984_201_5e-1,
    ] {
        p = s.fma(p, u, s.splat(c));
    }
    s.mul(x, s.fma(t, p, s.splat(0.5)))
}

/// x / (1 + e^-x).
#[inline(always)]
pub(crate) fn silu<S: Simd>(s: S, x: S::V) -> S::V {
    let e = exp(s, s.sub(s.splat(0.0), x));
    s.div(x, s.add(s.splat(1.0), e))
}

/// max(x, 0); NaN stays NaN.
#[inline(always)]
pub(crate) fn relu<S: Simd>(s: S, x: S::V) -> S::V {
    s.max(s.splat(0.0), x)
}
