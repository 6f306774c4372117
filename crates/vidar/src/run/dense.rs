//! Keyframes into one metric surface, chunk after chunk.

use super::MetricMap;
use super::live::LiveMap;
use super::looks::Looks;
use super::observation::{self, Known};
use super::placed::placed_view;
use super::plan::{ChunkPlan, Plan};
use super::source::Source;
use super::sparse::Sparse;
use super::surface::{Surface, store};
use super::views::ViewWindow;
use crate::chunks::{ChunkStore, StoredChunk};
use crate::config::Config;
use crate::error::Error;
use crate::events::{CancelToken, Event, Events};
use crate::run_folder::RunFolder;
use rayon::prelude::*;
use serde_json::json;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use vidar_align::aligner::LoopCandidate;
use vidar_align::{Aligner, ChunkObservation, Placement, color_at_size};
use vidar_core::model::ChunkFrame;
use vidar_core::remap::RemapTable;
use vidar_core::{
    AlignedView, ChunkId, ChunkView, ChunkViews, FrameId, GeometryPrediction, Image, ModelError, Se3,
    SparseLandmark, ViewGeometry, Warning,
};
use vidar_dataset::Dataset;
use vidar_fusion::FusionConfig;

/// Predicts every chunk, places them all, fuses them. Stops between chunks when cancelled and keeps what is there.
pub fn build(
    dataset: &Dataset,
    plan: &Plan,
    (source, looks): (Source, Looks),
    config: &Config,
    folder: &RunFolder,
    events: &Events,
    cancel: &CancelToken,
) -> Result<MetricMap, Error> {
    let store = ChunkStore::new(folder.path().join("chunks"));
    let mut road = Road { dataset, plan, config, folder, store, events, cancel };
    let count = plan.keyframes.len();
    let placement = events.stage("depth", count, || road.observe(source, &looks))?;
    let mut map = events.stage("surface", count, || road.fuse(&placement))?;
    map.placement = Some(placement);
    if !(config.output.keep_chunks || cancel.is_cancelled()) {
        road.store.remove_all();
    }
    map.warnings.iter().for_each(|w| events.warn(w));
    Ok(map)
}

fn number(chunk: usize) -> ChunkId {
    ChunkId(u32::try_from(chunk).unwrap_or(u32::MAX))
}

/// What the stages share.
struct Road<'a> {
    dataset: &'a Dataset,
    plan: &'a Plan,
    config: &'a Config,
    folder: &'a RunFolder,
    store: ChunkStore,
    events: &'a Events,
    cancel: &'a CancelToken,
}

