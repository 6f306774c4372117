//! One task of a batch.

use super::cost::Meter;
use super::plan::{Planned, PlannedRecording};
use super::record::{Problem, RECORD_SCHEMA, Stage, Status, TaskRecord};
use super::report::{Table, report};
use super::stages::{self, Made};
use crate::error::{Error, ExitStatus};
use crate::events::{CancelToken, Events};
use crate::run::parts::Part;
use std::collections::BTreeMap;
use std::path::PathBuf;
use vidar_dataset::OpenOptions;
use vidar_store::Store;

/// What to do.
#[derive(Debug)]
pub struct WorkRequest {
    /// The plan.
    pub planned: Planned,
    /// Its store.
    pub store: Store,
    /// The stage.
    pub stage: Stage,
    /// The task of that stage.
    pub index: usize,
    /// How recordings are read: what the plan's `input` says.
    pub open: OpenOptions,
    /// Where run folders are made; the system's folder for temporary files by default.
    pub scratch: Option<PathBuf>,
    /// The command as typed, for the manifest.
    pub command: Vec<String>,
}

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

/// A task with what it is of.
pub(super) struct Task<'a> {
    pub request: &'a WorkRequest,
    pub recording: &'a PlannedRecording,
    pub part: Part,
    pub events: &'a Events,
    pub cancel: &'a CancelToken,
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
    /// SHA-256 of all that the result of a stage depends on.
    pub fn key(&self, stage: Stage, part: usize) -> String {
        task_key(self.recording, stage, part, self.part.of)
    }

    /// The record of a stage before.
    ///
    /// # Errors
    /// It is not there.
    pub fn needs(&self, stage: Stage, part: usize) -> Result<TaskRecord, Error> {
        let found = TaskRecord::find(&self.request.store, &self.key(stage, part))?;
        found.ok_or_else(|| {
            let of_part = if stage == Stage::Predict { format!(", part {part}") } else { String::new() };
            Error::TaskTooEarly {
                task: format!("{} of {}", self.request.stage, self.recording.name),
                missing: format!("its stage {stage}{of_part} has no result yet"),
            }
        })
    }

    fn carry_out(&self) -> Result<TaskRecord, Error> {
        let meter = Meter::start();
        let before = self.request.store.traffic();
        let made = match self.request.stage {
            Stage::Track => stages::track(self),
            Stage::Predict => stages::predict(self),
            Stage::Map | Stage::Report => stages::map(self),
        };
        let made = match made {
            Err(error) if self.is_of_recording(&error) => Made::failed(Problem::of(&error)),
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

    /// Where results of a stage lie in the store.
    pub fn folder(&self, stage: Stage) -> String {
        let stage = if stage == Stage::Map { "maps" } else { stage.name() };
        format!("{stage}/{}", self.recording.name)
    }

    /// Whether another attempt, on another machine or later, would fail in the same way.
    fn is_of_recording(&self, error: &Error) -> bool {
        use std::io::ErrorKind::{InvalidData, InvalidInput, UnexpectedEof};
        let is_of_batch =
            matches!(error, Error::NotABatch { .. } | Error::Store(_) | Error::TaskTooEarly { .. });
        let was_planned = self.recording.problem.as_ref().is_some_and(|p| p.code == error.code());
        let is_of_system =
            os_error(error).is_some_and(|e| ![InvalidData, InvalidInput, UnexpectedEof].contains(&e.kind()));
        let is_bad_input = error.exit_status() == ExitStatus::BadInput;
        !is_of_batch && (was_planned || (is_bad_input && !is_of_system))
    }
}

/// SHA-256 of all that the result of a stage depends on. Into how many parts the chunks were divided does not change a map.
pub(super) fn task_key(recording: &PlannedRecording, stage: Stage, part: usize, parts: usize) -> String {
    let part = if stage == Stage::Predict { format!(" {part}/{parts}") } else { String::new() };
    vidar_hub::sha256_hex(format!("{RECORD_SCHEMA} {stage} {}{part}", recording.key).as_bytes())
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

impl Made {
    /// A recording that does not allow it.
    pub fn failed(problem: Problem) -> Self {
        Self { status: Status::Failed, problem: Some(problem), ..Self::default() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_dataset::DatasetError;

    #[test]
    fn a_disk_that_is_not_mounted_is_no_fault_of_the_recording() {
        let io = |kind: std::io::ErrorKind| {
            Error::Dataset(DatasetError::Io { path: "a.bag".into(), source: kind.into() })
        };
        let of_system = |error: &Error| os_error(error).map(std::io::Error::kind);
        assert_eq!(of_system(&io(std::io::ErrorKind::NotFound)), Some(std::io::ErrorKind::NotFound));
        assert_eq!(of_system(&Error::TooFewKeyframes { found: 0, needed: 2 }), None);
    }
}
