//! What a transfer tells while it runs, and how it is stopped.

use crate::error::HubError;

/// Progress of one file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Progress<'a> {
    /// Which file.
    pub file: &'a str,
    /// Bytes present.
    pub done: u64,
    /// Bytes in total; 0 if the hub does not state it.
    pub total: u64,
}

/// Callbacks of a transfer: progress and cancellation.
pub struct TransferCallbacks<'a> {
    /// Called with progress, at most once per 64 KiB.
    pub progress: &'a dyn Fn(Progress<'_>),
    /// Called repeatedly; `true` stops.
    pub cancel: &'a dyn Fn() -> bool,
}

impl TransferCallbacks<'_> {
    pub(crate) fn stop(&self) -> Result<(), HubError> {
        if (self.cancel)() { Err(HubError::Cancelled) } else { Ok(()) }
    }
}
