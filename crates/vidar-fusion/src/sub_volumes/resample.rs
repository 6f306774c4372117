//! Resampling of a moved sub-volume.
//!
//! Each node of the lattice takes the trilinear mean of the sums around the position that it came from. Means of sums
//! weigh distances by their weights, so nodes of little weight have little influence. The distance itself scales with the
//! chunk; its truncation does not, hence it is clamped to one truncation again.

use crate::block::{Block, DISTANCE_ONE, NodeSums};
use crate::carve::FreeBlock;
use crate::grid::{BlockKey, CELL, CELLS, EDGE, NODES, node_of};
use crate::volume::TsdfVolume;
use nalgebra::Vector3;
use rayon::prelude::*;
use vidar_core::{LieGroup, Sim3};

/// Share of the trilinear weight that must fall on observed nodes; less would extend the surface beyond its border.
const MIN_OBSERVED_SHARE: f64 = 0.5;

/// Blocks and free blocks of `source`, moved by `now_from_fused`, in batches.
pub(super) fn moved(
    source: &TsdfVolume,
    now_from_fused: &Sim3,
    mut take: impl FnMut(&mut dyn Iterator<Item = (BlockKey, &Block)>, &[FreeBlock]),
) {
    let voxel_m = source.config().voxel_size_m;
    let fused_from_now = now_from_fused.inverse();
    let reader = Reader { source, scale: now_from_fused.scale, fused_from_now, voxel_m };

    let targets = covered(source.keys.iter().copied(), now_from_fused, voxel_m);
    // In batches, so that the resampled blocks do not all exist twice.
    for batch in targets.chunks(4096) {
        let blocks: Vec<Option<Block>> =
            batch.par_iter().with_min_len(8).map(|key| reader.block(*key)).collect();
        let pairs = batch.iter().copied().zip(&blocks);
        take(&mut pairs.filter_map(|(key, block)| Some((key, block.as_ref()?))), &[]);
    }
    let free = covered(source.free.keys().copied(), now_from_fused, voxel_m);
    let free: Vec<FreeBlock> =
        free.par_iter().with_min_len(64).filter_map(|key| reader.free_block(*key)).collect();
    take(&mut std::iter::empty(), &free);
}

/// Blocks of the lattice that the moved blocks `keys` reach, sorted, each once.
fn covered(keys: impl Iterator<Item = BlockKey>, now_from_fused: &Sim3, voxel_m: f64) -> Vec<BlockKey> {
    let edge_m = EDGE as f64 * voxel_m;
    let mut found: Vec<BlockKey> = Vec::new();
    for key in keys {
        // A node's value reaches one voxel beyond the block on every side.
        let corner = |i: usize| {
            let offset = [i & 1, i >> 1 & 1, i >> 2 & 1];
            let at = |a: usize| f64::from(key[a]) * edge_m + if offset[a] == 0 { -voxel_m } else { edge_m };
            now_from_fused.act(&Vector3::new(at(0), at(1), at(2))) / edge_m
        };
        let (low, high) = (0..8)
            .map(corner)
            .fold((Vector3::repeat(f64::INFINITY), Vector3::repeat(f64::NEG_INFINITY)), |(low, high), p| {
                (low.inf(&p), high.sup(&p))
            });
        let (low, high) = (low.map(|v| v.floor() as i32), high.map(|v| v.floor() as i32));
        for z in low.z..=high.z {
            for y in low.y..=high.y {
                found.extend((low.x..=high.x).map(|x| [x, y, z]));
            }
        }
        // Neighbouring blocks cover the same blocks: duplicates are removed from time to time.
        if found.len() > 1 << 20 {
            found.sort_unstable();
            found.dedup();
        }
    }
    found.par_sort_unstable();
    found.dedup();
    found
}

struct Reader<'a> {
    source: &'a TsdfVolume,
    scale: f64,
    fused_from_now: Sim3,
    voxel_m: f64,
}

