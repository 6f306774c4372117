//! Sums of the voxels of a point cloud.
//!
//! A room has millions of voxels, and its cloud took more memory than its volume. Most voxels are observed by some hundred pixels, whose
//! sums fit 32 bits; those of the few that do not are continued in 64 bits elsewhere. Sums lie in pages, so that a growing list is never
//! copied, and the hash table holds their indices alone.

use crate::grid::{BlockKey, table_bytes};
use crate::pixels::PartialSum;
use rustc_hash::FxHashMap;

/// Number of sums of a voxel.
const TERMS: usize = 13;
/// Voxels of a page: small beside the smallest budget, large beside its pointer.
const PAGE: usize = 256;

/// All sums over the pixels of one voxel: Σ w · (position − centre of the voxel), Σ w · normal, Σ w · colour with Σ w of the pixels that had
/// one, Σ w, Σ confidence, number of pixels. Those of 65535 views of 2²³ pixels fit.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct PointSum([i64; TERMS]);

impl PointSum {
    pub fn offset(&self) -> [i64; 3] {
        [0, 1, 2].map(|a| self.0[a])
    }

    pub fn normal(&self) -> [i64; 3] {
        [3, 4, 5].map(|a| self.0[a])
    }

    pub fn color(&self) -> [u64; 4] {
        [6, 7, 8, 9].map(|a| self.0[a] as u64)
    }

    pub fn weight(&self) -> u64 {
        self.0[10] as u64
    }

    pub fn confidence(&self) -> u64 {
        self.0[11] as u64
    }

    pub fn pixels(&self) -> u64 {
        self.0[12] as u64
    }
}

/// What a partial sum adds, in the order of [`PointSum`].
fn terms(partial: &PartialSum) -> [i64; TERMS] {
    let (o, n, c) =
        (partial.offset().map(i64::from), partial.normal().map(i64::from), partial.color.map(i64::from));
    let [weight, confidence, pixels] = [partial.weight(), partial.confidence, partial.pixels].map(i64::from);
    [o[0], o[1], o[2], n[0], n[1], n[2], c[0], c[1], c[2], c[3], weight, confidence, pixels]
}

/// The part of a voxel's sums that fits 32 bits.
#[derive(Clone, Copy, Debug, Default)]
struct NarrowSum {
    terms: [i32; TERMS],
    views: u16,
    /// The call that added last, to count each view once; never read for anything else.
    last_call: u16,
}

impl NarrowSum {
    /// Adds what fits; whether it did, and nothing is changed where it did not.
    fn add(&mut self, more: &[i64; TERMS]) -> bool {
        let sums: [i64; TERMS] = std::array::from_fn(|i| i64::from(self.terms[i]) + more[i]);
        let fits = sums.iter().all(|s| i32::try_from(*s).is_ok());
        if fits {
            self.terms = sums.map(|s| s as i32);
        }
        fits
    }
}

/// The voxels of one hash table.
#[derive(Clone, Debug, Default)]
pub(crate) struct Shard {
    index: FxHashMap<BlockKey, u32>,
    // Boxed, so that a growing list moves pointers and not the sums.
    pages: Vec<Box<[NarrowSum; PAGE]>>,
    /// What became too large for 32 bits, by index.
    wide: FxHashMap<u32, PointSum>,
}

