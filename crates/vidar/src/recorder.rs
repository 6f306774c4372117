//! Warnings, timings and files of a run as a reader of its events.

use crate::events::{Event, Events};
use crate::run_folder::RunFolder;
use std::sync::{Arc, Mutex};
use vidar_core::{Severity, Warning};

/// Records events for the manifest and for `log.jsonl`.
#[derive(Clone, Default)]
pub(crate) struct Recorder(Arc<Mutex<Recorded>>);

/// What was recorded so far.
#[derive(Default)]
pub(crate) struct Recorded {
    /// Where the log goes, once the run has a folder.
    pub folder: Option<Arc<RunFolder>>,
    /// Events from before that.
    waiting: Vec<Event>,
    /// In order.
    pub warnings: Vec<Warning>,
    /// Of each stage and step, in the order in which they ended.
    pub seconds: Vec<(&'static str, f64)>,
    /// Paths in the folder.
    pub artifacts: Vec<String>,
    /// Where the poses of the world that is mapped come from.
    pub poses: Option<serde_json::Value>,
}

impl Recorder {
    /// The same events, recorded.
    pub fn listen(&self, events: Events) -> Events {
        let recorded = self.0.clone();
        events.with(move |event| {
            let Ok(mut recorded) = recorded.lock() else { return };
            let failed = match &recorded.folder {
                Some(folder) => folder.log(event),
                None => {
                    recorded.waiting.push(event.clone());
                    None
                }
            };
            recorded.warnings.extend(failed);
            match event {
                Event::Warning { warning } => recorded.warnings.push(warning.clone()),
                Event::StageFinished { stage: name, seconds }
                | Event::StepFinished { step: name, seconds } => {
                    recorded.seconds.push((name, *seconds));
                }
                Event::ArtifactWritten { path, .. } => recorded.artifacts.push(path.clone()),
                Event::World { poses, .. } => recorded.poses = Some(serde_json::json!(poses)),
                _ => {}
            }
        })
    }

    /// From now on `log.jsonl` of this folder holds every event, also those from before.
    pub fn keep_log_in(&self, folder: Arc<RunFolder>) {
        let Ok(mut recorded) = self.0.lock() else { return };
        let waiting = std::mem::take(&mut recorded.waiting);
        recorded.warnings.extend(waiting.iter().filter_map(|event| folder.log(event)));
        recorded.folder = Some(folder);
    }

    /// Reads what was recorded.
    pub fn read<T>(&self, f: impl FnOnce(&Recorded) -> T) -> T {
        match self.0.lock() {
            Ok(recorded) => f(&recorded),
            Err(poisoned) => f(&poisoned.into_inner()),
        }
    }

    /// Every warning so far, in order.
    pub fn warnings(&self) -> Vec<Warning> {
        self.read(|r| r.warnings.clone())
    }

    /// Whether a part of the result is missing or weaker than asked for.
    pub fn is_degraded(&self) -> bool {
        self.read(|r| r.warnings.iter().any(|w| w.severity == Severity::Degraded))
    }
}
