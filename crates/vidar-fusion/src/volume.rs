//! The TSDF volume: hashed blocks, one view at a time.

use crate::allocate::touched_blocks;
use crate::block::Block;
use crate::carve::{FreeBlock, free_space};
use crate::grid::{BlockKey, CELLS, CameraFromWorld, EDGE, MAX_VIEWS, check_view, table_bytes};
use crate::sample::SampledView;
use crate::update::BlockUpdate;
use crate::{FusionConfig, FusionError};
use nalgebra::Vector3;
use rayon::prelude::*;
use rustc_hash::FxHashMap;
use serde::{Deserialize, Serialize};
use vidar_core::{AlignedView, Warning};

/// Statistics of one call of `integrate`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct IntegrationStats {
    /// Pixels whose depth was used.
    pub pixels_used: u64,
    /// Blocks (or, for points, voxels) that the view changed.
    pub blocks_touched: u64,
    /// Blocks (or voxels) that exist now.
    pub blocks_total: u64,
    /// Blocks (or voxels) that the view needed and the memory budget rejected.
    pub dropped_by_budget: u64,
    /// Blocks of which at least an eighth is free in the view.
    pub blocks_carved: u64,
}

/// A truncated signed distance field over hashed blocks of 8³ voxels.
///
/// [`Self::integrate`] adds views to integer sums, so the volume is the same to the bit for any order of views and
/// any number of threads. The one exception is a volume that ran into its memory budget: which blocks it
/// rejected then depends on the order of the views (see [`Self::warnings`]).
#[derive(Clone, Debug)]
pub struct TsdfVolume {
    config: FusionConfig,
    pub(crate) index: FxHashMap<BlockKey, u32>,
    pub(crate) keys: Vec<BlockKey>,
    // Boxed, so that a growing list moves pointers and not the blocks.
    pub(crate) blocks: Vec<Box<Block>>,
    /// Free-space weights of the cells of blocks.
    pub(crate) free: FxHashMap<BlockKey, [u32; CELLS]>,
    colored_blocks: u64,
    /// Memory of the last view's samples, for the next one.
    scratch: SampledView,
    views: u32,
    dropped: u64,
    shortened_views: u32,
    peak_bytes: u64,
}

impl TsdfVolume {
    /// An empty volume; fails for a configuration that is out of range.
    pub fn new(config: &FusionConfig) -> Result<Self, FusionError> {
        config.validate()?;
        Ok(Self {
            config: config.clone(),
            index: FxHashMap::default(),
            keys: Vec::new(),
            blocks: Vec::new(),
            free: FxHashMap::default(),
            colored_blocks: 0,
            scratch: SampledView::default(),
            views: 0,
            dropped: 0,
            shortened_views: 0,
            peak_bytes: 0,
        })
    }

    /// The settings.
    pub fn config(&self) -> &FusionConfig {
        &self.config
    }

    /// Views fused so far.
    pub fn views(&self) -> u32 {
        self.views
    }

    /// Fuses one view. An error leaves the volume as it was; a view without usable depth changes nothing.
    pub fn integrate(&mut self, view: &AlignedView) -> Result<IntegrationStats, FusionError> {
        check_view(&self.config, view)?;
        if self.views >= MAX_VIEWS {
            return Err(FusionError::TooManyViews { frame: view.frame_id(), limit: MAX_VIEWS });
        }
        let mut sampled = std::mem::take(&mut self.scratch);
        sampled.fill(view, &self.config);
        let needed = touched_blocks(view, &sampled, &self.config);
        let free = free_space(view, &sampled, &needed, &self.config);
        let (touched, dropped_blocks) = self.allocate(&needed, view.color().is_some());
        self.update(view, &sampled, &touched);
        let dropped_free = self.add_free(&free.blocks);
        self.views += 1;
        self.shortened_views += u32::from(free.shortened);
        self.dropped += dropped_blocks + dropped_free;
        self.peak_bytes = self.peak_bytes.max(self.memory_bytes() + sampled.scratch_bytes());
        let pixels_used = sampled.pixels_used;
        self.scratch = sampled;
        Ok(IntegrationStats {
            pixels_used,
            blocks_touched: touched.len() as u64,
            blocks_total: self.blocks.len() as u64,
            dropped_by_budget: dropped_blocks + dropped_free,
            blocks_carved: free.blocks.len() as u64 - dropped_free,
        })
    }