impl Shard {
    /// Adds partial sums of view number `call`; how many voxels changed, and how many pixels a budget of so many bytes rejected.
    pub fn add<'a>(
        &mut self,
        partial_sums: impl Iterator<Item = &'a PartialSum>,
        call: u16,
        budget: u64,
    ) -> (u64, u64) {
        let (mut touched, mut dropped) = (0, 0);
        for partial in partial_sums {
            let Some(at) = self.find_or_create(partial.key, budget) else {
                dropped += u64::from(partial.pixels);
                continue;
            };
            let more = terms(partial);
            let sum = &mut self.pages[at as usize / PAGE][at as usize % PAGE];
            if !sum.add(&more) {
                let is_new = !self.wide.contains_key(&at);
                if is_new && bytes_of(self.index.len(), self.wide.len() + 1) > budget {
                    dropped += u64::from(partial.pixels);
                    continue;
                }
                let wide = self.wide.entry(at).or_default();
                for ((wide, narrow), more) in wide.0.iter_mut().zip(&mut sum.terms).zip(more) {
                    *wide += i64::from(std::mem::take(narrow)) + more;
                }
            }
            if sum.last_call != call {
                touched += 1;
                sum.views += 1;
                sum.last_call = call;
            }
        }
        (touched, dropped)
    }

    /// Number of voxels.
    pub fn len(&self) -> usize {
        self.index.len()
    }

    /// Bytes held now.
    pub fn bytes(&self) -> u64 {
        bytes_of(self.index.len(), self.wide.len())
    }

    /// Voxels that at least so many views observed, with the index of their sums; in no order.
    pub fn seen_by(&self, min_views: u32) -> impl Iterator<Item = (BlockKey, u32)> {
        let views = |at: u32| u32::from(self.pages[at as usize / PAGE][at as usize % PAGE].views);
        self.index.iter().map(|(key, at)| (*key, *at)).filter(move |(_, at)| views(*at) >= min_views)
    }

    /// The sums at an index.
    pub fn sum(&self, at: u32) -> PointSum {
        let narrow = &self.pages[at as usize / PAGE][at as usize % PAGE];
        let wide = self.wide.get(&at).copied().unwrap_or_default();
        PointSum(std::array::from_fn(|i| wide.0[i] + i64::from(narrow.terms[i])))
    }

    fn find_or_create(&mut self, key: BlockKey, budget: u64) -> Option<u32> {
        if let Some(at) = self.index.get(&key) {
            return Some(*at);
        }
        let at = self.index.len();
        if bytes_of(at + 1, self.wide.len()) > budget {
            return None;
        }
        if at.is_multiple_of(PAGE) {
            // From a list, so that a page is not made on the stack.
            self.pages.push(vec![NarrowSum::default(); PAGE].into_boxed_slice().try_into().ok()?);
        }
        self.index.insert(key, at as u32);
        Some(at as u32)
    }
}

/// Bytes of a shard with so many voxels, of which so many are continued.
fn bytes_of(voxels: usize, continued: usize) -> u64 {
    let page = size_of::<[NarrowSum; PAGE]>() + size_of::<usize>();
    table_bytes(voxels, size_of::<(BlockKey, u32)>())
        + (voxels.div_ceil(PAGE) * page) as u64
        + table_bytes(continued, size_of::<(u32, PointSum)>())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn partial(key: BlockKey, sign: i32) -> PartialSum {
        let edge = sign * 127 * 4095 * 2048;
        let weight = 127 * 4095;
        PartialSum {
            key,
            sums: [edge, -edge, edge, edge, edge, -edge, weight, 0],
            color: [255, 0, 17, 1].map(|c| c * weight as u32),
            confidence: 127 * 255,
            pixels: 127,
        }
    }

    #[test]
    fn sums_beyond_32_bits_are_exact() {
        let mut shard = Shard::default();
        let views = 3000u16;
        for call in 1..=views {
            // Thrice a view, as from three strips.
            let all =
                [partial([1, 2, 3], 1), partial([4, 5, 6], -1), partial([1, 2, 3], 1), partial([1, 2, 3], 1)];
            assert_eq!(shard.add(all.iter(), call, u64::MAX), (2, 0));
        }
        let n = i64::from(views);
        for (key, sign, times) in [([1, 2, 3], 1, 3 * n), ([4, 5, 6], -1, n)] {
            let at = shard.index[&key];
            let expected = terms(&partial(key, sign)).map(|t| t * times);
            assert_eq!(shard.sum(at), PointSum(expected));
            assert!(expected[6] > i64::from(u32::MAX), "the test does not reach what it is about");
        }
        assert_eq!(shard.seen_by(u32::from(views)).count(), 2);
        assert_eq!(shard.seen_by(u32::from(views) + 1).count(), 0);
    }

    #[test]
    fn a_budget_holds_for_new_voxels_and_for_wide_sums() {
        let budget = bytes_of(PAGE, 0);
        let mut shard = Shard::default();
        let keys = |n: usize| (0..n).map(|i| partial([i as i32, 0, 0], 1)).collect::<Vec<_>>();
        let (touched, dropped) = shard.add(keys(PAGE + 1).iter(), 1, budget);
        assert_eq!((touched, dropped), (PAGE as u64, 127));
        let mut rejected = 0;
        for call in 2..100 {
            rejected += shard.add(keys(1).iter(), call, budget).1;
        }
        assert!(rejected > 0 && shard.bytes() <= budget, "{rejected}, {} of {budget} bytes", shard.bytes());
    }
}
