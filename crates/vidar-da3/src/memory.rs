//! How much memory a run takes, before it starts.

use crate::config::{Da3Config, Ffn, HEAD_LAST, HeadKind, NetConfig, Networks, PATCH};
use crate::da3::Da3;
use crate::weights::inventory::parameters;

/// Bytes of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MemoryEstimate {
    /// All weights in `f32`. A file is mapped: these are pages of the file that the system may drop again.
    pub weights: u64,
    /// Largest sum of buffers during a run, the answer included.
    pub working: u64,
    /// The answer: depth and confidence, rays and pictures aside.
    pub answer: u64,
}

const FLOAT: u64 = 4;

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
    // Pictures as bytes and as normalised numbers.
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
    // Tokens; queries, keys and values; then, of a group of views: normed, attended; a slice of the inner width.
    let group = tokens.min((size.patches + 1).max(4096));
    let sequence = if net.is_any_view() { tokens } else { group };
    let backbone = tokens * dim + 3 * sequence * dim + 2 * group * dim + group.min(1024) * hidden;
    (stages + backbone.max(head(net, size, wants_rays))) * FLOAT
}

/// One view in the head: at the end of the fusion, or at the picture's size.
fn head(net: &NetConfig, size: &Size, wants_rays: bool) -> u64 {
    let (features, patches) = (net.head.features as u64, size.patches);
    let laterals = patches * features * 21;
    let coarse = patches * net.head.out_channels[0] as u64 * 16;
    // At 8ph × 8pw: the map before and after the enlargement, and a narrow copy.
    let fusion = 64 * patches * (features + features / 2) + 16 * patches * 2 * features;
    let full = size.pixels * (features / 2 + HEAD_LAST as u64 + 4) + 64 * patches * features / 2;
    let kept = if wants_rays || net.head.kind == HeadKind::DualDpt { laterals } else { 0 };
    (laterals + coarse).max(laterals + fusion).max(kept + full)
}
