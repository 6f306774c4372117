//! What a network will need, before it runs.
//!
//! An upper estimate from the shapes that live at once, in 32 bits: residual stream and its copy, queries, keys and
//! values, the feed-forward layer, the four kept features; the dense head view by view, as many at once as threads; inputs
//! and outputs. Weights are mapped from the file and can be dropped by the system at any time.

use serde::Serialize;
use vidar_da3::Da3Config;
use vidar_da3::config::{Ffn, NetConfig, Networks, PATCH};

/// Planned memory, bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct MemoryPlan {
    /// Weights, mapped.
    pub weights: u64,
    /// Everything that is computed and thrown away.
    pub activations: u64,
    /// Images in and maps out.
    pub images: u64,
}

impl MemoryPlan {
    /// All of it.
    pub fn total(&self) -> u64 {
        self.weights + self.activations + self.images
    }
}

/// The plan for `views` views of `width` × `height` processed pixels at once.
pub fn planned_memory(
    config: &Da3Config,
    weights: u64,
    views: usize,
    (width, height): (usize, usize),
    threads: usize,
) -> MemoryPlan {
    let activations = match &config.networks {
        Networks::Single(net) => activations(net, views, width, height, threads),
        // One after the other.
        Networks::Nested { any_view, metric } => activations(any_view, views, width, height, threads)
            .max(activations(metric, views, width, height, threads)),
    };
    let pixels = (views * width * height) as u64;
    // Bytes in; planes of 32 bits in; depth, confidence and sky out, twice while they are handed over.
    MemoryPlan { weights, activations, images: pixels * (3 + 12 + 2 * 12) }
}

fn activations(net: &NetConfig, views: usize, width: usize, height: usize, threads: usize) -> u64 {
    let (rows, columns) = (height / PATCH, width / PATCH);
    // A single-view network has one view under way at a time.
    let together = if net.is_any_view() { views } else { 1 };
    let tokens = (together * (rows * columns + 1)) as u64;
    let dim = net.backbone.dim as u64;
    let hidden = match net.backbone.ffn {
        Ffn::Mlp { hidden } => hidden,
        Ffn::SwiGlu { hidden } => 3 * hidden,
    } as u64;
    let kept = 4 * (views * rows * columns) as u64 * net.backbone.feature_dim() as u64;
    let block = tokens * (2 * dim + (4 * dim).max(hidden + dim));
    let features = net.head.features as u64;
    let patches = (rows * columns) as u64;
    let stages: u64 = [16, 4, 1, 1].iter().zip(net.head.out_channels).map(|(s, c)| s * c as u64).sum();
    let fused = 64 * 3 * features;
    let full = (width * height) as u64 * 64;
    let head = (patches * (stages + fused) + full) * views.min(threads.max(1)) as u64;
    4 * (kept + block.max(head))
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_da3::Variant;

    #[test]
    fn more_views_and_larger_networks_need_more() {
        let plan = |variant: Variant, views| planned_memory(&variant.config(), 0, views, (504, 378), 2);
        let small = plan(Variant::Small, 1).total();
        assert!((20 << 20..2 << 30).contains(&small), "{small}");
        assert!(plan(Variant::Small, 16).total() > 2 * small);
        assert!(plan(Variant::Giant, 4).total() > plan(Variant::Large, 4).total());
        let nested = plan(Variant::NestedGiantLarge, 4);
        assert_eq!(nested.activations, plan(Variant::Giant, 4).activations);
    }
}
