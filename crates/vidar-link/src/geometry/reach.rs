//! The way to the workers.

use crate::error::LinkError;
use std::time::Duration;

/// Why a worker gave no answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AskError {
    /// It is gone, or the way to it is.
    Gone,
    /// It did not answer in time.
    Late,
    /// The caller asked to stop.
    Cancelled,
}

/// The way to the workers under a key.
pub trait Reach: Send {
    /// The key.
    fn key(&self) -> &str;

    /// Asks all workers; the answers that came within a time.
    ///
    /// # Errors
    /// The way itself cannot be used.
    fn greet(&mut self, question: &[u8], within: Duration) -> Result<Vec<Vec<u8>>, LinkError>;

    /// Asks one worker. `stop` is asked now and then.
    ///
    /// # Errors
    /// Why there is no answer.
    fn ask(
        &mut self,
        worker: &str,
        request: &[u8],
        within: Duration,
        stop: &dyn Fn() -> bool,
    ) -> Result<Vec<u8>, AskError>;
}
