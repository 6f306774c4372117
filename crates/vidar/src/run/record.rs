//! Files of a run, and the manifest made of what was recorded of it.

use super::store::CHUNKS;
use super::{Plan, RunRequest};
use crate::chunks::ChunkStore;
use crate::error::{Error, ExitStatus};
pub(super) use crate::recorder::Recorder;
use crate::run_folder::{MANIFEST_SCHEMA, Manifest};
use std::collections::{BTreeMap, BTreeSet};
use vidar_dataset::Recording;

impl Recorder {
    /// Every file of the run so far, with those that are no results: its records, and what a later attempt can go on from.
    pub(super) fn files(&self) -> BTreeSet<String> {
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
    pub(super) fn manifest(
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
