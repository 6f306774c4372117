//! Point fusion: one point per voxel, the weighted mean of all pixels that fall into it.
//!
//! Simpler than a TSDF and preserves thin objects, but has no free space and no surface between the points. Weights are those of the TSDF; all sums are integers, so the cloud is the same for any order of views
//! and any number of threads, except where the memory budget rejected voxels (see [`PointFusion::warnings`]).

use crate::grid::{BlockKey, MAX_VIEWS, check_view, table_bytes};
use crate::pixels::{FRACTION_ONE, PartialSum, SHARDS, Strips};
use crate::sample::{CONFIDENCE_ONE, SampledView};
use crate::{FusionConfig, FusionError, IntegrationStats};
use nalgebra::Vector3;
use rayon::prelude::*;
use rustc_hash::FxHashMap;
use vidar_core::{AlignedView, PointCloud, Warning};

/// Sums over the pixels of one voxel. 65535 views of 2³² pixels' weights would be needed to overflow them.
#[derive(Clone, Debug, Default)]
struct PointSum {
    /// Σ w · (position − centre of the voxel).
    offset: [i64; 3],
    /// Σ w · normal.
    normal: [i64; 3],
    /// Σ w · colour, and Σ w of the pixels that had one.
    color: [u64; 4],
    weight: u64,
    confidence: u64,
    pixels: u64,
    views: u32,
    /// The call that added last, to count each view once; never read for anything else.
    last_call: u32,
}

/// A voxel-hashed point cloud that views are added to.
#[derive(Clone, Debug)]
pub struct PointFusion {
    config: FusionConfig,
    shards: Vec<FxHashMap<BlockKey, PointSum>>,
    /// Memory of the last view's samples and partial_sums, for the next one.
    scratch: (SampledView, Strips),
    views: u32,
    dropped: u64,
}

impl PointFusion {
    /// An empty cloud; fails for a configuration that is out of range.
    pub fn new(config: &FusionConfig) -> Result<Self, FusionError> {
        config.validate()?;
        Ok(Self {
            config: config.clone(),
            shards: vec![FxHashMap::default(); SHARDS],
            scratch: <(SampledView, Strips)>::default(),
            views: 0,
            dropped: 0,
        })
    }

    /// The settings.
    pub fn config(&self) -> &FusionConfig {
        &self.config
    }

    /// Fuses one view. An error leaves the cloud as it was; a view without usable depth changes nothing.
    pub fn integrate(&mut self, view: &AlignedView) -> Result<IntegrationStats, FusionError> {
        check_view(&self.config, view)?;
        if self.views >= MAX_VIEWS {
            return Err(FusionError::TooManyViews { frame: view.frame_id(), limit: MAX_VIEWS });
        }
        self.views += 1;
        let (sampled, strips) = &mut self.scratch;
        sampled.fill(view, &self.config);
        strips.fill(view, sampled, self.config.voxel_size_m);
        let call = self.views;
        let budget = self.config.memory_budget_bytes / SHARDS as u64;
        let (touched, dropped) = self
            .shards
            .par_iter_mut()
            .enumerate()
            .map(|(at, shard)| add_to_shard(shard, strips.of_shard(at), call, budget))
            .reduce(|| (0, 0), |a, b| (a.0 + b.0, a.1 + b.1));
        self.dropped += dropped;
        Ok(IntegrationStats {
            pixels_used: self.scratch.0.pixels_used,
            blocks_touched: touched,
            blocks_total: self.shards.iter().map(|s| s.len() as u64).sum(),
            dropped_by_budget: dropped,
            blocks_carved: 0,
        })
    }

