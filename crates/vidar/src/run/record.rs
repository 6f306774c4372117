//! Warnings, timings and files of a run as a reader of its events, and the manifest made of them.

use super::store::CHUNKS;
use super::{Plan, RunRequest};
use crate::chunks::ChunkStore;
use crate::error::{Error, ExitStatus};
use crate::events::{Event, Events};
use crate::run_folder::{MANIFEST_SCHEMA, Manifest, RunFolder};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex};
use vidar_core::{Severity, Warning};
use vidar_dataset::Recording;

/// Records events for the manifest and for `log.jsonl`.
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
    /// Where the poses of the world that is mapped come from.
    poses: Option<serde_json::Value>,
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

    /// Whether a part of the result is missing or weaker than asked for.
    pub fn is_degraded(&self) -> bool {
        self.read(|r| r.warnings.iter().any(|w| w.severity == Severity::Degraded))
    }

    /// Every file of the run so far, with those that are no results: its records, and what a later attempt can go on from.
    pub fn files(&self) -> BTreeSet<String> {
        let own = ["config.resolved.toml", "log.jsonl", "manifest.json"].map(String::from);
        self.read(|r| {
            let root = r.folder.as_ref().map(|f| f.path().to_owned()).unwrap_or_default();
            let tracked = root.join(super::tracking::FILE);
            let left = ChunkStore::new(root.join(CHUNKS)).files().into_iter().chain([tracked]);
            let left = left.filter(|p| p.is_file());
            let left = left.filter_map(|p| Some(p.strip_prefix(&root).ok()?.to_str()?.replace('\\', "/")));
            r.artifacts.iter().cloned().chain(own).chain(left).collect()
        })
    }

    /// The manifest of a run that ended with `exit`.
    pub fn manifest(
        &self,
        description: RunDescription,
        result: serde_json::Value,
        exit: ExitStatus,
    ) -> Manifest {
        let mut counts = BTreeMap::<String, u64>::new();
        self.read(|r| r.warnings.iter().for_each(|w| *counts.entry(w.kind.clone()).or_default() += 1));
        Manifest {
            seconds: self.read(|r| r.seconds.iter().map(|(k, s)| ((*k).to_owned(), (*s).into())).collect()),
            peak_memory_bytes: crate::system::peak_memory_bytes(),
            result,
            warnings: serde_json::json!(counts),
            artifacts: self.files().into_iter().collect(),
            exit: Some(exit as i32),
            poses: self.read(|r| r.poses.clone()).unwrap_or_else(|| description.0.poses.clone()),
            ..description.0
        }
    }
}

/// What is known of a run before it starts.
pub(super) struct RunDescription(pub Manifest);

impl RunDescription {
    /// Input, configuration, model and machine.
    pub fn new(request: &RunRequest, dataset: &Recording, fingerprint: String, plan: &Plan) -> Self {
        Self(Manifest {
            schema: MANIFEST_SCHEMA.into(),
            version: crate::VERSION.into(),
            command: request.command.clone(),
            started: plan.started.clone(),
            dataset: serde_json::json!({
                "name": dataset.name, "kind": dataset.kind.to_string(), "path": request.path.display().to_string(),
                "images": dataset.images.len(), "imu_samples": dataset.imu.len(),
                "depth_images": dataset.depths.len(),
            }),
            dataset_sha256: fingerprint,
            config_sha256: vidar_hub::sha256_hex(request.layered.to_toml(false).as_bytes()),
            model: plan.model_json(),
            poses: serde_json::json!(plan.poses.source()),
            hardware: serde_json::json!(crate::system::hardware()),
            ..Manifest::default()
        })
    }
}

/// The result of a run that failed.
pub(super) fn failure_json(error: &Error) -> serde_json::Value {
    serde_json::json!({ "error": { "code": error.code(), "message": error.to_string(), "hint": error.hint() } })
}