    /// Finds or creates the blocks at `needed` (sorted); their indices, sorted, and how many the budget rejected.
    fn allocate(&mut self, needed: &[BlockKey], colored: bool) -> (Vec<u32>, u64) {
        let mut touched = Vec::with_capacity(needed.len());
        let mut dropped = 0;
        for key in needed {
            if let Some(&at) = self.index.get(key) {
                touched.push(at);
                continue;
            }
            let more = Block::BYTES + if colored { Block::COLOR_BYTES } else { 0 };
            if self.bytes_with(self.blocks.len() + 1, self.free.len(), more) > self.config.memory_budget_bytes
            {
                dropped += 1;
                continue;
            }
            let at = self.blocks.len() as u32;
            self.index.insert(*key, at);
            self.keys.push(*key);
            self.blocks.push(Box::new(Block::new()));
            touched.push(at);
        }
        if colored {
            for &at in &touched {
                let fits = self.memory_bytes() + Block::COLOR_BYTES <= self.config.memory_budget_bytes;
                let block = &mut self.blocks[at as usize];
                if block.color.is_none() && fits {
                    block.add_color();
                    self.colored_blocks += 1;
                } else if block.color.is_none() {
                    dropped += 1;
                }
            }
        }
        touched.sort_unstable();
        (touched, dropped)
    }

    /// Adds the view to the blocks of `touched`, in parallel.
    fn update(&mut self, view: &AlignedView, sampled: &SampledView, touched: &[u32]) {
        let camera_from_world = CameraFromWorld::new(view);
        let voxel = self.config.voxel_size_m;
        let k = view.intrinsics();
        let update = BlockUpdate {
            samples: &sampled.samples,
            colors: view.color().map(|_| &sampled.colors[..]),
            width: sampled.width,
            height: sampled.height,
            k: [k.fx as f32, k.fy as f32, k.cx as f32, k.cy as f32],
            steps: [0, 1, 2].map(|a| (camera_from_world.rotation.column(a) * voxel).map(|v| v as f32).into()),
            truncation_m: self.config.truncation_m() as f32,
            voxel_m: voxel as f32,
        };
        let keys = &self.keys;
        disjoint_mut(&mut self.blocks, touched).into_par_iter().with_min_len(16).for_each(|(at, block)| {
            let first = keys[at as usize].map(|i| f64::from(i) * (EDGE as f64 * voxel));
            let origin = camera_from_world.apply(&Vector3::from(first));
            update.add_to(block, origin.map(|v| v as f32).into());
        });
    }

    /// Adds the weights of free blocks; returns how many the budget rejected.
    fn add_free(&mut self, blocks: &[FreeBlock]) -> u64 {
        let mut dropped = 0;
        for &(key, weights) in blocks {
            if let Some(sum) = self.free.get_mut(&key) {
                (0..CELLS).for_each(|cell| sum[cell] += weights[cell]);
            } else if self.bytes_with(self.blocks.len(), self.free.len() + 1, 0)
                <= self.config.memory_budget_bytes
            {
                self.free.insert(key, weights);
            } else {
                dropped += 1;
            }
        }
        dropped
    }

