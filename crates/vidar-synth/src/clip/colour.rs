//! Colours for a world that has brightness only.

use rand::Rng;
use rand_chacha::ChaCha8Rng;

/// Gives every face of a world a tint, or none at all.
#[derive(Clone, Copy, Debug)]
pub struct Palette {
    seed: u64,
    strength: f32,
}

impl Palette {
    /// A grey camera half of the time, else colours from pale to rich.
    pub(super) fn new(seed: u64, rng: &mut ChaCha8Rng) -> Self {
        let strength = if rng.random::<bool>() { 0.0 } else { 0.08 + 0.35 * rng.random::<f32>() };
        Self { seed, strength }
    }

    /// Whether all faces are grey.
    pub fn is_grey(&self) -> bool {
        self.strength == 0.0
    }

    /// Factors on red, green and blue of a face, about 1; the same in every clip of a room but for their strength.
    pub fn tint(&self, face: u32) -> [f32; 3] {
        if self.is_grey() {
            return [1.0; 3];
        }
        let bits = mix(self.seed ^ (u64::from(face) << 20));
        let of = |k: u32| (bits >> (20 * k) & 0xF_FFFF) as f32 / 524_288.0 - 1.0;
        let log = [of(0), of(1), of(2)];
        let mean = log.iter().sum::<f32>() / 3.0;
        log.map(|l| (self.strength * (l - mean)).exp())
    }
}

/// Steele, Lea and Flood's SplitMix64 finaliser.
fn mix(mut x: u64) -> u64 {
    x = x.wrapping_add(0x9E37_79B9_7F4A_7C15);
    x = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    x ^ (x >> 31)
}
