//! Colours for a world that has brightness only.

use crate::world::{Hit, World};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use vidar_core::random::splitmix64;

/// Gives every face of a world a tint, or none at all.
#[derive(Clone, Copy, Debug)]
pub struct Palette {
    seed: u64,
    strength: f32,
    /// Whether all faces of one material have one tint, some much richer than others.
    by_material: bool,
}

impl Palette {
    /// A grey camera half of the time, else colours from pale to rich.
    pub(super) fn new(seed: u64, rng: &mut ChaCha8Rng) -> Self {
        let strength = if rng.random::<bool>() { 0.0 } else { 0.08 + 0.35 * rng.random::<f32>() };
        Self { seed, strength, by_material: false }
    }

    /// Colours of a home: what is made of one material has one tint, and some materials are nearly grey, others rich.
    pub(super) fn of_a_home(seed: u64, rng: &mut ChaCha8Rng) -> Self {
        let strength = if rng.random::<f64>() < 0.25 { 0.0 } else { 0.08 + 0.3 * rng.random::<f32>() };
        Self { seed, strength, by_material: true }
    }

    /// Whether all faces are grey.
    pub fn is_grey(&self) -> bool {
        self.strength == 0.0
    }

    /// Factors on red, green and blue of what is hit, about 1; the same in every clip of a room but for their strength.
    pub(super) fn tint(&self, world: &World, hit: &Hit) -> [f32; 3] {
        if self.is_grey() {
            return [1.0; 3];
        }
        let number = if self.by_material { world.material_number(hit) } else { hit.face_number() };
        let bits = splitmix64(self.seed ^ (u64::from(number) << 20));
        let richness =
            if self.by_material { 2.0 * (splitmix64(bits) >> 40) as f32 / (1 << 24) as f32 } else { 1.0 };
        let of = |k: u32| (bits >> (20 * k) & 0xF_FFFF) as f32 / 524_288.0 - 1.0;
        let log = [of(0), of(1), of(2)];
        let mean = log.iter().sum::<f32>() / 3.0;
        log.map(|l| (self.strength * richness * (l - mean)).exp())
    }
}
