//! A run in parts: its track, and some of its chunks, each by a process of its own.
//!
//! Each part leaves in its folder what an interrupted run would have left: poses in `odometry/`, predictions in `chunks/`. A run
//! that is resumed in a folder with the parts of all others makes the same map, bit by bit, as one that did everything itself.

use super::place_recognition::PlaceRecognition;
use super::plan::Plan;
use super::source::Source;
use super::start::{self, Started};
use super::store::RunStore;
use super::{Context, EngineParts, RunRequest, readers};
use crate::chunks::StoredChunk;
use crate::engine::{MapEvent, PredictedFrame, PredictionId, PredictionStore};
use crate::error::{Error, ExitStatus};
use crate::events::{CancelToken, Events};
use crate::input::ImageFiles;
use crate::odometry::TrackedPoses;
use std::cell::Cell;
use std::path::PathBuf;
use vidar_core::model::ChunkFrame;
use vidar_core::{ChunkId, Duration, GeometryPrediction, Warning};

/// Which chunks of a recording: those whose number leaves `index` when it is divided by `of`. How many chunks there are is only
/// known once a recording is tracked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Part {
    /// From 0.
    pub index: usize,
    /// Parts in all, from 1.
    pub of: usize,
}

/// Called with the files of a prediction once they are whole, the one that makes it valid last.
pub type Kept<'a> = &'a dyn Fn(PredictionId, &[PathBuf]) -> Result<(), Error>;

impl Part {
    /// Whether a chunk is of this part.
    pub fn has(self, chunk: ChunkId) -> bool {
        chunk.0 as usize % self.of.max(1) == self.index
    }
}

/// What is known of a recording that was started.
#[derive(Clone, Debug)]
pub struct PartOutcome {
    /// SHA-256 of what the recording consists of.
    pub fingerprint: String,
    /// Images in it.
    pub images: usize,
    /// From its first to its last image.
    pub length: Duration,
    /// Chunks that were predicted.
    pub chunks: usize,
    /// Every warning, in order.
    pub warnings: Vec<Warning>,
}

impl PartOutcome {
    fn of(started: &Started, chunks: usize) -> Self {
        let images = &started.dataset.images;
        let length = images.first().zip(images.last()).map_or(Duration::ZERO, |(a, b)| b.time - a.time);
        let (fingerprint, warnings) = (started.fingerprint.clone(), started.recorder.warnings());
        Self { fingerprint, images: images.len(), length, chunks, warnings }
    }
}

/// Calibrates and tracks a recording, and leaves its poses in the run folder. Where poses are given, there is nothing to
/// track, and the folder holds the description of the run alone.
///
/// # Errors
/// The input cannot be used, or the folder cannot be written.
pub fn track(request: &RunRequest, events: &Events, cancel: &CancelToken) -> Result<PartOutcome, Error> {
    let started = start::start(request, false, None, events, cancel)?;
    if cancel.is_cancelled() {
        return Err(Error::Interrupted { path: started.folder.path().to_owned() });
    }
    let outcome = PartOutcome::of(&started, 0);
    let manifest =
        started.recorder.manifest(started.description, serde_json::Value::Null, ExitStatus::Interrupted);
    started.folder.write_manifest(&manifest)?;
    Ok(outcome)
}

/// Predicts the chunks of `part` that are not in the run folder yet, whose `odometry/` [`track`] left. `kept` gets the files
/// of each chunk, once they are whole.
///
/// A recording that is tracked while it is mapped (`odometry.adjust=false`) is left to the run as a whole: 0 chunks.
///
/// # Errors
/// The input cannot be used, or what `kept` returns.
pub fn predict(
    request: &RunRequest,
    part: Part,
    kept: Kept<'_>,
    events: &Events,
    cancel: &CancelToken,
) -> Result<PartOutcome, Error> {
    let mut started = start::start(request, false, None, events, cancel)?;
    let poses = started.poses.take();
    let is_tracked_live = poses.is_none() && started.plan.poses.is_odometry();
    let chunks = match is_tracked_live {
        true => 0,
        false => predict_chunks(&mut started, poses, request, part, kept, cancel)?,
    };
    match cancel.is_cancelled() {
        true => Err(Error::Interrupted { path: started.folder.path().to_owned() }),
        false => Ok(PartOutcome::of(&started, chunks)),
    }
}

