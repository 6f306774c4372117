//! How far an adjustment is, and whether it goes on.

use super::AdjustmentError;
use std::ops::ControlFlow;

/// What an adjustment is at.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum AdjustmentStage {
    /// The odometry's longest segment.
    Segment,
    /// Images without a state, and other segments.
    Outward,
    /// All states together.
    Together,
    /// All states together, with noise as the residuals show it.
    Weighted,
    /// The same with what comes into view again.
    Loops,
}

/// How far an adjustment is. It is told before every iteration, which takes well under a second per minute of recording.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Progress {
    /// What it is at.
    pub stage: AdjustmentStage,
    /// Iterations so far, over all stages. How many there will be is not known before.
    pub iterations: usize,
    /// States known so far.
    pub states: usize,
    /// States there will be at most.
    pub of: usize,
}

/// Tells the caller, and asks whether to go on.
pub(super) struct Watch<'a> {
    pub(super) progress: Progress,
    tell: &'a mut dyn FnMut(Progress) -> ControlFlow<()>,
}

impl<'a> Watch<'a> {
    pub(super) fn new(of: usize, tell: &'a mut dyn FnMut(Progress) -> ControlFlow<()>) -> Self {
        let stage = AdjustmentStage::Segment;
        Self { progress: Progress { stage, iterations: 0, states: 0, of }, tell }
    }

    pub(super) fn stage(&mut self, stage: AdjustmentStage, states: usize) {
        self.progress = Progress { stage, states, ..self.progress };
    }

    /// An iteration begins.
    pub(super) fn iteration(&mut self) -> Result<(), AdjustmentError> {
        let told = (self.tell)(self.progress);
        self.progress.iterations += 1;
        match told {
            ControlFlow::Continue(()) => Ok(()),
            ControlFlow::Break(()) => Err(AdjustmentError::Cancelled),
        }
    }
}