impl Road<'_> {
    /// Chunk after chunk: images in, a prediction kept on disk, its place found.
    fn observe(&mut self, mut source: Source, looks: &Looks) -> Result<Placement, Error> {
        let remap = RemapTable::new(&self.plan.camera, &self.plan.view);
        let mut window = ViewWindow::new(self.dataset, &self.plan.keyframes, &remap);
        let mut aligner = Aligner::new(self.plan.mode, &self.config.align)?;
        if looks.are_whitened() {
            aligner = aligner.with_whitened_descriptors();
        }
        let identity = identity(self.dataset, self.plan, self.config)?;
        let camera = self.dataset.rig.camera(self.dataset.camera);
        let body_from_camera = camera.map_or(Se3::IDENTITY, |c| c.body_from_camera);
        let known = Known::new(self.plan, body_from_camera, source.overlaps());
        let sparse = Sparse::wanted(self.plan, &source, self.config)?;
        let live = self.config.output.live_map.then(|| LiveMap::new(self.config, self.folder));
        let mut live = live.transpose()?;
        let mut failures: Vec<String> = Vec::new();
        for (k, chunk) in self.plan.chunks.iter().enumerate() {
            if self.cancel.is_cancelled() {
                break;
            }
            let key = key_of(&identity, self.plan, chunk.core.clone().chain(chunk.seen.clone()));
            let stored = match self.store.find(number(k), &key) {
                Some(kept) => kept,
                None => match self.predict((&mut source, looks), &mut window, k, chunk, &key)? {
                    Some(predicted) => predicted,
                    None => break,
                },
            };
            match stored.failure {
                Some(reason) => {
                    self.events.warn(&Warning::new("chunk-failed", reason.clone()).at(format!("chunk {k}")));
                    failures.push(reason);
                }
                None => {
                    let by_stereo = match &sparse {
                        Some(sparse) => self.landmarks(sparse, &mut window, chunk, &stored.prediction),
                        None => BTreeMap::new(),
                    };
                    let observation = observation::of(self.plan, (&known, looks), chunk, stored, &by_stereo);
                    failures.extend(self.align(&mut aligner, observation)?);
                }
            }
            self.close_loops(&mut aligner, &mut source, &window, &identity)?;
            if let Some(live) = &mut live {
                let so_far = aligner.placement_so_far();
                let views = aligned(&so_far, self.store.read(number(k))?)?;
                live.grow(number(k), &views, &so_far, self.folder, self.events)?;
            }
            let (done, total) = (chunk.seen.end, self.plan.keyframes.len());
            self.events.emit(&Event::Progress { stage: "depth", done, total });
        }
        if let Some(live) = &live {
            live.clear(self.folder);
        }
        let placement = aligner.finish();
        if placement.views.is_empty() && !self.cancel.is_cancelled() {
            let reason = failures.pop().unwrap_or_else(|| "no keyframe image could be read".into());
            return Err(self.nothing_placed(reason));
        }
        Ok(placement)
    }

    /// Why there is no map.
    fn nothing_placed(&self, reason: String) -> Error {
        let keyframes = self.plan.keyframes.len();
        let network = self.plan.network.as_ref().map(|network| &network.identity);
        match network.filter(|identity| !identity.geometry_means_something) {
            Some(identity) => Error::Untrained { keyframes, model: identity.name.clone() },
            None => Error::Empty { keyframes, reason },
        }
    }

    /// What the model says of a chunk, as it then lies on disk; `None` when cancelled.
    fn predict(
        &self,
        (source, looks): (&mut Source, &Looks),
        window: &mut ViewWindow<'_>,
        k: usize,
        chunk: &ChunkPlan,
        key: &str,
    ) -> Result<Option<StoredChunk>, Error> {
        window.advance(&chunk.seen, self.events);
        let wanted = if source.overlaps() { &chunk.seen } else { &chunk.core };
        let (views, range, indices) = window.take(wanted);
        let expected = range.len();
        let views = ChunkViews { id: number(k), views };
        let predicted = match source.predict(&views, range, &|| self.cancel.is_cancelled()) {
            Err(ModelError::Cancelled) => None,
            Err(error) => Some(failed(number(k), error.to_string())),
            Ok(prediction) if prediction.views.is_empty() => {
                Some(failed(number(k), "no keyframe of the chunk got depth".into()))
            }
            Ok(prediction) => {
                let missing = expected.saturating_sub(prediction.views.len());
                if missing > 0 {
                    let message = format!("{missing} of {expected} keyframes got no depth");
                    let place = format!("chunk {k}");
                    self.events.warn(&Warning::new("keyframes-without-depth", message).at(place));
                }
                let mut stored = colored(prediction, &views.views, source.take_colors());
                looks.describe(&mut stored, &source.take_place_tokens())?;
                Some(stored)
            }
        };
        window.put_back(views.views, indices);
        let Some(predicted) = predicted else { return Ok(None) };
        self.store.write(&predicted, key)?;
        // Read back, so that a run that was interrupted goes on from the very same numbers.
        self.store.read(number(k)).map(Some)
    }

    /// What stereo is sure of in a chunk's views; the map does without where it fails.
    fn landmarks(
        &self,
        sparse: &Sparse,
        window: &mut ViewWindow<'_>,
        chunk: &ChunkPlan,
        prediction: &GeometryPrediction,
    ) -> BTreeMap<FrameId, Vec<SparseLandmark>> {
        window.advance(&chunk.seen, self.events);
        let (views, _, indices) = window.take(&chunk.seen);
        let found = sparse.of(prediction, &views, &|| self.cancel.is_cancelled());
        window.put_back(views, indices);
        found.unwrap_or_else(|error| {
            self.events.warn(
                &Warning::new("no-stereo-landmarks", error.to_string())
                    .at(format!("chunk {}", prediction.chunk_id)),
            );
            BTreeMap::new()
        })
    }

    /// Tells the aligner of a chunk. A chunk that finds no place is a named loss, not the end of the run.
    fn align(&self, aligner: &mut Aligner, observation: ChunkObservation) -> Result<Option<String>, Error> {
        let report = aligner.push(observation)?;
        self.events.emit(&Event::ChunkAligned {
            chunk: report.chunk_id.0,
            scale: report.world_from_chunk.map(|s| s.scale),
            center_rms_m: Some(report.center_rms_m).filter(|m| m.is_finite()),
            status: report.status,
        });
        if report.status.is_usable() {
            return Ok(None);
        }
        let mut message = format!("not placed: {}", report.status.description());
        if report.center_rms_m.is_finite() {
            message += &format!(" (camera centres {:.3} m RMS off)", report.center_rms_m);
        }
        let warning = Warning::new("chunk-not-placed", message.clone());
        self.events.warn(&warning.at(format!("chunk {}", report.chunk_id)));
        Ok(Some(message))
    }

    /// Judges the revisits that the newest chunk brought: by what is stored of both ends, or by a chunk of both ends.
    fn close_loops(
        &self,
        aligner: &mut Aligner,
        source: &mut Source,
        window: &ViewWindow<'_>,
        identity: &[u8],
    ) -> Result<(), Error> {
        for candidate in aligner.loop_candidates() {
            let together = match source.sees_any_views() && self.config.coupling.loop_chunks {
                true => self.predict_loop(&candidate, source, window, identity)?,
                false => None,
            };
            aligner.push_loop(&candidate, together.as_ref())?;
        }
        Ok(())
    }

    /// What the model says of both ends of a revisit together; `None` where it has nothing to say.
    fn predict_loop(
        &self,
        candidate: &LoopCandidate,
        source: &mut Source,
        window: &ViewWindow<'_>,
        identity: &[u8],
    ) -> Result<Option<GeometryPrediction>, Error> {
        let frames = candidate.earlier_window.iter().chain(&candidate.later_window);
        let place = |id| self.plan.keyframes.iter().position(|k| k.image.frame_id == id);
        let seen: Vec<usize> = frames.filter_map(|id| place(*id)).collect();
        let key = key_of(identity, self.plan, seen.iter().copied());
        // Numbers beyond those of any chunk, one per pair of chunks.
        let pair = candidate.later.0.wrapping_mul(LOOP_IDS).wrapping_add(candidate.earlier.0);
        let id = ChunkId(u32::MAX - pair % (u32::MAX / 2));
        if let Some(kept) = self.store.find(id, &key) {
            return Ok(Some(kept.prediction));
        }
        let views: Result<Vec<ChunkView>, Warning> = seen.iter().map(|k| window.load(*k)).collect();
        let Ok(views) = views else { return Ok(None) };
        let (views, count) = (ChunkViews { id, views }, seen.len());
        let Ok(prediction) = source.predict(&views, 0..count, &|| self.cancel.is_cancelled()) else {
            return Ok(None);
        };
        let stored = StoredChunk {
            times: prediction.views.iter().map(|_| Default::default()).collect(),
            prediction,
            colors: Vec::new(),
            looks: Vec::new(),
            failure: None,
        };
        self.store.write(&stored, &key)?;
        Ok(Some(self.store.read(id)?.prediction))
    }

    /// Every placed chunk's own keyframes into one surface; depth and images are written as they go by.
    fn fuse(&self, placement: &Placement) -> Result<MetricMap, Error> {
        let fusion =
            FusionConfig { memory_budget_bytes: self.plan.volume_budget_bytes, ..self.config.fusion.clone() };
        let mut surface = Surface::new(&fusion)?;
        let mut map = MetricMap::default();
        // Asked to stop while predicting, what was predicted is fused; asked to stop now, fusing stops.
        let was_cancelled = self.cancel.is_cancelled();
        for (k, chunk) in self.plan.chunks.iter().enumerate() {
            if self.cancel.is_cancelled() && !was_cancelled {
                break;
            }
            if !placement.views.iter().any(|v| v.owner == number(k)) {
                continue;
            }
            let views = aligned(placement, self.store.read(number(k))?)?;
            surface.fuse(&views, self.events)?;
            map.depth_scores.add(self.dataset, &views);
            map.views.extend(store(&views, self.config, self.folder, self.events)?);
            let (done, total) = (chunk.core.end, self.plan.keyframes.len());
            self.events.emit(&Event::Progress { stage: "surface", done, total });
        }
        surface.extract(&mut map);
        Ok(map)
    }
}

