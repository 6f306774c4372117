//! Chance for sampling, from a seed: the same samples every time.

/// SplitMix64 (Steele, Lea & Flood 2014).
#[derive(Clone, Debug)]
pub(super) struct Sampler(u64);

impl Sampler {
    pub fn new(seed: u64) -> Self {
        Self(seed)
    }

    fn below(&mut self, n: usize) -> usize {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((u128::from(z ^ (z >> 31)) * n as u128) >> 64) as usize
    }

    /// `K` different numbers below `n`; `n` must be at least `K`.
    pub fn distinct<const K: usize>(&mut self, n: usize) -> [usize; K] {
        debug_assert!(n >= K);
        let mut chosen = [0; K];
        for k in 0..K {
            // Floyd's algorithm: never rejects.
            let candidate = self.below(n - K + k + 1);
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
