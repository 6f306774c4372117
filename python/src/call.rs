//! Long calls: without the GIL, interrupted by Ctrl-C, telling of their progress.

use crate::error::raise;
use pyo3::prelude::*;
use std::sync::mpsc::{Receiver, RecvTimeoutError, sync_channel};
use std::thread;
use std::time::Duration;
use vidar::run_folder::event_line;
use vidar::{CancelToken, Error, Event, Events};

/// Time between two looks for Ctrl-C where nothing is told.
const POLL: Duration = Duration::from_millis(50);
/// Events that may wait for the reader.
const WAITING_EVENTS: usize = 1024;

/// Runs `work` on a thread of its own without the GIL. Its events go to `progress`, as the objects of `--progress json`, on the
/// calling thread. Ctrl-C and an exception of `progress` cancel the work; what it then leaves is finished, and the exception is
/// raised.
pub fn interruptible<T: Send>(
    py: Python<'_>,
    progress: Option<Py<PyAny>>,
    work: impl FnOnce(&Events, &CancelToken) -> Result<T, Error> + Send,
) -> PyResult<T> {
    let cancel = CancelToken::new();
    let (sender, receiver) = sync_channel::<Event>(WAITING_EVENTS);
    let result = py.detach(move || {
        thread::scope(|scope| {
            let (progress, cancel) = (progress.as_ref(), &cancel);
            let worker = scope.spawn(move || {
                let events = match progress {
                    // The reader leaves only after the last sender.
                    Some(_) => Events::none().with({
                        let sender = sender.clone();
                        move |event| drop(sender.send(event.clone()))
                    }),
                    None => Events::none(),
                };
                let result = work(&events, cancel);
                drop(sender);
                result
            });
            let stopped = watch(&receiver, progress, cancel);
            (worker.join(), stopped)
        })
    });
    match result {
        (Err(panic), _) => std::panic::resume_unwind(panic),
        (Ok(_), Some(stopped)) => Err(stopped),
        (Ok(result), None) => result.map_err(raise),
    }
}

/// Reads events until the work has ended; what stopped it.
fn watch(receiver: &Receiver<Event>, progress: Option<&Py<PyAny>>, cancel: &CancelToken) -> Option<PyErr> {
    let mut stopped = None;
    loop {
        let event = match receiver.recv_timeout(POLL) {
            Ok(event) => Some(event),
            Err(RecvTimeoutError::Timeout) => None,
            Err(RecvTimeoutError::Disconnected) => return stopped,
        };
        if stopped.is_none() {
            stopped = Python::attach(|py| tell(py, event.as_ref(), progress)).err();
            if stopped.is_some() {
                cancel.cancel();
            }
        }
    }
}

fn tell(py: Python<'_>, event: Option<&Event>, progress: Option<&Py<PyAny>>) -> PyResult<()> {
    py.check_signals()?;
    if let (Some(event), Some(progress)) = (event, progress) {
        progress.call1(py, (pythonize::pythonize(py, &event_line(event))?,))?;
    }
    Ok(())
}
