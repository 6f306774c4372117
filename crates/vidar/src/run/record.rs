//! What a run remembers of itself: warnings, timings, files, and the manifest made of them.

use super::{Plan, RunRequest};
use crate::error::{Error, ExitStatus};
use crate::events::{Event, Events};
use crate::run_folder::{MANIFEST_SCHEMA, Manifest, RunFolder};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};
use vidar_core::Warning;
use vidar_dataset::Dataset;

/// Remembers what the events said, for the manifest and for `log.jsonl`.
#[derive(Clone, Default)]
pub(super) struct Recorder(Arc<Mutex<Recorded>>);

#[derive(Default)]
struct Recorded {
    /// Where the log goes, once the run has a folder.
    folder: Option<Arc<RunFolder>>,
    /// Events from before that.
    waiting: Vec<Event>,
    warnings: Vec<Warning>,
    seconds: Vec<(&'static str, f64)>,
    artifacts: Vec<String>,
}

/// Kinds of warnings that mean that part of the result is missing.
const DEGRADING: &[&str] = &[
    "image-unreadable",
    "image-empty",
    "image-missing",
    "chunk-failed",
    "chunk-not-placed",
    "fusion-memory-budget",
    "no-parallax",
    "depth-unreadable",
    "not-judged",
    "track-lost",
];

impl Recorder {
    /// The same events, remembered.
    pub fn listen(&self, events: Events) -> Events {
        let recorded = self.0.clone();
        events.with(move |event| {
            let Ok(mut recorded) = recorded.lock() else { return };
            match &recorded.folder {
                Some(folder) => folder.log(event),
                None => recorded.waiting.push(event.clone()),
            }
            match event {
                Event::Warning { warning } => recorded.warnings.push(warning.clone()),
                Event::StageFinished { stage, seconds } => recorded.seconds.push((stage, *seconds)),
                Event::ArtifactWritten { path, .. } => recorded.artifacts.push(path.clone()),
                _ => {}
            }
        })
    }

    /// From now on `log.jsonl` of this folder holds every event, also those from before.
    pub fn keep_log_in(&self, folder: Arc<RunFolder>) {
        let Ok(mut recorded) = self.0.lock() else { return };
        std::mem::take(&mut recorded.waiting).iter().for_each(|event| folder.log(event));
        recorded.folder = Some(folder);
    }

    fn read<T>(&self, f: impl FnOnce(&Recorded) -> T) -> T {
        match self.0.lock() {
            Ok(recorded) => f(&recorded),
            Err(poisoned) => f(&poisoned.into_inner()),
        }
    }

    /// Every warning so far, in order.
    pub fn warnings(&self) -> Vec<Warning> {
        self.read(|r| r.warnings.clone())
    }

    /// Whether a warning said that part of the result is missing.
    pub fn is_degraded(&self) -> bool {
        self.read(|r| r.warnings.iter().any(|w| DEGRADING.contains(&w.kind.as_str())))
    }

    /// The manifest of a run that ended with `exit`.
    pub fn manifest(&self, about: About, result: serde_json::Value, exit: ExitStatus) -> Manifest {
        let mut counts = BTreeMap::<String, u64>::new();
        self.read(|r| r.warnings.iter().for_each(|w| *counts.entry(w.kind.clone()).or_default() += 1));
        Manifest {
            seconds: self.read(|r| r.seconds.iter().map(|(k, s)| ((*k).to_owned(), (*s).into())).collect()),
            peak_memory_bytes: crate::system::peak_memory_bytes(),
            result,
            warnings: serde_json::json!(counts),
            artifacts: self.read(|r| r.artifacts.clone()),
            exit: exit as i32,
            ..about.0
        }
    }
}

/// What is known of a run before it did anything.
pub(super) struct About(Manifest);

impl About {
    /// Input, configuration, model and machine.
    pub fn new(request: &RunRequest, dataset: &Dataset, plan: &Plan) -> Result<Self, Error> {
        Ok(Self(Manifest {
            schema: MANIFEST_SCHEMA.into(),
            version: crate::VERSION.into(),
            command: request.command.clone(),
            started: plan.started.clone(),
            dataset: serde_json::json!({
                "name": dataset.name, "kind": dataset.kind.to_string(), "path": request.path.display().to_string(),
                "images": dataset.images.len(), "imu_samples": dataset.imu.len(),
                "depth_images": dataset.depths.len(),
            }),
            dataset_sha256: sha256_hex(&dataset.fingerprint()?),
            config_sha256: sha256_hex(request.layered.to_toml(false).as_bytes()),
            model: plan.model_json(),
            poses: super::outputs::source_json(plan),
            hardware: serde_json::json!(crate::system::hardware()),
            ..Manifest::default()
        }))
    }
}

/// The result of a run that failed.
pub(super) fn failure_json(error: &Error) -> serde_json::Value {
    serde_json::json!({ "error": { "code": error.code(), "message": error.to_string(), "hint": error.hint() } })
}

pub(crate) fn sha256_hex(bytes: &[u8]) -> String {
    use sha2::{Digest, Sha256};
    Sha256::digest(bytes).iter().map(|b| format!("{b:02x}")).collect()
}