/// The views that a chunk owns, in metres and in the world.
fn aligned(placement: &Placement, stored: StoredChunk) -> Result<Vec<AlignedView>, Error> {
    let id = stored.prediction.chunk_id;
    let mut colors = stored.colors.into_iter();
    let mut views = Vec::new();
    for (view, time) in stored.prediction.views.into_iter().zip(stored.times) {
        let color = colors.next();
        let Some(place) = placement.view(view.frame_id).filter(|p| p.owner == id) else { continue };
        views.push(placed_view(view, time, place, color)?);
    }
    Ok(views)
}

fn failed(chunk_id: ChunkId, reason: String) -> StoredChunk {
    let prediction = GeometryPrediction { chunk_id, frame: ChunkFrame::ModelNative, views: Vec::new() };
    StoredChunk {
        prediction,
        times: Vec::new(),
        colors: Vec::new(),
        looks: Vec::new(),
        failure: Some(reason),
    }
}

/// A prediction with the times and pictures of its views; `given` pictures come before those of the input.
fn colored(prediction: GeometryPrediction, views: &[ChunkView], given: Vec<Image<[u8; 3]>>) -> StoredChunk {
    let of = |id| views.iter().find(|v| v.frame_id == id);
    let times =
        prediction.views.iter().map(|v| of(v.frame_id).map_or_else(Default::default, |v| v.time)).collect();
    let picture = |v: &ViewGeometry| {
        of(v.frame_id).map(|image| color_at_size(&image.image, v.intrinsics.width, v.intrinsics.height))
    };
    let colors = match given.len() == prediction.views.len() && !given.is_empty() {
        true => given,
        false => prediction.views.par_iter().map(picture).collect::<Option<_>>().unwrap_or_default(),
    };
    StoredChunk { prediction, times, colors, looks: Vec::new(), failure: None }
}

