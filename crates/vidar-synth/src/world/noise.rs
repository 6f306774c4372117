//! Noise that depends on nothing but its arguments: the same on every machine and thread.

/// Mixes coordinates and a seed into 32 well-spread bits (the finaliser of MurmurHash3).
#[inline]
pub(super) fn hash(x: i32, y: i32, seed: u32) -> u32 {
    let mut h = (x as u32).wrapping_mul(0x9E37_79B1) ^ (y as u32).wrapping_mul(0x85EB_CA77) ^ seed;
    h ^= h >> 16;
    h = h.wrapping_mul(0x85EB_CA6B);
    h ^= h >> 13;
    h = h.wrapping_mul(0xC2B2_AE35);
    h ^ (h >> 16)
}

/// A value in 0…1 per lattice cell.
#[inline]
pub(super) fn cell(x: i32, y: i32, seed: u32) -> f32 {
    hash(x, y, seed) as f32 * (1.0 / 4_294_967_296.0)
}

/// The integer below; without SSE4.1 the library's `floor` is a call.
#[inline]
fn floor(x: f32) -> i32 {
    let towards_zero = x as i32;
    towards_zero - i32::from((towards_zero as f32) > x)
}

/// Smooth value noise of unit wavelength, −1…1.
#[inline]
pub(super) fn value_noise(x: f32, y: f32, seed: u32) -> f32 {
    let (ix, iy) = (floor(x), floor(y));
    let (fx, fy) = (ix as f32, iy as f32);
    let smooth = |a: f32| a * a * (3.0 - 2.0 * a);
    let (ax, ay) = (smooth(x - fx), smooth(y - fy));
    let top = mix(cell(ix, iy, seed), cell(ix + 1, iy, seed), ax);
    let bottom = mix(cell(ix, iy + 1, seed), cell(ix + 1, iy + 1, seed), ax);
    2.0 * mix(top, bottom, ay) - 1.0
}

/// Octaves of noise from `wavelength` (m) down to twice the `texel` (m), each `gain` times the one before; about −1…1.
///
/// Octaves that a texel cannot carry are left out, so that baking does not alias.
pub(super) fn octaves(u: f32, v: f32, wavelength: f32, texel: f32, gain: f32, seed: u32) -> f32 {
    let (mut sum, mut total) = (0.0, 0.0);
    let (mut amplitude, mut length) = (1.0, wavelength);
    let mut octave = 0;
    while octave < 9 && length >= 2.0 * texel {
        let s = seed.wrapping_add(0x51ED_270B_u32.wrapping_mul(octave + 1));
        sum +=
            amplitude * value_noise(u / length + 0.37 * octave as f32, v / length - 0.71 * octave as f32, s);
        total += amplitude;
        amplitude *= gain;
        length *= 0.5;
        octave += 1;
    }
    if total > 0.0 { 1.6 * sum / total } else { 0.0 }
}

/// `a` at 0, `b` at 1.
#[inline]
pub(super) fn mix(a: f32, b: f32, share: f32) -> f32 {
    a + (b - a) * share
}

/// 0 below `edge`, 1 above, over the width of a texel.
#[inline]
pub(super) fn step(edge: f32, x: f32, texel: f32) -> f32 {
    ((x - edge) / texel.max(1e-6) + 0.5).clamp(0.0, 1.0)
}

/// 1 inside `low…high`, 0 outside, edges one texel wide.
#[inline]
pub(super) fn band(low: f32, high: f32, x: f32, texel: f32) -> f32 {
    step(low, x, texel) * (1.0 - step(high, x, texel))
}
