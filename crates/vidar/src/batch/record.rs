//! Stages of a batch, and the record that a task leaves in the store.

use super::Cost;
use super::MAX_JSON_BYTES;
use crate::error::{Error, ExitStatus};
use crate::run_folder::pretty;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use vidar_store::Store;

/// Schema of `records/*.json`.
pub const RECORD_SCHEMA: &str = "vidar.task/1";

/// A stage of a batch, in order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Stage {
    /// Calibration and odometry of a recording.
    Track,
    /// Depth of a part of its chunks.
    Predict,
    /// Alignment, fusion, evaluation and files of a recording.
    Map,
    /// One table over all recordings.
    Report,
}

impl Stage {
    /// Every stage, in order.
    pub const ALL: [Self; 4] = [Self::Track, Self::Predict, Self::Map, Self::Report];

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Track => "track",
            Self::Predict => "predict",
            Self::Map => "map",
            Self::Report => "report",
        }
    }
}

impl std::fmt::Display for Stage {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

/// How a task ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Status {
    /// All of it.
    Done,
    /// With a part missing or weaker than asked for; `warnings` says which.
    Degraded,
    /// The recording does not allow it.
    Failed,
}

/// What does not work, as the command line says it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Problem {
    /// The code of `vidar explain`.
    pub code: String,
    /// What, where and why.
    pub message: String,
    /// The next step.
    pub hint: Option<String>,
}

impl Problem {
    pub(super) fn of(error: &Error) -> Self {
        Self { code: error.code().to_owned(), message: error.to_string(), hint: error.hint() }
    }
}

/// A result in the store.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StoredFile {
    /// Its path in the run folder.
    pub path: String,
    /// Its size, bytes.
    pub bytes: u64,
    /// Of its content.
    pub sha256: String,
}

/// What a task did. It is written last: without it the results of a task do not count.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TaskRecord {
    /// [`RECORD_SCHEMA`].
    pub schema: String,
    /// Version of the program.
    pub version: String,
    /// The stage.
    pub stage: Stage,
    /// Name of the recording.
    pub recording: String,
    /// The part of its chunks, for `predict`.
    pub part: Option<usize>,
    /// SHA-256 of all that the result depends on.
    pub key: String,
    /// How it ended.
    pub status: Status,
    /// Why it failed.
    pub problem: Option<Problem>,
    /// Warnings of each kind, with their number.
    pub warnings: BTreeMap<String, usize>,
    /// Where the results lie in the store.
    pub folder: String,
    /// The results.
    pub files: Vec<StoredFile>,
    /// Counts and scores.
    pub result: serde_json::Value,
    /// What it took.
    pub cost: Cost,
}

impl TaskRecord {
    fn name(key: &str) -> String {
        format!("records/{key}.json")
    }

    /// The record of a key, if the task was done.
    pub(super) fn find(store: &Store, key: &str) -> Result<Option<Self>, Error> {
        let name = Self::name(key);
        let Some(bytes) = store.get(&name, MAX_JSON_BYTES)? else { return Ok(None) };
        let bad = |reason: String| Error::NotABatch { name: format!("{}/{name}", store.uri()), reason };
        let record: Self = serde_json::from_slice(&bytes).map_err(|e| bad(e.to_string()))?;
        if record.schema != RECORD_SCHEMA || record.key != key {
            return Err(bad(format!(
                "it is {} of {}, expected {RECORD_SCHEMA} of {key}",
                record.schema, record.key
            )));
        }
        Ok(Some(record))
    }

    pub(super) fn write(&self, store: &Store) -> Result<(), Error> {
        Ok(store.put(&Self::name(&self.key), pretty(self)?)?)
    }

    /// Whether later stages cannot go on from it.
    pub fn is_failed(&self) -> bool {
        self.status == Status::Failed
    }

    /// Done, degraded or failed as an exit status of the program.
    pub fn exit_status(&self) -> ExitStatus {
        match self.status {
            Status::Done => ExitStatus::Done,
            Status::Degraded => ExitStatus::Degraded,
            Status::Failed => ExitStatus::BadInput,
        }
    }
}
