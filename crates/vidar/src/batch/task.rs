//! A task of a batch, and the key of its result.

use super::plan::{Planned, PlannedRecording};
use super::record::{RECORD_SCHEMA, Stage, TaskRecord};
use crate::error::Error;
use crate::events::{CancelToken, Events};
use crate::run::parts::Part;
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

/// A task with what it is of.
pub(super) struct Task<'a> {
    pub request: &'a WorkRequest,
    pub recording: &'a PlannedRecording,
    pub part: Part,
    pub events: &'a Events,
    pub cancel: &'a CancelToken,
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

    /// Where results of a stage lie in the store.
    pub fn folder(&self, stage: Stage) -> String {
        let stage = if stage == Stage::Map { "maps" } else { stage.name() };
        format!("{stage}/{}", self.recording.name)
    }
}

/// SHA-256 of all that the result of a stage depends on. Into how many parts the chunks were divided does not change a map.
pub(super) fn task_key(recording: &PlannedRecording, stage: Stage, part: usize, parts: usize) -> String {
    let part = if stage == Stage::Predict { format!(" {part}/{parts}") } else { String::new() };
    vidar_hub::sha256_hex(format!("{RECORD_SCHEMA} {stage} {}{part}", recording.key).as_bytes())
}
