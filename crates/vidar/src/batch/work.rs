//! One task of a batch.

use super::cost::Meter;
use super::record::{Problem, RECORD_SCHEMA, Stage, TaskRecord};
use super::report::{Table, report};
use super::stages::{self, Made};
use super::task::{Task, WorkRequest};
use crate::error::{Error, ExitStatus};
use crate::events::{CancelToken, Events};
use crate::run::parts::Part;
use std::collections::BTreeMap;

/// Result of a task.
#[derive(Debug)]
pub enum WorkOutcome {
    /// The task was done now.
    Made(TaskRecord),
    /// It was done before; or the record is that of the map, which makes it unnecessary.
    WasThere(TaskRecord),
    /// The table.
    Report(Table),
}

/// Does a task, unless its result is in the store. What a recording does not allow is a result, too; everything else that goes
/// wrong is an error and leaves no record, so that the task can be tried again, here or elsewhere.
///
/// # Errors
/// The number is too large, results of the stage before are missing, or the store or this machine fails.
pub fn work(request: &WorkRequest, events: &Events, cancel: &CancelToken) -> Result<WorkOutcome, Error> {
    let plan = &request.planned.plan;
    let (stage, index, store) = (request.stage, request.index, &request.store);
    let tasks = plan.stages.iter().find(|s| s.stage == stage).map_or(0, |s| s.tasks);
    if index >= tasks {
        let what = format!("--index {index}: stage {stage} has {tasks} tasks, numbered from 0");
        return Err(Error::Usage { what, hint: "`vidar plan` prints how many tasks each stage has".into() });
    }
    if stage == Stage::Report {
        return report(&request.planned, store).map(WorkOutcome::Report);
    }
    let per_recording = if stage == Stage::Predict { plan.parts } else { 1 };
    let recording = plan.recordings.get(index / per_recording);
    let recording = recording.ok_or_else(|| damaged(request, "it has fewer recordings than tasks"))?;
    let part = Part { index: index % per_recording, of: plan.parts };
    let task = Task { request, recording, part, events, cancel };
    // A map needs nothing any more.
    for key in [task.key(stage, part.index), task.key(Stage::Map, 0)] {
        if let Some(record) = TaskRecord::find(store, &key)? {
            return Ok(WorkOutcome::WasThere(record));
        }
    }
    task.carry_out().map(WorkOutcome::Made)
}

fn damaged(request: &WorkRequest, reason: &str) -> Error {
    Error::NotABatch { name: request.planned.uri.clone(), reason: reason.to_owned() }
}

impl Task<'_> {
    fn carry_out(&self) -> Result<TaskRecord, Error> {
        let meter = Meter::start();
        let before = self.request.store.traffic();
        let made = match self.request.stage {
            Stage::Track => stages::track(self),
            Stage::Predict => stages::predict(self),
            Stage::Map | Stage::Report => stages::map(self),
        };
        let made = match made {
            // The run folder goes with the task; what is finished lies in the store.
            Err(Error::Interrupted { .. }) => {
                return Err(Error::Interrupted { path: self.request.store.uri().into() });
            }
            Err(error) if is_of_recording(&error, self.recording.problem.as_ref()) => {
                Made::failed(Problem::of(&error))
            }
            made => made?,
        };
        let mut traffic = self.request.store.traffic();
        traffic.read -= before.read;
        traffic.written -= before.written;
        let mut warnings = BTreeMap::new();
        made.warnings.iter().for_each(|w| *warnings.entry(w.kind.clone()).or_default() += 1);
        let (stage, part) = (self.request.stage, self.part.index);
        let record = TaskRecord {
            schema: RECORD_SCHEMA.to_owned(),
            version: crate::VERSION.to_owned(),
            stage,
            recording: self.recording.name.clone(),
            part: (stage == Stage::Predict).then_some(part),
            key: self.key(stage, part),
            status: made.status,
            problem: made.problem,
            warnings,
            folder: self.folder(stage),
            files: made.files,
            result: made.result,
            cost: meter.stop(traffic),
        };
        record.write(&self.request.store)?;
        Ok(record)
    }
}

/// Whether another attempt, on another machine or later, would fail in the same way; `planned` is what `plan` met.
fn is_of_recording(error: &Error, planned: Option<&Problem>) -> bool {
    use std::io::ErrorKind::{InvalidData, InvalidInput, UnexpectedEof};
    let is_of_batch = matches!(error, Error::NotABatch { .. } | Error::Store(_) | Error::TaskTooEarly { .. });
    let was_planned = planned.is_some_and(|p| p.code == error.code());
    let of_content = [InvalidData, InvalidInput, UnexpectedEof];
    let is_of_system = os_error(error).is_some_and(|e| !of_content.contains(&e.kind()));
    let is_bad_input = error.exit_status() == ExitStatus::BadInput;
    !is_of_batch && (was_planned || (is_bad_input && !is_of_system))
}

/// The operating system's error behind an error, where there is one.
fn os_error(error: &Error) -> Option<&std::io::Error> {
    let mut error: Option<&(dyn std::error::Error + 'static)> = Some(error);
    while let Some(cause) = error {
        if let Some(io) = cause.downcast_ref::<std::io::Error>() {
            return Some(io);
        }
        error = cause.source();
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_dataset::DatasetError;

    #[test]
    fn a_disk_that_is_not_mounted_is_no_fault_of_the_recording() {
        let io = |kind: std::io::ErrorKind| {
            Error::Recording(DatasetError::Io { path: "a.bag".into(), source: kind.into() })
        };
        let is_fault = |error: &Error| is_of_recording(error, None);
        for kind in [std::io::ErrorKind::NotFound, std::io::ErrorKind::PermissionDenied] {
            assert!(!is_fault(&io(kind)), "{kind}");
        }
        let of_batch = Error::NotABatch { name: "plan".into(), reason: "damaged".into() };
        assert!(!is_fault(&of_batch));
        assert!(!is_fault(&Error::Interrupted { path: "store".into() }));
        // What the recording consists of stays as it is, and so does what the plan met.
        assert!(is_fault(&io(std::io::ErrorKind::UnexpectedEof)));
        assert!(is_fault(&Error::TooFewKeyframes { found: 0, needed: 2 }));
        let planned = Problem::of(&io(std::io::ErrorKind::NotFound));
        assert!(is_of_recording(&io(std::io::ErrorKind::NotFound), Some(&planned)));
    }
}
