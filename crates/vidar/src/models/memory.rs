//! Planned memory of a network, for plans and manifests.

use crate::run::bytes;
use serde::Serialize;
use vidar_da3::{Da3Config, DevicePlan, memory_estimate};

/// Planned memory, bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct MemoryPlan {
    /// Weights. Those of a file are mapped: the system may drop them again.
    pub weights: u64,
    /// Everything else, including the output.
    pub working: u64,
}

impl MemoryPlan {
    /// All of it.
    pub fn total(&self) -> u64 {
        self.weights + self.working
    }
}

/// The memory of a device as text.
pub fn device_memory(plan: &DevicePlan) -> String {
    let DevicePlan { weights, working, largest, largest_is, .. } = plan;
    format!(
        "{} (weights at most {}, work {}, largest buffer {} for {largest_is})",
        bytes(weights + working),
        bytes(*weights),
        bytes(*working),
        bytes(*largest),
    )
}

/// The plan for `views` views of `width` × `height` processed pixels at once.
pub fn planned_memory(config: &Da3Config, views: usize, (width, height): (usize, usize)) -> MemoryPlan {
    let estimate = memory_estimate(config, views, height, width, false);
    MemoryPlan { weights: estimate.weights, working: estimate.working }
}
