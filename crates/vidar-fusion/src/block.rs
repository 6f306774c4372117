//! The sums that a block keeps.
//!
//! Every sum is an integer, so adding views commutes and associates: any order of views, any number of threads,
//! the same bits. What a view changes lies together, row by row of eight nodes, in 32 bits a sum; their upper bits
//! are moved away before they could overflow.

use crate::grid::{EDGE, NODES};

/// The integer that stands for a distance of one truncation: 1/4096 of it is finer than any depth sensor.
pub(crate) const DISTANCE_ONE: f32 = 4096.0;
/// Rows of [`EDGE`] nodes in a block.
pub(crate) const ROWS: usize = EDGE * EDGE;
/// Views after which the upper bits of the 32-bit sums are carried to their upper parts: (2³¹ − 2²⁶) / (4095 · 4096).
const VIEWS_BEFORE_CARRY: u8 = 120;
/// Bits of Σ w·d that stay in a row when its upper part is carried.
const DISTANCE_BITS: u32 = 26;
/// Bits of Σ confidence that stay in a row.
const CONFIDENCE_BITS: u32 = 8;
/// Where the confidence begins in [`Row::near`]; the count of views lies below.
const CONFIDENCE_SHIFT: u32 = 16;

/// Eight neighbours along x.
pub(crate) type Lanes<T> = [T; EDGE];

/// Sums of eight nodes, as every view updates them: three vectors in one and a half cache lines.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub(crate) struct Row {
    /// Lower part of Σ w·d, of weight · [`DISTANCE_ONE`].
    pub distance: Lanes<i32>,
    /// Σ w. 65535 views of 12 bits fit.
    pub weight: Lanes<u32>,
    /// Views within the truncation (lower 16 bits), and the lower part of the sum of their confidences (upper 16).
    pub near: Lanes<u32>,
}

/// Sums of red, green, blue times confidence, and of confidence, of eight nodes.
pub(crate) type ColorRow = [Lanes<u32>; 4];

/// The sums of 8³ nodes, x fastest.
#[derive(Clone, Debug)]
pub(crate) struct Block {
    pub rows: [Row; ROWS],
    /// Upper part of Σ w·d, in 2^[`DISTANCE_BITS`]: together 42 bits, 65535 views of 2²⁴ fit.
    distance_above: [i16; NODES],
    /// Upper part of Σ confidence, in 2^[`CONFIDENCE_BITS`].
    confidence_above: [u16; NODES],
    /// Views since the last [`Self::carry`].
    uncarried: u8,
    /// Colours, once a coloured view came.
    pub color: Option<Box<[ColorRow; ROWS]>>,
}

impl Block {
    /// Bytes of a block without colour, with its pointer.
    pub const BYTES: u64 = (size_of::<Self>() + size_of::<usize>()) as u64;
    /// Bytes that colour adds.
    pub const COLOR_BYTES: u64 = size_of::<[ColorRow; ROWS]>() as u64;

    pub fn new() -> Self {
        Self {
            rows: [Row { distance: [0; EDGE], weight: [0; EDGE], near: [0; EDGE] }; ROWS],
            distance_above: [0; NODES],
            confidence_above: [0; NODES],
            uncarried: 0,
            color: None,
        }
    }

    pub fn add_color(&mut self) {
        // From a list, so that the zeros come with the memory and are not written to it.
        let zeros = || vec![[[0; EDGE]; 4]; ROWS].into_boxed_slice().try_into();
        self.color = self.color.take().or_else(|| zeros().ok());
    }

    /// To be called before each view that is added, so that the 32-bit sums of the rows cannot overflow.
    pub fn before_view(&mut self) {
        if self.uncarried == VIEWS_BEFORE_CARRY {
            self.carry();
        }
        self.uncarried += 1;
    }

    /// Carries the upper bits of all sums to their upper parts. Changes no sum, so it may be called at any time.
    #[cold]
    fn carry(&mut self) {
        for (at, row) in self.rows.iter_mut().enumerate() {
            for i in 0..EDGE {
                let node = at * EDGE + i;
                // An arithmetic shift rounds down, so what stays is not negative.
                self.distance_above[node] += (row.distance[i] >> DISTANCE_BITS) as i16;
                row.distance[i] &= (1 << DISTANCE_BITS) - 1;
                let above = row.near[i] >> (CONFIDENCE_SHIFT + CONFIDENCE_BITS);
                self.confidence_above[node] += above as u16;
                row.near[i] -= above << (CONFIDENCE_SHIFT + CONFIDENCE_BITS);
            }
        }
        self.uncarried = 0;
    }

    /// Σ w·d of a node.
    #[inline(always)]
    fn weighted_distance(&self, node: usize) -> i64 {
        let low = self.rows[node / EDGE].distance[node % EDGE];
        i64::from(low) + (i64::from(self.distance_above[node]) << DISTANCE_BITS)
    }

    /// Views that observed a node within the truncation.
    #[inline(always)]
    pub fn observations(&self, node: usize) -> u32 {
        self.rows[node / EDGE].near[node % EDGE] & 0xffff
    }

    /// Signed distance of a node in truncations, with `free` (free-space weight of the block) as distance 1;
    /// `None` when fewer than `min_observations` views observed it near a surface.
    #[inline(always)]
    pub fn distance(&self, node: usize, free: u32, min_observations: u32) -> Option<f32> {
        let weight = self.rows[node / EDGE].weight[node % EDGE];
        if weight == 0 || self.observations(node) < min_observations {
            return None;
        }
        let sum = self.weighted_distance(node) + i64::from(free) * DISTANCE_ONE as i64;
        let value = sum as f32 / ((u64::from(weight) + u64::from(free)) as f32 * DISTANCE_ONE);
        // A surface through a node would give up to six coincident vertices; slightly in front of it gives one
        // vertex per edge, all distinct.
        Some(if sum == 0 { ZERO_NUDGE } else { value })
    }

