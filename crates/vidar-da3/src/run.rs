//! The context of a run through the network: kernels and precision, cancellation, tracing.

use crate::arithmetic::{exact, exact_blocks};
use crate::error::Da3Error;
use crate::trace::{Layout, Trace, Traced};
use vidar_nn::Compute;

/// Cancellation and observation of a run.
#[derive(Clone, Copy)]
pub struct Hooks<'a> {
    /// Called between blocks and views; `true` ends the run with [`Da3Error::Cancelled`].
    pub cancel: &'a (dyn Fn() -> bool + Sync),
    /// Receives intermediate results.
    pub trace: Option<&'a dyn Trace>,
}

impl Default for Hooks<'_> {
    fn default() -> Self {
        Self { cancel: &|| false, trace: None }
    }
}

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
    pub cancel: &'a (dyn Fn() -> bool + Sync),
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

    /// Fails when the caller has cancelled the run.
    pub fn check_cancelled(&self) -> Result<(), Da3Error> {
        if (self.cancel)() { Err(Da3Error::Cancelled) } else { Ok(()) }
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
