//! Logarithm and exponential as plain arithmetic: they vectorise, and have the same bits on every machine, which those of
//! the system's library need not have.

use std::f32::consts::{LN_2, LOG2_E};

/// Natural logarithm of a positive normal number, to a relative error of 10⁻⁶.
#[inline(always)]
pub(crate) fn ln(x: f32) -> f32 {
    /// √½: mantissas are taken from here to √2.
    const FIRST: u32 = 0x3f35_04f3;
    let exponent = (x.to_bits().wrapping_sub(FIRST) as i32) >> 23;
    let mantissa = f32::from_bits(x.to_bits().wrapping_sub((exponent << 23) as u32));
    // ln m = 2 artanh((m − 1)/(m + 1)); the first term left out is below 3·10⁻⁸.
    let t = (mantissa - 1.0) / (mantissa + 1.0);
    let s = t * t;
    let series = 1.0 + s * (1.0 / 3.0 + s * (0.2 + s * (1.0 / 7.0)));
    exponent as f32 * LN_2 + 2.0 * t * series
}

/// Exponential to a relative error of 10⁻⁵, of arguments limited to ±80.
#[inline(always)]
pub(crate) fn exp(x: f32) -> f32 {
    /// 1.5·2²³: adding it rounds to an integer.
    const ROUND: f32 = 12_582_912.0;
    let x = if x > -80.0 { x } else { -80.0 };
    let x = if x < 80.0 { x } else { 80.0 };
    let rounded = x * LOG2_E + ROUND;
    let power = (rounded.to_bits() as i32).wrapping_sub(ROUND.to_bits() as i32);
    let f = x - (rounded - ROUND) * LN_2;
    // Taylor's series to the sixth power, for |f| up to ln 2 / 2.
    let series = 1.0 + f * (0.5 + f * (1.0 / 6.0 + f * (1.0 / 24.0 + f * (1.0 / 120.0 + f * (1.0 / 720.0)))));
    (1.0 + f * series) * f32::from_bits(((power + 127) << 23) as u32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn logarithm_and_exponential_agree_with_the_systems() {
        for i in -3000..3000 {
            let x = 0.01 * i as f64;
            let (e, l) = (f64::from(exp(x as f32)), f64::from(ln(x.exp() as f32)));
            assert!((e / f64::from(x as f32).exp() - 1.0).abs() < 1e-5, "{x}: {e}");
            assert!((l - x).abs() < 1e-6 * x.abs().max(1.0), "{x}: {l}");
        }
        assert!(exp(1e30) > 1e34 && exp(-1e30) < 1e-34 && exp(f32::NAN) < 1e-34);
    }
}
