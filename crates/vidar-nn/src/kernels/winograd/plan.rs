//! How the lines of tiles are divided into tasks.

use std::ops::Range;

use crate::kernels::source::{Bands, Fill};

/// Lines of tiles of a task, and how many tasks there are.
pub(crate) struct Plan {
    pub(crate) lines: usize,
    pub(crate) tasks: usize,
}

/// Bytes of the input lines that a task makes where they do not exist.
const LINE_BYTES: usize = 384 << 10;

impl Plan {
    pub(crate) fn new(bands: &Bands<'_>) -> Self {
        let all = bands.out_rows.div_ceil(2);
        let lines = match bands.fill {
            // Border lines are made by both neighbours: tasks should not be thin.
            Fill::Resampled(_) => {
                (LINE_BYTES / (4 * bands.cols * bands.channels).max(1)).saturating_sub(2) / 2
            }
            _ => 1,
        };
        let lines = lines.clamp(1, all.max(1));
        Self { lines, tasks: all.div_ceil(lines) }
    }

    /// The lines of tiles of a task.
    pub(crate) fn range(&self, task: usize, bands: &Bands<'_>) -> Range<usize> {
        task * self.lines..((task + 1) * self.lines).min(bands.out_rows.div_ceil(2))
    }
}