/// Chunk numbers below this give loops numbers of their own.
const LOOP_IDS: u32 = 40_000;

/// What all of a run's predictions are made of, besides their own frames.
fn identity(dataset: &Dataset, plan: &Plan, config: &Config) -> Result<Vec<u8>, Error> {
    let part = json!({
        "version": crate::VERSION,
        "model": plan.model_json(),
        "mode": plan.mode,
        "view": plan.view,
        "camera": format!("{:?}", plan.camera),
        "stereo": config.stereo,
        "network": config.model,
        "places": plan.places,
    });
    let mut bytes = dataset.fingerprint()?;
    bytes.extend(part.to_string().into_bytes());
    Ok(bytes)
}

/// The key of a chunk: SHA-256 of all that its prediction is made of.
fn key_of(identity: &[u8], plan: &Plan, keyframes: impl Iterator<Item = usize>) -> String {
    let mut hash = Sha256::new_with_prefix(identity);
    for keyframe in keyframes.map(|k| &plan.keyframes[k]) {
        hash.update(keyframe.image.time.nanos().to_le_bytes());
        if let Some(pose) = &keyframe.world_from_camera {
            pose.matrix().iter().for_each(|v| hash.update(v.to_le_bytes()));
        }
    }
    hash.finalize().iter().map(|b| format!("{b:02x}")).collect()
}
