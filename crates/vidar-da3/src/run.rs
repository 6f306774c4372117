//! The context of a run through the network: kernels and precision, cancellation, tracing.

use crate::arithmetic::{exact, exact_blocks};
use crate::error::Da3Error;
use crate::trace::{Layout, Trace, Traced};
use vidar_core::Watch;
use vidar_nn::Compute;

/// Cancellation and observation of a run.
#[derive(Clone, Copy)]
pub struct Hooks<'a> {
    /// Called between blocks and views; `true` ends the run with [`Da3Error::Cancelled`].
    pub watch: Watch<'a>,
    /// Receives intermediate results.
    pub trace: Option<&'a dyn Trace>,
}

impl Default for Hooks<'_> {
    fn default() -> Self {
        Self { watch: &|_| false, trace: None }
    }
}

/// Share of the backbone in a chunk's work; the rest is the dense head's. Of da3-base's 258 GFLOP a view without rays 201 are the
/// backbone's.
pub(crate) const BACKBONE_SHARE: f64 = 0.75;

/// Passed by reference to every part.
#[derive(Clone, Copy)]
pub(crate) struct Run<'a> {
    /// Kernels and precision of the backbone.
    pub backbone: Compute,
    /// Leading blocks that stay in `f32` under a bf16 backbone; `None` is a third, or all but twenty.
    pub exact_blocks: Option<usize>,
    /// Kernels and precision of the dense head.
    pub head: Compute,
    /// Called between blocks and views; `true` ends the run.
    pub watch: Watch<'a>,
    /// The share of the work that is done before this part, and the part's own.
    pub share: (f64, f64),
    /// Receives intermediate results.
    pub trace: Option<&'a dyn Trace>,
}

impl Run<'_> {
    /// Kernels and precision of block `i` of `depth`.
    pub fn block(&self, i: usize, depth: usize) -> Compute {
        if i < exact_blocks(self.exact_blocks, depth) { exact(self.backbone) } else { self.backbone }
    }

    /// Kernels and precision of the patch embedding.
    pub fn embedding(&self) -> Compute {
        if self.exact_blocks == Some(0) { self.backbone } else { exact(self.backbone) }
    }

    /// The same run within its `index`-th of `parts` equal parts.
    pub fn part(&self, index: usize, parts: usize) -> Self {
        self.between(index as f64 / parts.max(1) as f64, (index + 1) as f64 / parts.max(1) as f64)
    }

    /// The same run from `from` to `to` of its work, 0…1.
    pub fn between(&self, from: f64, to: f64) -> Self {
        let (start, length) = self.share;
        Self { share: (start + from * length, (to - from) * length), ..*self }
    }

    /// Fails when the caller has cancelled the run.
    pub fn check_cancelled(&self) -> Result<(), Da3Error> {
        if (self.watch)(self.share.0) { Err(Da3Error::Cancelled) } else { Ok(()) }
    }

    /// Passes a result to the trace, if there is one.
    pub fn show(&self, name: &str, view: usize, shape: &[usize], data: &[f32]) {
        self.show_as(Layout::Rows, name, view, shape, data);
    }

    /// As [`Run::show`], for a map `[rows, columns, channels]`.
    pub fn show_map(&self, name: &str, view: usize, shape: [usize; 3], data: &[f32]) {
        self.show_as(Layout::Map, name, view, &shape, data);
    }

    /// Whether the trace wants a result of that name.
    pub fn is_traced(&self, name: &str) -> bool {
        self.trace.is_some_and(|trace| trace.wants(name))
    }

    fn show_as(&self, layout: Layout, name: &str, view: usize, shape: &[usize], data: &[f32]) {
        if let Some(trace) = self.trace.filter(|trace| trace.wants(name)) {
            trace.record(Traced { name, view, shape, layout, data });
        }
    }
}
