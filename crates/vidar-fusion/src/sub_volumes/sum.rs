//! The sum of all sub-volumes, kept from one surface to the next.
//!
//! Sums are integers, so what a chunk added can be taken out again without a rest: only chunks that are new or that moved are
//! added or added anew, and a surface costs what changed instead of the length of the sequence.

use super::resample;
use crate::block::Block;
use crate::carve::FreeBlock;
use crate::grid::BlockKey;
use crate::{FusionConfig, FusionError, TsdfVolume};
use std::collections::BTreeMap;
use vidar_core::{ChunkId, Sim3};

/// The sum, and where each chunk is in it.
#[derive(Clone, Debug)]
pub(super) struct Sum {
    volume: TsdfVolume,
    placed: BTreeMap<ChunkId, Sim3>,
}

impl Sum {
    pub fn new(config: &FusionConfig) -> Result<Self, FusionError> {
        Ok(Self { volume: TsdfVolume::new(config)?, placed: BTreeMap::new() })
    }

    pub fn volume(&self) -> &TsdfVolume {
        &self.volume
    }

    /// Where the chunk is in the sum.
    pub fn place(&self, chunk: ChunkId) -> Option<&Sim3> {
        self.placed.get(&chunk)
    }

    /// Takes out what a chunk's volume added, if it did.
    pub fn remove(&mut self, chunk: ChunkId, source: &TsdfVolume) {
        if let Some(before) = self.placed.remove(&chunk) {
            blocks_at(source, &before, |blocks, free| self.volume.subtract_blocks(blocks, free));
            self.volume.uncount_views(source);
        }
    }

    /// Adds a chunk's volume at a place, or moves it there; together they have at most [`crate::grid::MAX_VIEWS`] views.
    pub fn set(&mut self, chunk: ChunkId, source: &TsdfVolume, now_from_fused: &Sim3) {
        self.remove(chunk, source);
        self.volume.count_views(source);
        blocks_at(source, now_from_fused, |blocks, free| {
            self.volume.add_blocks(blocks);
            self.volume.add_free_blocks(free);
        });
        self.placed.insert(chunk, *now_from_fused);
    }
}

/// Blocks and free blocks of a volume at a place; resampled where it is not the one of its fusion.
fn blocks_at(
    source: &TsdfVolume,
    now_from_fused: &Sim3,
    mut take: impl FnMut(&mut dyn Iterator<Item = (BlockKey, &Block)>, &[FreeBlock]),
) {
    match *now_from_fused == Sim3::IDENTITY {
        true => take(&mut source.keyed_blocks(), &source.free_blocks()),
        false => resample::moved(source, now_from_fused, take),
    }
}
