//! Lossless serialisation of a volume, for offloading finished chunks to disk.
//!
//! `VSUB2`, then as LEB128 numbers: views, shortened views, blocks, free blocks. Per block its key, whether it has colour, a
//! bit per node that was observed, and the sums of those nodes; per free block its key and the weights of its cells. Signed numbers are zigzag.
//! About a quarter of what the volume takes in memory.

use crate::block::{Block, NodeSums};
use crate::grid::{BlockKey, CELLS, MAX_VIEWS, NODES};
use crate::volume::TsdfVolume;
use crate::{FusionConfig, FusionError};

const MAGIC: &[u8; 5] = b"VSUB2";

/// The volume as bytes; blocks in the order of their keys, so that equal volumes give equal bytes.
pub(super) fn write(volume: &TsdfVolume) -> Vec<u8> {
    let mut out = MAGIC.to_vec();
    let mut order: Vec<usize> = (0..volume.keys.len()).collect();
    order.sort_unstable_by_key(|&at| volume.keys[at]);
    let free_blocks = volume.free_blocks();
    let (views, shortened) = volume.view_counts();
    for number in [u64::from(views), u64::from(shortened), order.len() as u64, free_blocks.len() as u64] {
        put(&mut out, number);
    }
    for at in order {
        put_key(&mut out, volume.keys[at]);
        let block = &volume.blocks[at];
        let colored = block.color.is_some();
        out.push(u8::from(colored));
        let sums: Vec<NodeSums> = (0..NODES).map(|node| block.sums(node)).collect();
        let observed = |s: &NodeSums| *s != NodeSums::default();
        for eight in sums.chunks(8) {
            out.push(eight.iter().enumerate().fold(0, |bits, (i, s)| bits | u8::from(observed(s)) << i));
        }
        for s in sums.iter().filter(|s| observed(s)) {
            put(&mut out, zigzag(s.weighted_distance));
            for number in [s.weight, s.observations, s.confidence] {
                put(&mut out, u64::from(number));
            }
            if colored {
                s.color.iter().for_each(|c| put(&mut out, u64::from(*c)));
            }
        }
    }
    for (key, weights) in free_blocks {
        put_key(&mut out, key);
        weights.iter().for_each(|weight| put(&mut out, u64::from(*weight)));
    }
    out
}

/// Reads the volume back. Fails for bytes that [`write`] does not write, and beyond the budget of `config`.
pub(super) fn read(bytes: &[u8], config: &FusionConfig) -> Result<TsdfVolume, FusionError> {
    let mut input = Input { bytes, at: 0 };
    if input.take(MAGIC.len())? != MAGIC {
        return Err(input.bad("the first five bytes"));
    }
    let mut volume = TsdfVolume::new(config)?;
    let (views, shortened) = (input.small()?, input.small()?);
    if views > MAX_VIEWS || shortened > views {
        return Err(input.bad("the number of views"));
    }
    let (blocks, free_blocks) = (input.number()?, input.number()?);
    let mut last: Option<BlockKey> = None;
    for _ in 0..blocks {
        let key = input.key()?;
        if last.is_some_and(|last| last >= key) {
            return Err(input.bad("the order of blocks"));
        }
        last = Some(key);
        let mut block = Block::new();
        let colored = input.take(1)?[0] == 1;
        if colored {
            block.add_color();
        }
        let observed: Vec<u8> = input.take(NODES / 8)?.to_vec();
        for node in (0..NODES).filter(|node| observed[node / 8] >> (node % 8) & 1 == 1) {
            let weighted_distance = unzigzag(input.number()?);
            let (weight, observations, confidence) = (input.small()?, input.small()?, input.small()?);
            // Bounds on the sums of that many views.
            let fits = weighted_distance.unsigned_abs() <= u64::from(weight) * 4096
                && u64::from(weight) <= u64::from(views) * 4095
                && observations <= views
                && confidence <= observations * 255;
            if !fits {
                return Err(input.bad("a node's sums"));
            }
            let mut color = [0; 4];
            if colored {
                for c in &mut color {
                    *c = input.small()?;
                    if *c > observations * (255 * 255) {
                        return Err(input.bad("a node's colours"));
                    }
                }
            }
            block.put(node, &NodeSums { weighted_distance, weight, observations, confidence, color });
        }
        if volume.add_blocks(std::iter::once((key, &block))) > 0 {
            return Err(input.bad("a size within the memory budget"));
        }
    }
    for _ in 0..free_blocks {
        let mut free_block = (input.key()?, [0; CELLS]);
        for weight in &mut free_block.1 {
            *weight = input.small()?;
        }
        let all: u64 = free_block.1.iter().map(|w| u64::from(*w)).sum();
        if all == 0 || free_block.1.iter().any(|w| *w > views * 4095) {
            return Err(input.bad("a free block"));
        }
        if volume.add_free_blocks(&[free_block]) > 0 {
            return Err(input.bad("a size within the memory budget"));
        }
    }
    if input.at != bytes.len() {
        return Err(input.bad("the end"));
    }
    volume.set_view_counts(views, shortened);
    Ok(volume)
}

struct Input<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Input<'a> {
    fn bad(&self, what: &'static str) -> FusionError {
        FusionError::BadSnapshot { what, at: self.at as u64 }
    }

    fn take(&mut self, count: usize) -> Result<&'a [u8], FusionError> {
        let taken = self
            .bytes
            .get(self.at..)
            .and_then(|rest| rest.get(..count))
            .ok_or_else(|| self.bad("more bytes"))?;
        self.at += count;
        Ok(taken)
    }

    fn number(&mut self) -> Result<u64, FusionError> {
        let mut value = 0;
        for shift in (0..64).step_by(7) {
            let byte = self.take(1)?[0];
            value |= u64::from(byte & 0x7F) << shift;
            if byte < 0x80 {
                return Ok(value);
            }
        }
        Err(self.bad("a number of at most 64 bits"))
    }

    fn small(&mut self) -> Result<u32, FusionError> {
        u32::try_from(self.number()?).map_err(|_| self.bad("a number of at most 32 bits"))
    }

    fn key(&mut self) -> Result<BlockKey, FusionError> {
        let mut key = [0; 3];
        for k in &mut key {
            // Blocks beyond the lattice's reach would overflow where their nodes are counted.
            *k = i32::try_from(unzigzag(self.number()?))
                .ok()
                .filter(|k| k.unsigned_abs() <= 1 << 20)
                .ok_or_else(|| self.bad("a block's position"))?;
        }
        Ok(key)
    }
}

fn put(out: &mut Vec<u8>, mut number: u64) {
    while number >= 0x80 {
        out.push(number as u8 | 0x80);
        number >>= 7;
    }
    out.push(number as u8);
}

fn put_key(out: &mut Vec<u8>, key: BlockKey) {
    key.iter().for_each(|k| put(out, zigzag(i64::from(*k))));
}

fn zigzag(x: i64) -> u64 {
    (x << 1 ^ x >> 63) as u64
}

fn unzigzag(x: u64) -> i64 {
    (x >> 1) as i64 ^ -((x & 1) as i64)
}
