//! What a network will need, before it runs, as manifests and plans have it.

use serde::Serialize;
use vidar_da3::{Da3Config, memory_estimate};

/// Planned memory, bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct MemoryPlan {
    /// Weights. Those of a file are mapped: the system may drop them again.
    pub weights: u64,
    /// Everything else that lives at once, the answer included.
    pub working: u64,
}

impl MemoryPlan {
    /// All of it.
    pub fn total(&self) -> u64 {
        self.weights + self.working
    }
}

/// The plan for `views` views of `width` × `height` processed pixels at once.
pub fn planned_memory(config: &Da3Config, views: usize, (width, height): (usize, usize)) -> MemoryPlan {
    let estimate = memory_estimate(config, views, height, width, false);
    MemoryPlan { weights: estimate.weights, working: estimate.working }
}