    /// Adds sums block by block; returns how many blocks the budget rejected.
    pub(crate) fn add_blocks<'a>(&mut self, more: impl Iterator<Item = (BlockKey, &'a Block)>) -> u64 {
        let mut dropped = 0;
        for (key, block) in more {
            let (touched, rejected) = self.allocate(&[key], block.color.is_some());
            dropped += rejected;
            for at in touched {
                self.blocks[at as usize].add(block);
            }
        }
        self.dropped += dropped;
        self.peak_bytes = self.peak_bytes.max(self.memory_bytes());
        dropped
    }

    /// Adds the free blocks of another volume; returns how many the budget rejected.
    pub(crate) fn add_free_blocks(&mut self, blocks: &[FreeBlock]) -> u64 {
        let dropped = self.add_free(blocks);
        self.dropped += dropped;
        dropped
    }

    /// Takes blocks and free blocks out again that were added, so that the sums are what they were.
    pub(crate) fn subtract_blocks<'a>(
        &mut self,
        blocks: impl Iterator<Item = (BlockKey, &'a Block)>,
        free: &[FreeBlock],
    ) {
        for (key, block) in blocks {
            if let Some(&at) = self.index.get(&key) {
                self.blocks[at as usize].subtract(block);
            }
        }
        for (key, weights) in free {
            if let Some(sum) = self.free.get_mut(key) {
                (0..CELLS).for_each(|cell| sum[cell] = sum[cell].wrapping_sub(weights[cell]));
                if *sum == [0; CELLS] {
                    self.free.remove(key);
                }
            }
        }
    }

    /// The free blocks with their weights, in the order of their keys.
    pub(crate) fn free_blocks(&self) -> Vec<FreeBlock> {
        let mut blocks: Vec<FreeBlock> = self.free.iter().map(|(key, weights)| (*key, *weights)).collect();
        blocks.sort_unstable();
        blocks
    }

    /// Counts views whose sums come by [`Self::add_blocks`].
    pub(crate) fn count_views(&mut self, other: &Self) {
        self.views += other.views;
        self.shortened_views += other.shortened_views;
    }

    /// Takes the views of [`Self::count_views`] out again.
    pub(crate) fn uncount_views(&mut self, other: &Self) {
        self.views -= other.views;
        self.shortened_views -= other.shortened_views;
    }

    /// Blocks with their keys.
    pub(crate) fn keyed_blocks(&self) -> impl Iterator<Item = (BlockKey, &Block)> {
        self.keys.iter().copied().zip(self.blocks.iter().map(|b| &**b))
    }

    /// Whether the budget rejected anything.
    pub(crate) fn is_incomplete(&self) -> bool {
        self.dropped > 0
    }

    /// Views fused, and how many of them carved a shorter range.
    pub(crate) fn view_counts(&self) -> (u32, u32) {
        (self.views, self.shortened_views)
    }

    /// Sets the counts of [`Self::view_counts`].
    pub(crate) fn set_view_counts(&mut self, views: u32, shortened: u32) {
        (self.views, self.shortened_views) = (views, shortened);
    }

    /// Changes how much memory the volume may hold; what it holds already stays.
    pub(crate) fn set_budget(&mut self, bytes: u64) {
        self.config.memory_budget_bytes = bytes;
    }

    /// Degradations so far: `fusion-memory-budget` when new blocks were rejected, `fusion-carve-range` when the
    /// carving range was shortened because it holds too many blocks.
    pub fn warnings(&self) -> Vec<Warning> {
        let mut warnings = Vec::new();
        if self.dropped > 0 {
            let message = format!(
                "the volume reached its budget of {} MiB: {} times a needed block was rejected, so parts are \
                 missing, and which ones depends on the order of the views",
                self.config.memory_budget_bytes >> 20,
                self.dropped
            );
            let hint =
                "raise fusion.memory_budget_bytes, or fusion.voxel_size_m (memory falls with its square)";
            let warning = Warning::degraded("fusion-memory-budget", message).at("fusion.memory_budget_bytes");
            warnings.push(warning.hint(hint));
        }
        if self.shortened_views > 0 {
            let message = format!(
                "{} of {} views hold too many blocks of {} m within {} m; they carved a shorter range",
                self.shortened_views,
                self.views,
                self.config.voxel_size_m * EDGE as f64,
                self.config.carve_range_m
            );
            let hint = "lower fusion.carve_range_m or raise fusion.voxel_size_m";
            warnings.push(Warning::new("fusion-carve-range", message).at("fusion.carve_range_m").hint(hint));
        }
        warnings
    }

    /// Bytes held now by blocks and tables; never above the budget.
    pub fn memory_bytes(&self) -> u64 {
        self.bytes_with(self.blocks.len(), self.free.len(), 0)
    }

    /// Most bytes held at once so far: the volume and the scratch of one [`Self::integrate`].
    ///
    /// The scratch (8 bytes a pixel) and the extracted mesh come on top of the budget.
    pub fn peak_memory_bytes(&self) -> u64 {
        self.peak_bytes
    }

    /// Bytes with `blocks` block entries and `free` free blocks in the tables, and `more` bytes of block.
    fn bytes_with(&self, blocks: usize, free: usize, more: u64) -> u64 {
        let lists = blocks.next_power_of_two() * (size_of::<BlockKey>() + size_of::<usize>());
        let (entry, free_entry) = (size_of::<(BlockKey, u32)>(), size_of::<FreeBlock>());
        self.blocks.len() as u64 * Block::BYTES
            + self.colored_blocks * Block::COLOR_BYTES
            + more
            + lists as u64
            + table_bytes(blocks, entry)
            + table_bytes(free, free_entry)
    }
}

/// Exclusive references to the items at `indices` (sorted, each once).
fn disjoint_mut<'a, T>(items: &'a mut [Box<T>], indices: &[u32]) -> Vec<(u32, &'a mut T)> {
    let mut picked = Vec::with_capacity(indices.len());
    let mut rest = items;
    let mut passed = 0;
    for &index in indices {
        let (head, tail) = std::mem::take(&mut rest).split_at_mut(index as usize + 1 - passed);
        passed = index as usize + 1;
        if let Some(item) = head.last_mut() {
            picked.push((index, &mut **item));
        }
        rest = tail;
    }
    picked
}
