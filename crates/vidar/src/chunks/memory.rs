//! Predictions of one run in memory: for runs that keep nothing.

use super::StoredChunk;
use crate::engine::{PredictedFrame, PredictionId, PredictionStore};
use crate::error::Error;
use std::cell::RefCell;
use std::collections::BTreeMap;
use vidar_core::ChunkId;

/// Predictions of one run. Volumes of the growing surface are kept, too.
#[derive(Default)]
pub struct MemoryStore {
    chunks: RefCell<BTreeMap<PredictionId, StoredChunk>>,
    volumes: RefCell<BTreeMap<ChunkId, Vec<u8>>>,
}

impl PredictionStore for MemoryStore {
    fn find(&self, _: PredictionId, _: &[PredictedFrame]) -> Option<StoredChunk> {
        None
    }

    fn keep(
        &self,
        id: PredictionId,
        _: &[PredictedFrame],
        chunk: &StoredChunk,
    ) -> Result<StoredChunk, Error> {
        self.chunks.borrow_mut().insert(id, chunk.clone());
        Ok(chunk.clone())
    }

    fn read(&self, id: PredictionId) -> Result<StoredChunk, Error> {
        let missing = || Error::BadValue { reason: format!("{id} was not predicted") };
        self.chunks.borrow().get(&id).cloned().ok_or_else(missing)
    }

    fn keep_volume(&self, chunk: ChunkId, bytes: &[u8]) -> Result<(), Error> {
        self.volumes.borrow_mut().insert(chunk, bytes.to_vec());
        Ok(())
    }

    fn read_volume(&self, chunk: ChunkId) -> Result<Vec<u8>, Error> {
        let missing = || Error::BadValue { reason: format!("no volume of chunk {chunk} was kept") };
        self.volumes.borrow().get(&chunk).cloned().ok_or_else(missing)
    }
}
