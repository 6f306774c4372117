//! The random numbers of NumPy's `default_rng(seed)`, as far as RANSAC needs them: the same samples as the official
//! code, without NumPy.
//!
//! PCG64 is PCG XSL-RR 128/64 (O'Neill 2014); its state comes from a seed through the entropy mixer after O'Neill's
//! `seed_seq` notes; bounded integers are Lemire's (2019) on buffered 32-bit halves; sampling without repetition is
//! Floyd's (Bentley 1987) followed by a Fisher–Yates shuffle.

/// PCG XSL-RR 128/64 with NumPy's seeding.
#[derive(Clone, Debug)]
pub struct Pcg64 {
    state: u128,
    increment: u128,
    /// The upper half of the last 64 bits, if 32 bits were asked for an odd number of times.
    spare: Option<u32>,
}

const MULTIPLIER: u128 = 0x2360_ED05_1FC6_5DA4_4385_DF64_9FCC_F645;

impl Pcg64 {
    /// The generator of `default_rng(seed)`.
    pub fn seed(seed: u32) -> Self {
        let words = seed_words(seed);
        let wide = |i: usize| (u128::from(words[i]) << 64) | u128::from(words[i + 1]);
        let mut generator = Self { state: 0, increment: (wide(2) << 1) | 1, spare: None };
        generator.step();
        generator.state = generator.state.wrapping_add(wide(0));
        generator.step();
        generator
    }

    fn step(&mut self) {
        self.state = self.state.wrapping_mul(MULTIPLIER).wrapping_add(self.increment);
    }

    /// The next 64 bits.
    pub fn next_u64(&mut self) -> u64 {
        self.step();
        let folded = (self.state >> 64) as u64 ^ self.state as u64;
        folded.rotate_right((self.state >> 122) as u32)
    }

    /// The next 32 bits: low half first.
    fn next_u32(&mut self) -> u32 {
        if let Some(upper) = self.spare.take() {
            return upper;
        }
        let bits = self.next_u64();
        self.spare = Some((bits >> 32) as u32);
        bits as u32
    }

    /// Uniform in 0 to `last`, both included.
    fn up_to(&mut self, last: u32) -> u32 {
        if last == 0 {
            return 0;
        }
        let range = u64::from(last) + 1;
        let mut product = u64::from(self.next_u32()) * range;
        if (product & 0xFFFF_FFFF) < range {
            let threshold = u64::from(u32::MAX - last) % range;
            while (product & 0xFFFF_FFFF) < threshold {
                product = u64::from(self.next_u32()) * range;
            }
        }
        (product >> 32) as u32
    }

    /// `size` different numbers below `population` in random order.
    ///
    /// NumPy draws the same where it uses Floyd's method: up to 10,000 numbers, or few of them.
    pub fn choose(&mut self, population: usize, size: usize) -> Vec<usize> {
        let size = size.min(population);
        let mut is_taken = vec![false; population];
        let mut chosen: Vec<usize> = Vec::with_capacity(size);
        for last in population - size..population {
            let drawn = self.up_to(u32::try_from(last).unwrap_or(u32::MAX)) as usize;
            let value = if is_taken[drawn] { last } else { drawn };
            is_taken[value] = true;
            chosen.push(value);
        }
        for i in (1..size).rev() {
            let j = self.up_to(i as u32) as usize;
            chosen.swap(i, j);
        }
        chosen
    }
}

/// Four words of 64 bits from a seed of 32.
fn seed_words(seed: u32) -> [u64; 4] {
    let mut constant = 0x43B0_D7E5u32;
    let mut hash = |value: u32| {
        let value = value ^ constant;
        constant = constant.wrapping_mul(0x931E_8875);
        let value = value.wrapping_mul(constant);
        value ^ (value >> 16)
    };
    let mix = |x: u32, y: u32| {
        let mixed = x.wrapping_mul(0xCA01_F9DD).wrapping_sub(y.wrapping_mul(0x4973_F715));
        mixed ^ (mixed >> 16)
    };
    let mut pool = [seed, 0, 0, 0].map(&mut hash);
    for from in 0..4 {
        for to in 0..4 {
            if from != to {
                pool[to] = mix(pool[to], hash(pool[from]));
            }
        }
    }
    let mut constant = 0x8B51_F9DDu32;
    let halves: [u32; 8] = std::array::from_fn(|i| {
        let value = pool[i % 4] ^ constant;
        constant = constant.wrapping_mul(0x58F3_8DED);
        let value = value.wrapping_mul(constant);
        value ^ (value >> 16)
    });
    std::array::from_fn(|i| u64::from(halves[2 * i]) | (u64::from(halves[2 * i + 1]) << 32))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `default_rng(42).bit_generator.random_raw(3)`, `default_rng(42).choice(10, 5, replace=False)` and, of the same
    /// generator, `.choice(300, 7, replace=False)`; NumPy 1.26.4.
    #[test]
    fn the_numbers_are_those_of_numpy() {
        let mut raw = Pcg64::seed(42);
        let first = [0; 3].map(|_: u64| raw.next_u64());
        assert_eq!(first, [0xC621_FBCD_16D9_2688, 0x705A_5661_A791_FFC1, 0xDBCD_12C2_6EDA_1624]);
        let mut generator = Pcg64::seed(42);
        assert_eq!(generator.choose(10, 5), [5, 3, 7, 0, 4]);
        assert_eq!(generator.choose(300, 7), [288, 214, 235, 155, 226, 27, 218]);
    }

    #[test]
    fn a_sample_has_no_number_twice() {
        let mut sample = Pcg64::seed(7).choose(20_000, 8_000);
        sample.sort_unstable();
        sample.dedup();
        assert_eq!((sample.len(), sample[7_999] < 20_000), (8_000, true));
    }
}
