//! Work beside the odometry, taken over at an instant that the recording decides.
//!
//! A start or a clock offset takes tens of milliseconds to solve for, and an image has few. Such a problem is solved on a thread of its
//! own from a copy of what was known, and its result is taken over with the first image at or after a time that is fixed when the work
//! begins: the odometry waits for the thread then, where it has to. So results do not depend on how fast the thread was.

use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use vidar_core::Timestamp;

type Job<T> = Box<dyn FnOnce() -> T + Send>;

/// A result that is due at some instant.
pub(crate) struct Deferred<T> {
    due: Timestamp,
    job: Arc<Mutex<Option<Job<T>>>>,
    thread: Option<JoinHandle<Option<T>>>,
}

impl<T: Send + 'static> Deferred<T> {
    /// Begins `job`, whose result is taken over at `due`.
    pub fn begin(due: Timestamp, job: impl FnOnce() -> T + Send + 'static) -> Self {
        let job: Job<T> = Box::new(job);
        let job = Arc::new(Mutex::new(Some(job)));
        let for_thread = Arc::clone(&job);
        // Where the system gives no thread, the work is done when its result is due.
        let thread = std::thread::Builder::new().spawn(move || taken(&for_thread).map(|run| run())).ok();
        Self { due, job, thread }
    }

    /// Whether the result is to be taken over at `now`.
    pub fn is_due(&self, now: Timestamp) -> bool {
        now >= self.due
    }

    /// The result, waited for where the work is not done.
    pub fn result(self) -> Option<T> {
        let by_thread = match self.thread.map(JoinHandle::join) {
            Some(Ok(result)) => result,
            Some(Err(panic)) => std::panic::resume_unwind(panic),
            None => None,
        };
        by_thread.or_else(|| taken(&self.job).map(|run| run()))
    }
}

fn taken<T>(job: &Mutex<Option<Job<T>>>) -> Option<Job<T>> {
    job.lock().unwrap_or_else(PoisonError::into_inner).take()
}

impl<T> fmt::Debug for Deferred<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Deferred").field("due", &self.due).finish_non_exhaustive()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_result_is_taken_when_it_is_due_however_long_it_took() {
        let at = Timestamp::from_nanos;
        for pause_ms in [0, 30] {
            let work = Deferred::begin(at(10), move || {
                std::thread::sleep(std::time::Duration::from_millis(pause_ms));
                41 + 1
            });
            assert!(!work.is_due(at(9)) && work.is_due(at(10)));
            assert_eq!(work.result(), Some(42));
        }
    }

    #[test]
    fn without_a_thread_the_work_is_done_when_due() {
        let mut work = Deferred::begin(Timestamp::from_nanos(0), || 7);
        if let Some(thread) = work.thread.take() {
            assert_eq!(thread.join().unwrap(), Some(7));
        }
        *work.job.lock().unwrap() = Some(Box::new(|| 8));
        assert_eq!(work.result(), Some(8));
    }
}
