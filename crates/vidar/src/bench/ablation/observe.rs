//! The front half, once: track, select keyframes, predict, and gather what is known of the frames.

use crate::chunks::{MemoryStore, StoredChunk};
use crate::config::Config;
use crate::engine::{Engine, EngineSetup, MapEvent, PlaceDescriber, PredictionId, PredictionStore};
use crate::error::Error;
use crate::events::CancelToken;
use crate::input::{self, ImageFiles, Measurement};
use crate::run::{Plan, camera_on_rig, readout};
use std::collections::BTreeMap;
use vidar_align::FrameObservation;
use vidar_core::{ChunkId, FrameId, Timestamp};
use vidar_dataset::Recording;

/// Everything that couplings place and measure with.
pub struct Observed {
    /// The plan of the run.
    pub plan: Plan,
    /// Whether descriptors are averages of network tokens.
    pub is_whitened: bool,
    /// Times of all keyframes.
    pub keyframes: BTreeMap<FrameId, Timestamp>,
    /// Chunks in order, without colours.
    pub chunks: Vec<(StoredChunk, Vec<FrameObservation>)>,
}

/// Runs the engine on a recording and keeps what it hands to the aligner.
pub fn observe(dataset: &Recording, config: &Config, cancel: &CancelToken) -> Result<Observed, Error> {
    let (plan, mut source, places) = Plan::make(dataset, config, None)?;
    let (poses, fallback) = plan.poses.open(dataset, config)?;
    let store = MemoryStore::default();
    let images = ImageFiles(dataset, plan.masks.as_deref());
    let cancelled = || cancel.is_cancelled();
    let mut engine = Engine::new(EngineSetup {
        name: dataset.name.clone(),
        config,
        camera_id: plan.camera_id,
        camera: camera_on_rig(dataset, &plan),
        readout: readout(dataset, config),
        view: plan.view,
        poses,
        fallback,
        prescribed: plan.prescribed.clone(),
        geometry: &mut source,
        places: &places,
        images: &images,
        store: &store,
        volume_budget_bytes: plan.volume_budget_bytes,
        cancelled: &cancelled,
        predicting: &|_| {},
    })?;
    let mut keyframes = BTreeMap::new();
    let mut observed: Vec<(ChunkId, Vec<FrameObservation>)> = Vec::new();
    let mut sink = |event: MapEvent| {
        match event {
            MapEvent::World { .. } => {
                keyframes.clear();
                observed.clear();
            }
            MapEvent::Keyframe(keyframe) => {
                keyframes.insert(keyframe.stamp.frame_id, keyframe.stamp.time);
            }
            MapEvent::ChunkObserved { chunk, frames } => observed.push((chunk, frames)),
            _ => {}
        }
        Ok(())
    };
    for measurement in input::measurements(dataset, engine.needs_sensors()) {
        match measurement {
            Measurement::Event(event) => engine.push(event, &mut sink)?,
            Measurement::Stamp(stamp) | Measurement::Unreadable(stamp, _) => {
                engine.push_stamp(stamp, &mut sink)?;
            }
        }
    }
    engine.finish(&mut sink)?;
    let chunk = |(id, frames)| {
        let stored = StoredChunk { colors: Vec::new(), ..store.read(PredictionId::Chunk(id))? };
        Ok((stored, frames))
    };
    let chunks = observed.into_iter().map(chunk).collect::<Result<_, Error>>()?;
    Ok(Observed { is_whitened: places.is_whitened(), plan, keyframes, chunks })
}
