//! How much memory a run takes, before it starts.

use crate::config::{Da3Config, Ffn, NetConfig, Networks, PATCH};
use crate::da3::Da3;
use crate::model::backbone::{FFN_ROWS, GROUP_TOKENS};
use crate::weights::inventory::parameters;

/// Bytes of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MemoryEstimate {
    /// All weights in `f32`. A file is mapped: these are pages of the file that the system may drop again.
    pub weights: u64,
    /// Largest sum of buffers during a run, the answer included.
    pub working: u64,
    /// The output: depth and confidence, rays and images aside.
    pub answer: u64,
}

const FLOAT: u64 = 4;
/// Words of keys and values that the kernels pack at a time within one view.
const PACKED_WORDS: u64 = 2 << 20;

/// Bytes for `views` views processed at `height` × `width` pixels (see [`crate::preprocess::processed_size`]).
pub fn memory_estimate(
    config: &Da3Config,
    views: usize,
    height: usize,
    width: usize,
    wants_rays: bool,
) -> MemoryEstimate {
    let count = |shape: &[usize]| shape.iter().map(|n| *n as u64).product::<u64>();
    let weights = parameters(config).iter().map(|p| count(&p.shape)).sum::<u64>() * FLOAT;
    let size = Size {
        views: views as u64,
        patches: (height / PATCH * (width / PATCH)) as u64,
        pixels: (height * width) as u64,
    };
    let answer = 2 * size.views * size.pixels * FLOAT;
    // Images as bytes and as normalised numbers.
    let input = size.views * size.pixels * (3 + 3 * FLOAT);
    let network = match &config.networks {
        Networks::Single(net) => network(net, &size, wants_rays),
        // One after the other; the first one's answer stays.
        Networks::Nested { any_view, metric } => {
            network(any_view, &size, wants_rays).max(network(metric, &size, false) + answer)
        }
    };
    MemoryEstimate { weights, working: (input + network) + answer, answer }
}

impl Da3 {
    /// Bytes for `views` views processed at `height` × `width` pixels.
    pub fn memory_estimate(&self, views: usize, height: usize, width: usize) -> MemoryEstimate {
        memory_estimate(&self.config, views, height, width, false)
    }
}

struct Size {
    views: u64,
    patches: u64,
    pixels: u64,
}

/// The larger of backbone and head, and what lives through both.
fn network(net: &NetConfig, size: &Size, wants_rays: bool) -> u64 {
    let dim = net.backbone.dim as u64;
    let tokens = size.views * (size.patches + 1);
    // Projected stages of every view, from the backbone to the head.
    let channels: u64 = net.head.out_channels.iter().map(|c| *c as u64).sum();
    let stages = size.views * size.patches * channels;
    let hidden = match net.backbone.ffn {
        Ffn::Mlp { hidden } => hidden as u64,
        Ffn::SwiGlu { hidden } => 3 * hidden as u64,
    };
    // Tokens; queries and packed keys and values of all views (in bf16 half of the latter); then, of a group of views,
    // queries, keys, values, normed and attended tokens; a slice of the inner width.
    let group = tokens.min((size.patches + 1).max(GROUP_TOKENS as u64));
    let sequence = if net.is_any_view() { 3 * tokens * dim } else { 0 };
    let backbone = tokens * dim + sequence + 5 * group * dim + group.min(FFN_ROWS as u64) * hidden;
    // What kernels hold while they run: a layer's packed weight, and packed keys and values of some heads.
    let kernels = (3 * dim * dim).max(dim * hidden) + (2 * group * dim).min(PACKED_WORDS);
    (stages + kernels + backbone.max(head(net, size, wants_rays))) * FLOAT
}

/// One view in the head: the finest stage, the end of the fusion, or the last layers, whichever is largest.
fn head(net: &NetConfig, size: &Size, wants_rays: bool) -> u64 {
    let (features, patches) = (net.head.features as u64, size.patches);
    let laterals = patches * features * 85 / 4;
    let coarse = patches * net.head.out_channels[0] as u64 * 16;
    // At 4ph × 4pw: the map, its inner copy and the mixed one; at 8ph × 8pw: before and after `output_conv1`.
    let unit = 3 * 16 * patches * features;
    let fused = 64 * patches * (features + features / 2);
    let last = 64 * patches * features / 2 + 4 * size.pixels;
    // The ray branch has two maps of F and F/2 channels at 8ph × 8pw as well, after depth is done.
    let rays = if wants_rays { fused + 7 * 64 * patches } else { 0 };
    (laterals + unit.max(fused + 16 * patches * features).max(last).max(rays)).max(laterals + coarse)
}
