//! Point fusion: one point per voxel, the weighted mean of all pixels that fall into it.
//!
//! Simpler than a TSDF and preserves thin objects, but has no free space and no surface between the points. Weights are those of the TSDF; all sums are integers, so the cloud is the same for any order of views
//! and any number of threads, except where the memory budget rejected voxels (see [`PointFusion::warnings`]).

use crate::grid::{BlockKey, MAX_VIEWS, check_view};
use crate::pixels::{FRACTION_ONE, SHARDS, Strips};
use crate::point_sums::{PointSum, Shard};
use crate::sample::{CONFIDENCE_ONE, SampledView};
use crate::{FusionConfig, FusionError, IntegrationStats};
use nalgebra::Vector3;
use rayon::prelude::*;
use vidar_core::{AlignedView, PointCloud, Warning};

/// A voxel-hashed point cloud that views are added to.
#[derive(Clone, Debug)]
pub struct PointFusion {
    config: FusionConfig,
    shards: Vec<Shard>,
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
            shards: vec![Shard::default(); SHARDS],
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
        let call = self.views as u16;
        let budget = self.config.memory_budget_bytes / SHARDS as u64;
        let (touched, dropped) = self
            .shards
            .par_iter_mut()
            .enumerate()
            .map(|(at, shard)| shard.add(strips.of_shard(at), call, budget))
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
        let kept = |(at, shard): (usize, &Shard)| {
            shard.seen_by(min_views).map(move |(key, sum)| (key, at, sum)).collect()
        };
        let kept: Vec<Vec<(BlockKey, usize, u32)>> = self.shards.par_iter().enumerate().map(kept).collect();
        let mut order = kept.concat();
        drop(kept);
        order.par_sort_unstable_by_key(|(key, ..)| *key);
        let sums = || order.iter().map(|&(key, shard, at)| (key, self.shards[shard].sum(at)));
        let colored = sums().any(|(_, sum)| sum.color()[3] > 0);
        let mut cloud = PointCloud {
            positions: Vec::with_capacity(order.len()),
            normals: Vec::with_capacity(order.len()),
            confidences: Vec::with_capacity(order.len()),
            colors: Vec::with_capacity(if colored { order.len() } else { 0 }),
        };
        for (key, sum) in sums() {
            cloud.positions.push(position(&sum, key, self.config.voxel_size_m));
            cloud.normals.push(unit_normal(&sum));
            cloud.confidences.push(sum.confidence() as f32 / (sum.pixels() as f32 * CONFIDENCE_ONE));
            if colored {
                let [r, g, b, weight] = sum.color();
                let weight = weight.max(1);
                cloud.colors.push([r, g, b].map(|c| ((c + weight / 2) / weight) as u8));
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
        self.shards.iter().map(Shard::bytes).sum()
    }
}

fn position(sum: &PointSum, key: BlockKey, voxel_m: f64) -> [f32; 3] {
    let per_unit = 1.0 / (sum.weight().max(1) as f64 * f64::from(FRACTION_ONE));
    let offset = sum.offset();
    [0, 1, 2].map(|a| ((f64::from(key[a]) + offset[a] as f64 * per_unit) * voxel_m) as f32)
}

fn unit_normal(sum: &PointSum) -> [f32; 3] {
    let sum = Vector3::from(sum.normal().map(|n| n as f64));
    // Opposite normals of a thin sheet may cancel; the direction is then arbitrary.
    let unit = sum.try_normalize(0.5).unwrap_or_else(Vector3::z);
    unit.map(|c| c as f32).into()
}