impl Reader<'_> {
    /// The block at `key`; `None` where nothing was observed.
    fn block(&self, key: BlockKey) -> Option<Block> {
        let mut nodes = [NodeSums::default(); NODES];
        let mut cache = Cache::new(self.source);
        let (mut observed, mut colored) = (false, false);
        for (local, sums) in nodes.iter_mut().enumerate() {
            let position = Vector3::from(node_of(key, local).map(|i| f64::from(i) * self.voxel_m));
            *sums = self.sums_at(&(self.fused_from_now.act(&position) / self.voxel_m), &mut cache);
            observed |= sums.weight > 0;
            colored |= sums.color[3] > 0;
        }
        observed.then(|| {
            let mut block = Block::new();
            if colored {
                block.add_color();
            }
            for (local, sums) in nodes.iter().enumerate() {
                block.put(local, sums);
            }
            block
        })
    }

    /// The trilinear mean of the sums around `position` (in voxels, in the frame in which the chunk was fused).
    fn sums_at(&self, position: &Vector3<f64>, cache: &mut Cache<'_>) -> NodeSums {
        let base = position.map(f64::floor);
        let share = position - base;
        let base: [i32; 3] = base.map(|v| v as i32).into();
        let mut observed = 0.0;
        let mut near = 0.0;
        let (mut distance, mut weight, mut views, mut confidence) = (0.0, 0.0, 0.0, 0.0);
        let mut color = [0.0; 4];
        for corner in 0..8_usize {
            let offset = [corner & 1, corner >> 1 & 1, corner >> 2 & 1];
            let along = |a: usize| if offset[a] == 1 { share[a] } else { 1.0 - share[a] };
            let c = along(0) * along(1) * along(2);
            if c == 0.0 {
                continue;
            }
            let node = [0, 1, 2].map(|a| base[a] + offset[a] as i32);
            let Some(sums) = cache.sums(node).filter(|s| s.weight > 0) else { continue };
            observed += c;
            distance += c * sums.weighted_distance as f64;
            weight += c * f64::from(sums.weight);
            if sums.observations > 0 {
                near += c;
                views += c * f64::from(sums.observations);
                confidence += c * f64::from(sums.confidence);
                for (sum, value) in color.iter_mut().zip(sums.color) {
                    *sum += c * f64::from(value);
                }
            }
        }
        let whole = weight.round() as u32;
        if observed < MIN_OBSERVED_SHARE || whole == 0 {
            return NodeSums::default();
        }
        // Distances in metres grow with the chunk, a truncation stays what it is.
        let mean = (distance * self.scale / weight).clamp(-f64::from(DISTANCE_ONE), f64::from(DISTANCE_ONE));
        // The number of observations does not decrease towards the border.
        let count = |sum: f64| if near > 0.0 { (sum / near).round() as u32 } else { 0 };
        NodeSums {
            weighted_distance: (mean * f64::from(whole)).round() as i64,
            weight: whole,
            observations: count(views),
            confidence: count(confidence),
            color: color.map(count),
        }
    }

    /// The free-space weights of a block's cells; `None` where none is free.
    fn free_block(&self, key: BlockKey) -> Option<FreeBlock> {
        let weights = std::array::from_fn(|cell| {
            let offset = [cell & 1, cell >> 1 & 1, cell >> 2 & 1];
            self.free_weight([0, 1, 2].map(|a| 2 * key[a] + offset[a] as i32)).unwrap_or(0)
        });
        (weights != [0; CELLS]).then_some((key, weights))
    }

    /// The free-space weight of a cell: the smallest of the weights around the position that it came from.
    fn free_weight(&self, cell: [i32; 3]) -> Option<u32> {
        let edge_m = CELL as f64 * self.voxel_m;
        let weight = |corner: usize| {
            let offset = [corner & 1, corner >> 1 & 1, corner >> 2 & 1].map(|o| o as f64);
            let position = Vector3::from([0, 1, 2].map(|a| (f64::from(cell[a]) + offset[a]) * edge_m));
            // Corners lie on borders: slightly inside, so that a cell that did not move is only itself.
            let centre = Vector3::from(cell.map(|i| (f64::from(i) + 0.5) * edge_m));
            let position = self.fused_from_now.act(&(position + (centre - position) * 0.05)) / edge_m;
            let [x, y, z] = position.map(|v| v.floor() as i32).into();
            let weights = self.source.free.get(&[x, y, z].map(|i: i32| i.div_euclid(2)))?;
            let at = [x, y, z].map(|i| i.rem_euclid(2) as usize);
            Some(weights[(at[2] * 2 + at[1]) * 2 + at[0]]).filter(|w| *w > 0)
        };
        (0..8).map(weight).try_fold(u32::MAX, |least, weight| Some(least.min(weight?)))
    }
}

/// The last block that was read: the next node is nearly always in it.
struct Cache<'a> {
    source: &'a TsdfVolume,
    last: Option<(BlockKey, Option<&'a Block>)>,
}

impl<'a> Cache<'a> {
    fn new(source: &'a TsdfVolume) -> Self {
        Self { source, last: None }
    }

    fn sums(&mut self, node: [i32; 3]) -> Option<NodeSums> {
        let key = node.map(|i| i.div_euclid(EDGE as i32));
        let block = match self.last {
            Some((last, block)) if last == key => block,
            _ => {
                let at = self.source.index.get(&key);
                let block = at.map(|&at| &*self.source.blocks[at as usize]);
                self.last = Some((key, block));
                block
            }
        }?;
        let [x, y, z] = node.map(|i| i.rem_euclid(EDGE as i32) as usize);
        Some(block.sums((z * EDGE + y) * EDGE + x))
    }
}
