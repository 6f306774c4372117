//! Predictions of a run in its folder.

use crate::chunks::{ChunkStore, StoredChunk};
use crate::config::Config;
use crate::engine::{PredictedFrame, PredictionId, PredictionStore};
use crate::error::Error;
use crate::models::geometry::{AUTO, REMOTE};
use crate::run::plan::Plan;
use serde_json::json;
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};
use vidar_core::ChunkId;

/// Where predictions lie in the run folder.
pub(super) const CHUNKS: &str = "chunks";

/// `chunks/` and `volumes/` of a run folder.
pub(super) struct RunStore<'a> {
    chunks: ChunkStore,
    volumes: PathBuf,
    /// What all predictions of the run depend on, besides their own frames.
    identity: Vec<u8>,
    /// Called before a chunk counts as absent: it may be on its way.
    wait_for: Option<&'a dyn Fn(ChunkId)>,
}

impl<'a> RunStore<'a> {
    /// The store of a plan in the run folder `root`; `fingerprint` is the recording's.
    pub(super) fn new(root: &Path, fingerprint: &str, plan: &Plan, config: &Config) -> Self {
        let part = json!({
            "version": crate::VERSION,
            "model": plan.model_json(),
            "mode": plan.mode,
            "view": plan.view,
            "camera": format!("{:?}", plan.camera),
            "stereo": config.stereo,
            "fill": (plan.model.name == AUTO).then_some(&config.geometry.fill_network),
            "network": config.model,
            "remote": config.geometry.source.starts_with(REMOTE).then_some((config.remote.images, config.remote.depth)),
            "masks": plan.masks.as_ref().map(|m| m.sha256()),
            "place_recognition": plan.place_recognition,
        });
        let identity = format!("{fingerprint}{part}").into_bytes();
        Self {
            chunks: ChunkStore::new(root.join(CHUNKS)),
            volumes: root.join("volumes"),
            identity,
            wait_for: None,
        }
    }

    /// The same store, which waits for a chunk before it says that it is absent.
    pub(super) fn waiting(self, wait_for: Option<&'a dyn Fn(ChunkId)>) -> Self {
        Self { wait_for, ..self }
    }

    /// Removes volumes, and predictions unless they are to be kept.
    pub(super) fn clean(&self, keeps_predictions: bool) {
        // What cannot be removed is only left behind, and files of others stay.
        let entries = std::fs::read_dir(&self.volumes).into_iter().flatten();
        let volumes = entries.filter_map(|e| Some(e.ok()?.path()));
        for path in volumes.filter(|p| p.extension().is_some_and(|e| e == "volume")) {
            let _ = std::fs::remove_file(path);
        }
        let _ = std::fs::remove_dir(&self.volumes);
        if !keeps_predictions {
            self.chunks.remove_all();
        }
    }

    /// The files of a prediction that is there, the one that makes it valid last.
    pub(super) fn files_of(&self, id: PredictionId) -> Vec<PathBuf> {
        self.chunks.files_of(id)
    }

    /// SHA-256 of all that a prediction depends on.
    fn key(&self, frames: &[PredictedFrame]) -> String {
        let mut hash = Sha256::new_with_prefix(&self.identity);
        for (time, world_from_camera) in frames {
            hash.update(time.nanos().to_le_bytes());
            if let Some(pose) = world_from_camera {
                pose.matrix().iter().for_each(|v| hash.update(v.to_le_bytes()));
            }
        }
        vidar_hub::hex(&hash.finalize())
    }

    fn volume(&self, chunk: ChunkId) -> PathBuf {
        self.volumes.join(format!("{:06}.volume", chunk.0))
    }
}

impl PredictionStore for RunStore<'_> {
    fn find(&self, id: PredictionId, frames: &[PredictedFrame]) -> Option<StoredChunk> {
        let key = self.key(frames);
        let kept = self.chunks.find(id, &key);
        match (kept, id, self.wait_for) {
            (None, PredictionId::Chunk(chunk), Some(wait_for)) => {
                wait_for(chunk);
                self.chunks.find(id, &key)
            }
            (kept, ..) => kept,
        }
    }

    fn keep(
        &self,
        id: PredictionId,
        frames: &[PredictedFrame],
        chunk: &StoredChunk,
    ) -> Result<StoredChunk, Error> {
        self.chunks.write(id, chunk, &self.key(frames))?;
        self.chunks.read(id)
    }

    fn read(&self, id: PredictionId) -> Result<StoredChunk, Error> {
        self.chunks.read(id)
    }

    fn keep_volume(&self, chunk: ChunkId, bytes: &[u8]) -> Result<(), Error> {
        std::fs::create_dir_all(&self.volumes).map_err(|e| Error::io("create", &self.volumes, e))?;
        Ok(vidar_export::atomic::write_file_atomically(&self.volume(chunk), bytes)?)
    }

    fn read_volume(&self, chunk: ChunkId) -> Result<Vec<u8>, Error> {
        let path = self.volume(chunk);
        std::fs::read(&path).map_err(|e| Error::io("read", &path, e))
    }
}
