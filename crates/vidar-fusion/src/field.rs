//! The distance field from which the surface is extracted: one value per node, blocks in the order of their keys.

use crate::block::Block;
use crate::grid::{BlockKey, EDGE, NODES, cell_of};
use crate::volume::TsdfVolume;
use rayon::prelude::*;
use rustc_hash::FxHashMap;

/// Nodes along the edge of a [`Neighbourhood`]: a block, one node before it and two behind.
pub(crate) const SPAN: usize = EDGE + 3;

/// Distances of all blocks, in truncations, NaN where not observed.
pub(crate) struct Field<'a> {
    /// Keys, ascending, so that nothing depends on the order in which blocks were created.
    pub keys: Vec<BlockKey>,
    pub blocks: Vec<&'a Block>,
    values: Vec<[f32; NODES]>,
    /// Whether a block has nodes in front of the surface, and behind it.
    signs: Vec<[bool; 2]>,
    index_of: FxHashMap<BlockKey, u32>,
}

impl<'a> Field<'a> {
    pub fn new(volume: &'a TsdfVolume) -> Self {
        let mut order: Vec<u32> = (0..volume.blocks.len() as u32).collect();
        order.par_sort_unstable_by_key(|&at| volume.keys[at as usize]);
        let keys: Vec<BlockKey> = order.iter().map(|&at| volume.keys[at as usize]).collect();
        let blocks: Vec<&Block> = order.iter().map(|&at| &*volume.blocks[at as usize]).collect();
        let min_observations = volume.config().min_observations;
        let (values, signs) = keys
            .par_iter()
            .zip(&blocks)
            .with_min_len(32)
            .map(|(key, block)| {
                let free = volume.free.get(key).copied().unwrap_or_default();
                let mut values = [f32::NAN; NODES];
                for (node, value) in values.iter_mut().enumerate() {
                    *value = block.distance(node, free[cell_of(node)], min_observations).unwrap_or(f32::NAN);
                }
                let signs = [values.iter().any(|&v| v > 0.0), values.iter().any(|&v| v < 0.0)];
                (values, signs)
            })
            .unzip();
        let index_of = keys.iter().enumerate().map(|(at, key)| (*key, at as u32)).collect();
        Self { keys, blocks, values, signs, index_of }
    }

    pub fn len(&self) -> usize {
        self.keys.len()
    }

    /// Distance of a node, in truncations.
    pub fn value(&self, block: usize, node: usize) -> f32 {
        self.values[block][node]
    }

    /// The surroundings of block `at`; `None` when no surface can pass through its cubes.
    pub fn neighbourhood(&self, at: usize) -> Option<Neighbourhood> {
        let key = self.keys[at];
        let ahead = |i: usize| {
            let offset = [i & 1, i >> 1 & 1, i >> 2 & 1];
            self.index_of.get(&[0, 1, 2].map(|a| key[a] + offset[a] as i32))
        };
        let mut signs = self.signs[at];
        for index in (1..8).filter_map(ahead) {
            let other = self.signs[*index as usize];
            signs = [signs[0] | other[0], signs[1] | other[1]];
        }
        if signs != [true, true] {
            return None;
        }
        let mut blocks = [None; 27];
        for (i, block) in blocks.iter_mut().enumerate() {
            let offset = [i % 3, i / 3 % 3, i / 9];
            *block = self.index_of.get(&[0, 1, 2].map(|a| key[a] + offset[a] as i32 - 1)).copied();
        }
        Some(self.gather(blocks))
    }

    fn gather(&self, blocks: [Option<u32>; 27]) -> Neighbourhood {
        let mut values = [f32::NAN; SPAN * SPAN * SPAN];
        for z in 0..SPAN {
            for y in 0..SPAN {
                let ((by, ny), (bz, nz)) = (split(y), split(z));
                let row = &mut values[(z * SPAN + y) * SPAN..][..SPAN];
                let first = (nz * EDGE + ny) * EDGE;
                let side = |bx: usize| blocks[bz * 9 + by * 3 + bx].map(|b| &self.values[b as usize]);
                if let Some(v) = side(0) {
                    row[0] = v[first + EDGE - 1];
                }
                if let Some(v) = side(1) {
                    row[1..=EDGE].copy_from_slice(&v[first..first + EDGE]);
                }
                if let Some(v) = side(2) {
                    row[EDGE + 1..].copy_from_slice(&v[first..first + 2]);
                }
            }
        }
        Neighbourhood { values, blocks }
    }
}

/// For a coordinate of the neighbourhood (0 = one before the block): which of three blocks, and its node there.
fn split(i: usize) -> (usize, usize) {
    let from_previous_block = i + EDGE - 1;
    (from_previous_block / EDGE, from_previous_block % EDGE)
}

/// The values of a block and around it.
pub(crate) struct Neighbourhood {
    values: [f32; SPAN * SPAN * SPAN],
    blocks: [Option<u32>; 27],
}

impl Neighbourhood {
    /// Position in the values of the block's node (x, y, z), each −1…9 shifted by one.
    pub fn at(x: usize, y: usize, z: usize) -> usize {
        ((z + 1) * SPAN + y + 1) * SPAN + x + 1
    }

    /// Distance between neighbours along an axis in the values.
    pub const STRIDE: [usize; 3] = [1, SPAN, SPAN * SPAN];

    pub fn value(&self, at: usize) -> f32 {
        self.values[at]
    }

    /// The block that owns node (x, y, z), each 0…8, and the node there.
    pub fn owner(&self, node: [usize; 3]) -> Option<(u32, usize)> {
        let [(bx, x), (by, y), (bz, z)] = node.map(|i| split(i + 1));
        let block = self.blocks[bz * 9 + by * 3 + bx]?;
        Some((block, (z * EDGE + y) * EDGE + x))
    }

    /// Gradient of the distance at a value's position: central, or one-sided beside unobserved nodes.
    pub fn gradient(&self, at: usize) -> [f32; 3] {
        Self::STRIDE.map(|stride| {
            let (before, here, after) = (self.values[at - stride], self.values[at], self.values[at + stride]);
            match (before.is_nan(), after.is_nan()) {
                (false, false) => 0.5 * (after - before),
                (true, false) => after - here,
                (false, true) => here - before,
                (true, true) => 0.0,
            }
        })
    }
}
