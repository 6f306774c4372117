//! Numbers without a pattern that are the same on every machine: SplitMix64 (Steele, Lea & Flood 2014), as a generator
//! and as a hash.
//!
//! It serves whatever draws few numbers by seed: samples of an estimator, noise of tests, synthetic weights. Rendered
//! worlds draw from ChaCha's streams, one per purpose (`vidar_synth`); where the official program's own samples are
//! wanted, NumPy's generator is in `vidar_solve::pcg64`.

use nalgebra::Vector3;

/// What the state grows by with each number: 2⁶⁴ over the golden ratio.
const STEP: u64 = 0x9e37_79b9_7f4a_7c15;

/// SplitMix64.
#[derive(Clone, Debug)]
pub struct SplitMix64(u64);

impl SplitMix64 {
    /// The generator of a seed; any seed is as good as another.
    pub const fn new(seed: u64) -> Self {
        Self(seed)
    }

    /// The next 64 bits.
    pub const fn next_u64(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(STEP);
        finalize(self.0)
    }

    /// Uniform in 0…1, 1 excluded: a multiple of 2⁻⁵³.
    pub fn uniform(&mut self) -> f64 {
        unit(self.next_u64())
    }

    /// A whole number below `end`, by the upper half of a product: numbers differ in likelihood by at most `end`/2⁶⁴.
    pub fn below(&mut self, end: usize) -> usize {
        ((u128::from(self.next_u64()) * end as u128) >> 64) as usize
    }

    /// Standard normal (Box and Muller); each number takes two uniform ones.
    pub fn normal(&mut self) -> f64 {
        // Kept from zero, whose logarithm is not finite.
        let (radius, turn) = (self.uniform().max(1e-300), self.uniform());
        (-2.0 * radius.ln()).sqrt() * (std::f64::consts::TAU * turn).cos()
    }

    /// Three standard normal numbers.
    pub fn normal3(&mut self) -> Vector3<f64> {
        Vector3::from_fn(|_, _| self.normal())
    }
}

/// A hash of a counter: the first number of the generator whose seed is `x`.
pub const fn splitmix64(x: u64) -> u64 {
    SplitMix64::new(x).next_u64()
}

/// SplitMix64's last step: all bits of `z` mixed, one to one; zero stays zero.
pub const fn finalize(z: u64) -> u64 {
    let z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// The upper 53 bits as a number in 0…1, 1 excluded.
pub const fn unit(bits: u64) -> f64 {
    (bits >> 11) as f64 / (1_u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Vigna's `splitmix64.c` (prng.di.unimi.it) from the seed 1234567.
    #[test]
    fn the_numbers_are_those_of_the_reference() {
        let mut random = SplitMix64::new(1_234_567);
        let first = [0; 3].map(|_: u64| random.next_u64());
        assert_eq!(first, [6_457_827_717_110_365_317, 3_203_168_211_198_807_973, 9_817_491_932_198_370_423]);
        assert_eq!(splitmix64(0), 0xe220_a839_7b1d_cdaf);
    }

    #[test]
    fn uniform_numbers_fill_their_range_and_normal_ones_have_unit_variance() {
        let mut random = SplitMix64::new(7);
        let mut hits = [0_u32; 5];
        let mut sums = [0.0; 3];
        for _ in 0..20_000 {
            hits[random.below(5)] += 1;
            let (u, n) = (random.uniform(), random.normal());
            assert!((0.0..1.0).contains(&u));
            sums = [sums[0] + u, sums[1] + n, sums[2] + n * n];
        }
        let [uniform, normal, squared] = sums.map(|s| s / 20_000.0);
        // Bounds of five standard errors.
        assert!(hits.iter().all(|h| h.abs_diff(4_000) < 290), "{hits:?}");
        assert!(
            (uniform - 0.5).abs() < 0.011 && normal.abs() < 0.036 && (squared - 1.0).abs() < 0.05,
            "{sums:?}"
        );
    }
}
