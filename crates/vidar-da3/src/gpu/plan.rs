//! How much device memory a run takes, before it starts.

use super::backbone::{FFN_ROWS, group_views};
use super::block::inner_width;
use super::head::ScratchSizes;
use crate::config::{Da3Config, NetConfig, Networks, PATCH};
use crate::model::DevicePlan;
use crate::weights::inventory::parameters;
use vidar_gpu::{Adapter, Gpu, GpuError};

const FLOAT: u64 = 4;

/// Bytes of device memory of a run.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct MemoryPlan {
    /// All weights, in `f32`; the backbone's take half of it in bf16 or f16.
    pub weights: u64,
    /// Largest sum of buffers during a run, weights aside.
    pub working: u64,
    /// The largest single buffer, weights aside: devices bound these, some at 128 MiB.
    pub largest: u64,
    /// What the largest buffer is for.
    pub largest_is: &'static str,
}

/// What `views` views at `height` × `width` pixels take on a device.
pub fn memory_plan(
    config: &Da3Config,
    (views, height, width): (usize, usize, usize),
    wants_rays: bool,
) -> MemoryPlan {
    let count = |shape: &[usize]| shape.iter().map(|n| *n as u64).product::<u64>();
    // What inference never reads does not go to the device.
    let read = parameters(config).into_iter().filter(|p| p.is_read);
    let weights = read.map(|p| count(&p.shape)).sum::<u64>() * FLOAT;
    let net = |net: &NetConfig, rays| Size::new(net, (views, height, width), views, rays).working();
    let working = match &config.networks {
        Networks::Single(one) => net(one, wants_rays),
        // One after the other.
        Networks::Nested { any_view, metric } => {
            let (first, second) = (net(any_view, wants_rays), net(metric, false));
            let largest = if first.largest >= second.largest { &first } else { &second };
            MemoryPlan { working: first.working.max(second.working), ..largest.clone() }
        }
    };
    MemoryPlan { weights, ..working }
}

/// [`memory_plan`] with the device that it is of.
pub(crate) fn device_plan(
    adapter: &Adapter,
    config: &Da3Config,
    size: (usize, usize, usize),
    wants_rays: bool,
) -> DevicePlan {
    let MemoryPlan { weights, working, largest, largest_is } = memory_plan(config, size, wants_rays);
    DevicePlan { device: adapter.to_string(), weights, working, largest, largest_is }
}

/// Sizes of a run of one network.
pub(super) struct Size<'a> {
    net: &'a NetConfig,
    views: usize,
    rows: usize,
    columns: usize,
    wanted: usize,
    wants_rays: bool,
}

impl<'a> Size<'a> {
    pub fn new(
        net: &'a NetConfig,
        (views, rows, columns): (usize, usize, usize),
        wanted: usize,
        wants_rays: bool,
    ) -> Self {
        Self { net, views, rows, columns, wanted, wants_rays }
    }

    /// Everything but the weights: stages live through both backbone and head.
    pub fn working(&self) -> MemoryPlan {
        let (net, views) = (self.net, self.views);
        let (dim, width) = (net.backbone.dim, net.backbone.feature_dim());
        let patches = self.rows / PATCH * (self.columns / PATCH);
        let tokens = 1 + patches;
        let group = group_views(views, tokens) * tokens;
        let sequence = if net.is_any_view() { views * tokens } else { group };
        let mut backbone = vec![
            ("tokens", views * tokens * dim),
            ("tokens before a block", views * tokens * dim),
            ("queries, keys and values", 3 * sequence.max(group) * dim),
            ("normed tokens", group * dim),
            ("attended tokens", group * dim),
            ("inner width of the feed-forward part", group.min(FFN_ROWS) * inner_width(net.backbone.ffn)),
            ("position embedding", tokens * dim),
            ("pixels", 3 * self.rows * self.columns),
            ("patches", 3 * self.rows * self.columns),
            ("rotation", 2 * tokens * net.backbone.head_dim()),
        ];
        let features = [
            ("a feature", patches * width),
            ("a normed feature", patches * width),
            ("camera tokens", 2 * views * width),
        ];
        backbone.extend(features);
        let head = ScratchSizes::new(&net.head, self.rows, self.columns, self.wants_rays).all();
        let kept: usize = net.head.out_channels.iter().sum::<usize>() * patches * self.wanted;
        // Tables of the position embeddings.
        let tables = (self.rows + self.columns) * (net.head.features + width + 16) * 2;
        let largest = backbone.iter().chain(&head).max_by_key(|(_, n)| *n).copied().unwrap_or(("", 0));
        let sum = |parts: &[(&str, usize)]| parts.iter().map(|(_, n)| *n as u64 + 4).sum::<u64>();
        MemoryPlan {
            weights: 0,
            working: (sum(&backbone).max(sum(&head)) + kept as u64 + tables as u64) * FLOAT,
            largest: largest.1 as u64 * FLOAT,
            largest_is: largest.0,
        }
    }
}

impl MemoryPlan {
    /// Refuses what a device cannot bind or may not hold, before anything is computed.
    pub(super) fn fits(&self, gpu: &Gpu) -> Result<(), GpuError> {
        let most = gpu.max_buffer_bytes();
        if self.largest > most {
            return Err(GpuError::BufferTooLarge {
                what: self.largest_is.to_owned(),
                bytes: self.largest,
                adapter: gpu.adapter().name.clone(),
                most,
            });
        }
        gpu.allows("the run", self.working)
    }
}
