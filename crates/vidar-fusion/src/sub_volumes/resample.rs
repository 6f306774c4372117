//! A sub-volume read where it was fused and written where it lies now.
//!
//! Each node of the lattice takes the trilinear mean of the sums around the place that it came from. Means of sums
//! weigh distances by their weights, so what was hardly seen hardly counts. The distance itself scales with the
//! chunk; its truncation does not, hence it is cut at one truncation again.

use crate::block::{Block, DISTANCE_ONE, NodeSums};
use crate::carve::Vote;
use crate::grid::{BlockKey, EDGE, NODES, node_of};
use crate::volume::TsdfVolume;
use nalgebra::Vector3;
use rayon::prelude::*;
use vidar_core::{LieGroup, Sim3};

/// Share of the trilinear weight that must fall on nodes that were seen; less would grow the surface at its rim.
const LEAST_SEEN: f64 = 0.5;

/// Adds `source`, moved by `now_from_fused`, to `merged`.
pub(super) fn add_moved(merged: &mut TsdfVolume, source: &TsdfVolume, now_from_fused: &Sim3) {
    let voxel_m = source.config().voxel_size_m;
    let fused_from_now = now_from_fused.inverse();
    let reader = Reader { source, scale: now_from_fused.scale, fused_from_now, voxel_m };
    merged.count_views(source);

    let targets = covered(source.keys.iter().copied(), now_from_fused, voxel_m);
    // A part at a time, so that the resampled blocks do not all exist twice.
    for part in targets.chunks(4096) {
        let blocks: Vec<Option<Block>> =
            part.par_iter().with_min_len(8).map(|key| reader.block(*key)).collect();
        let pairs = part.iter().copied().zip(&blocks);
        merged.add_blocks(pairs.filter_map(|(key, block)| Some((key, block.as_ref()?))));
    }
    let free = covered(source.free.keys().copied(), now_from_fused, voxel_m);
    let votes: Vec<Vote> =
        free.par_iter().with_min_len(64).filter_map(|key| Some((*key, reader.vote(*key)?))).collect();
    merged.add_votes(&votes);
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
        // Neighbours find the same blocks: now and then the list is made short again.
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
    /// The block at `key`; `None` where nothing was seen.
    fn block(&self, key: BlockKey) -> Option<Block> {
        let mut nodes = [NodeSums::default(); NODES];
        let mut cache = Cache::new(self.source);
        let (mut seen, mut colored) = (false, false);
        for (local, sums) in nodes.iter_mut().enumerate() {
            let place = Vector3::from(node_of(key, local).map(|i| f64::from(i) * self.voxel_m));
            *sums = self.sums_at(&(self.fused_from_now.act(&place) / self.voxel_m), &mut cache);
            seen |= sums.weight > 0;
            colored |= sums.color[3] > 0;
        }
        seen.then(|| {
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

    /// The trilinear mean of the sums around `place` (in voxels, where the chunk was fused).
    fn sums_at(&self, place: &Vector3<f64>, cache: &mut Cache<'_>) -> NodeSums {
        let base = place.map(f64::floor);
        let share = place - base;
        let base: [i32; 3] = base.map(|v| v as i32).into();
        let mut seen = 0.0;
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
            seen += c;
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
        if seen < LEAST_SEEN || whole == 0 {
            return NodeSums::default();
        }
        // Distances in metres grow with the chunk, a truncation stays what it is.
        let mean = (distance * self.scale / weight).clamp(-f64::from(DISTANCE_ONE), f64::from(DISTANCE_ONE));
        // How often it was seen does not fade towards the rim.
        let count = |sum: f64| if near > 0.0 { (sum / near).round() as u32 } else { 0 };
        NodeSums {
            weighted_distance: (mean * f64::from(whole)).round() as i64,
            weight: whole,
            observations: count(views),
            confidence: count(confidence),
            color: color.map(count),
        }
    }

    /// The vote for a block as empty: the smallest of the votes around the place that it came from.
    fn vote(&self, key: BlockKey) -> Option<u32> {
        let edge_m = EDGE as f64 * self.voxel_m;
        let vote = |corner: usize| {
            let offset = [corner & 1, corner >> 1 & 1, corner >> 2 & 1].map(|o| o as f64);
            let place = Vector3::from([0, 1, 2].map(|a| (f64::from(key[a]) + offset[a]) * edge_m));
            // Corners lie on borders: a hair inside, so that a block that did not move is only itself.
            let middle = Vector3::from(key.map(|i| (f64::from(i) + 0.5) * edge_m));
            let place = self.fused_from_now.act(&(place + (middle - place) * 0.05)) / edge_m;
            self.source.free.get(&<BlockKey>::from(place.map(|v| v.floor() as i32))).copied()
        };
        (0..8).map(vote).try_fold(u32::MAX, |least, vote| Some(least.min(vote?)))
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