    /// One point per voxel observed by at least `min_observations` views, in the order of voxels: weighted mean
    /// position, unit normal facing the observers, mean confidence, and colour when any view had one.
    pub fn finish(self) -> PointCloud {
        let min_views = self.config.min_observations;
        let mut sums: Vec<(BlockKey, PointSum)> =
            self.shards.into_iter().flatten().filter(|(_, sum)| sum.views >= min_views).collect();
        sums.par_sort_unstable_by_key(|(key, _)| *key);
        let colored = sums.iter().any(|(_, sum)| sum.color[3] > 0);
        let mut cloud = PointCloud::default();
        for (key, sum) in &sums {
            cloud.positions.push(sum.position(*key, self.config.voxel_size_m));
            cloud.normals.push(sum.unit_normal());
            cloud.confidences.push(sum.confidence as f32 / (sum.pixels as f32 * CONFIDENCE_ONE));
            if colored {
                let weight = sum.color[3].max(1);
                cloud.colors.push([0, 1, 2].map(|c| ((sum.color[c] + weight / 2) / weight) as u8));
            }
        }
        cloud
    }

    /// Degradations so far: `fusion-memory-budget` when new points were rejected.
    pub fn warnings(&self) -> Vec<Warning> {
        if self.dropped == 0 {
            return Vec::new();
        }
        let message = format!(
            "the point cloud reached its budget of {} MiB: {} pixels fell into voxels that were rejected, and which \
             ones depends on the order of the views",
            self.config.memory_budget_bytes >> 20,
            self.dropped
        );
        let hint = "raise fusion.memory_budget_bytes or fusion.voxel_size_m";
        vec![Warning::degraded("fusion-memory-budget", message).at("fusion.memory_budget_bytes").hint(hint)]
    }

    /// Bytes held now; never above the budget.
    pub fn memory_bytes(&self) -> u64 {
        self.shards.iter().map(|s| shard_bytes(s.len())).sum()
    }
}

impl PointSum {
    fn add(&mut self, partial: &PartialSum, call: u32) {
        let (offset, normal) = (partial.offset(), partial.normal());
        for a in 0..3 {
            self.offset[a] += i64::from(offset[a]);
            self.normal[a] += i64::from(normal[a]);
        }
        for (sum, more) in self.color.iter_mut().zip(partial.color) {
            *sum += u64::from(more);
        }
        self.weight += u64::from(partial.weight());
        self.confidence += u64::from(partial.confidence);
        self.pixels += u64::from(partial.pixels);
        self.views += u32::from(self.last_call != call);
        self.last_call = call;
    }

    fn position(&self, key: BlockKey, voxel_m: f64) -> [f32; 3] {
        let per_unit = 1.0 / (self.weight.max(1) as f64 * f64::from(FRACTION_ONE));
        [0, 1, 2].map(|a| ((f64::from(key[a]) + self.offset[a] as f64 * per_unit) * voxel_m) as f32)
    }

    fn unit_normal(&self) -> [f32; 3] {
        let sum = Vector3::from(self.normal.map(|n| n as f64));
        // Opposite normals of a thin sheet may cancel; the direction is then arbitrary.
        let unit = sum.try_normalize(0.5).unwrap_or_else(Vector3::z);
        unit.map(|c| c as f32).into()
    }
}

fn shard_bytes(entries: usize) -> u64 {
    table_bytes(entries, size_of::<(BlockKey, PointSum)>())
}

/// Adds partial_sums to the voxels of one shard; how many voxels changed, and how many pixels the budget rejected.
fn add_to_shard<'a>(
    shard: &mut FxHashMap<BlockKey, PointSum>,
    partial_sums: impl Iterator<Item = &'a PartialSum>,
    call: u32,
    budget: u64,
) -> (u64, u64) {
    let (mut touched, mut dropped) = (0, 0);
    for partial in partial_sums {
        if let Some(sum) = shard.get_mut(&partial.key) {
            touched += u64::from(sum.last_call != call);
            sum.add(partial, call);
        } else if shard_bytes(shard.len() + 1) <= budget {
            touched += 1;
            shard.entry(partial.key).or_default().add(partial, call);
        } else {
            dropped += u64::from(partial.pixels);
        }
    }
    (touched, dropped)
}