/// The chunks of `part` that there are now.
fn predict_chunks(
    started: &mut Started,
    poses: Option<TrackedPoses>,
    request: &RunRequest,
    part: Part,
    kept: Kept<'_>,
    cancel: &CancelToken,
) -> Result<usize, Error> {
    // Nothing of it is shown, and a surface that grows costs time.
    started.config.output.live_map = false;
    let Started { events, config, dataset, fingerprint, plan, source, places, folder, .. } = started;
    let context = Context {
        request,
        live: None,
        config,
        dataset,
        fingerprint,
        folder,
        scene: None,
        stream: None,
        events,
        cancel,
    };
    let store = RunStore::new(folder.path(), fingerprint, plan, config);
    let (cancelled, warned) = (|| cancel.is_cancelled(), |warning| events.warn(&warning));
    predict_part(&context, plan, (source, places, &store), poses, (part, kept), &cancelled, &warned)
}

/// Predicts the chunks of `part` into the store; how many there are now.
pub(super) fn predict_part(
    context: &Context<'_>,
    plan: &Plan,
    (source, places, store): (&mut Source, &PlaceRecognition, &RunStore<'_>),
    poses: Option<TrackedPoses>,
    (part, kept): (Part, Kept<'_>),
    cancelled: &(dyn Fn() -> bool + Sync),
    warned: &dyn Fn(Warning),
) -> Result<usize, Error> {
    let store = PartStore { inner: store, part, kept, count: Cell::new(0) };
    let images = ImageFiles(context.dataset, plan.masks.as_deref());
    let predicting = readers::chunk_progress(context.events);
    let parts = EngineParts { geometry: source, places, images: &images, store: &store };
    let poses = poses.map(|p| Box::new(p) as Box<dyn crate::engine::PoseSource>);
    let mut engine = context.engine(plan, poses, parts, cancelled, &predicting)?;
    let mut sink = |event| {
        // Chunks of other parts count as failed.
        if let MapEvent::Warning(warning) = event
            && warning.kind != FAILED
        {
            warned(warning);
        }
        Ok(())
    };
    let predicted = context.push_recording(&mut engine, &mut sink).and_then(|()| engine.finish(&mut sink));
    match predicted {
        // No chunk is placed here, so that there is nothing to fuse.
        Ok(()) | Err(Error::Empty { .. }) => Ok(store.count.get()),
        Err(error) => Err(error),
    }
}

/// Kind of the engine's warning of a chunk that failed.
const FAILED: &str = "chunk-failed";

/// Predictions of one part; those of other parts count as failed, so that they are neither predicted nor aligned. Which
/// keyframes a chunk has does not depend on what was predicted before.
struct PartStore<'a> {
    inner: &'a RunStore<'a>,
    part: Part,
    kept: Kept<'a>,
    count: Cell<usize>,
}

impl PredictionStore for PartStore<'_> {
    fn find(&self, id: PredictionId, frames: &[PredictedFrame]) -> Option<StoredChunk> {
        let is_ours = matches!(id, PredictionId::Chunk(chunk) if self.part.has(chunk));
        let is_there = is_ours && self.inner.find(id, frames).is_some();
        self.count.set(self.count.get() + usize::from(is_there));
        (!is_ours || is_there).then(|| left(id))
    }

    fn keep(
        &self,
        id: PredictionId,
        frames: &[PredictedFrame],
        chunk: &StoredChunk,
    ) -> Result<StoredChunk, Error> {
        self.inner.keep(id, frames, chunk)?;
        (self.kept)(id, &self.inner.files_of(id))?;
        self.count.set(self.count.get() + 1);
        Ok(left(id))
    }

    fn read(&self, id: PredictionId) -> Result<StoredChunk, Error> {
        Ok(left(id))
    }

    fn keep_volume(&self, _: ChunkId, _: &[u8]) -> Result<(), Error> {
        Ok(())
    }

    fn read_volume(&self, chunk: ChunkId) -> Result<Vec<u8>, Error> {
        self.inner.read_volume(chunk)
    }
}

/// A chunk that is not aligned here.
fn left(id: PredictionId) -> StoredChunk {
    let (chunk_id, frame) = (id.model_number(), ChunkFrame::ModelNative);
    let nothing = GeometryPrediction { chunk_id, frame, views: Vec::new() };
    StoredChunk { failure: Some("left to the map".into()), ..StoredChunk::of(nothing) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_chunk_is_of_exactly_one_part() {
        for of in 1..7 {
            for chunk in 0..40 {
                let owners = (0..of).filter(|index| Part { index: *index, of }.has(ChunkId(chunk)));
                assert_eq!(owners.count(), 1, "chunk {chunk} of {of}");
            }
        }
    }
}
