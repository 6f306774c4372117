//! Chance for sampling, from a seed: the same samples every time.

use vidar_core::random::SplitMix64;

/// Draws samples of different numbers.
#[derive(Clone, Debug)]
pub(super) struct Sampler(SplitMix64);

impl Sampler {
    pub fn new(seed: u64) -> Self {
        Self(SplitMix64::new(seed))
    }

    /// `K` different numbers below `n`; `n` must be at least `K`.
    pub fn distinct<const K: usize>(&mut self, n: usize) -> [usize; K] {
        debug_assert!(n >= K);
        let mut chosen = [0; K];
        for k in 0..K {
            // Floyd's algorithm: never rejects.
            let candidate = self.0.below(n - K + k + 1);
            chosen[k] = if chosen[..k].contains(&candidate) { n - K + k } else { candidate };
        }
        chosen
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_are_distinct_in_range_and_reach_everything() {
        let mut sampler = Sampler::new(3);
        let mut hits = [0_u32; 7];
        for _ in 0..7000 {
            let s: [usize; 5] = sampler.distinct(7);
            for (k, i) in s.iter().enumerate() {
                assert!(*i < 7 && !s[..k].contains(i));
                hits[*i] += 1;
            }
        }
        // Each of seven is in five of seven samples.
        assert!(hits.iter().all(|h| h.abs_diff(5000) < 200), "{hits:?}");
    }
}