    /// Mean confidence of a node, 0…1.
    pub fn mean_confidence(&self, node: usize) -> f32 {
        let low = self.rows[node / EDGE].near[node % EDGE] >> CONFIDENCE_SHIFT;
        let sum = low + (u32::from(self.confidence_above[node]) << CONFIDENCE_BITS);
        sum as f32 / (self.observations(node).max(1) as f32 * crate::sample::CONFIDENCE_ONE)
    }

    /// Mean colour of a node, if any coloured view observed it.
    pub fn mean_color(&self, node: usize) -> Option<[f32; 3]> {
        let [r, g, b, weight] = self.color.as_ref()?[node / EDGE].map(|lanes| lanes[node % EDGE]);
        (weight > 0).then(|| [r, g, b].map(|c| c as f32 / weight as f32))
    }
}

/// All sums of one node.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct NodeSums {
    /// Σ w·d.
    pub weighted_distance: i64,
    /// Σ w.
    pub weight: u32,
    /// Views within the truncation.
    pub observations: u32,
    /// Σ confidence.
    pub confidence: u32,
    /// Red, green, blue times confidence, and confidence, of the coloured views.
    pub color: [u32; 4],
}

impl Block {
    /// The sums of a node.
    pub fn sums(&self, node: usize) -> NodeSums {
        let row = &self.rows[node / EDGE];
        let low = row.near[node % EDGE] >> CONFIDENCE_SHIFT;
        NodeSums {
            weighted_distance: self.weighted_distance(node),
            weight: row.weight[node % EDGE],
            observations: self.observations(node),
            confidence: low + (u32::from(self.confidence_above[node]) << CONFIDENCE_BITS),
            color: self.color.as_ref().map_or([0; 4], |c| c[node / EDGE].map(|lanes| lanes[node % EDGE])),
        }
    }

    /// Replaces a node's sums by others, of at most [`crate::grid::MAX_VIEWS`] views; colours only if the block has
    /// colours.
    pub fn put(&mut self, node: usize, sums: &NodeSums) {
        let (at, i) = (node / EDGE, node % EDGE);
        let row = &mut self.rows[at];
        self.distance_above[node] = (sums.weighted_distance >> DISTANCE_BITS) as i16;
        row.distance[i] = (sums.weighted_distance & ((1 << DISTANCE_BITS) - 1)) as i32;
        row.weight[i] = sums.weight;
        self.confidence_above[node] = (sums.confidence >> CONFIDENCE_BITS) as u16;
        let low = sums.confidence & ((1 << CONFIDENCE_BITS) - 1);
        row.near[i] = low << CONFIDENCE_SHIFT | sums.observations;
        if let Some(color) = self.color.as_mut() {
            for (lanes, value) in color[at].iter_mut().zip(sums.color) {
                lanes[i] = value;
            }
        }
    }

    /// Adds the sums of `other`; both together hold at most [`crate::grid::MAX_VIEWS`] views.
    pub fn add(&mut self, other: &Self) {
        self.combine(other, |a, b| a + b, |a, b| a + b);
    }

    /// Takes the sums of `other` out again, which were added. Of others, read from a file that was changed, it makes nonsense, but no
    /// panic.
    pub fn subtract(&mut self, other: &Self) {
        self.combine(other, i64::wrapping_sub, u32::wrapping_sub);
    }

    fn combine(&mut self, other: &Self, of_distances: fn(i64, i64) -> i64, of_counts: fn(u32, u32) -> u32) {
        for node in 0..NODES {
            let more = other.sums(node);
            if more.weight == 0 && more.observations == 0 {
                continue;
            }
            let mut sums = self.sums(node);
            sums.weighted_distance = of_distances(sums.weighted_distance, more.weighted_distance);
            sums.weight = of_counts(sums.weight, more.weight);
            sums.observations = of_counts(sums.observations, more.observations);
            sums.confidence = of_counts(sums.confidence, more.confidence);
            for (sum, value) in sums.color.iter_mut().zip(more.color) {
                *sum = of_counts(*sum, value);
            }
            self.put(node, &sums);
        }
    }
}

/// What replaces a distance of exactly zero, in truncations.
const ZERO_NUDGE: f32 = 1.0 / (4.0 * DISTANCE_ONE);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_of_the_most_views_with_the_largest_weights_are_exact() {
        let views = crate::grid::MAX_VIEWS;
        let mut block = Block::new();
        for _ in 0..views {
            block.before_view();
            for row in &mut block.rows {
                for i in 0..EDGE {
                    // Even nodes in front of the surface, odd nodes behind it.
                    row.distance[i] += if i % 2 == 0 { 4095 * 4096 } else { -4095 * 4096 };
                    row.weight[i] += 4095;
                    row.near[i] += 255 << CONFIDENCE_SHIFT | 1;
                }
            }
        }
        for node in [0, 7, 300, NODES - 1] {
            let sign = if node % 2 == 0 { 1 } else { -1 };
            assert_eq!(block.weighted_distance(node), sign * i64::from(views) * 4095 * 4096);
            assert_eq!(block.observations(node), views);
            assert_eq!(block.distance(node, 0, views), Some(sign as f32));
            assert_eq!(block.mean_confidence(node), 1.0);
        }
    }
}
