//! Predict, align, place and fuse: the way of a chunk of keyframes into the map.

use super::complete::{complete_chunks, without};
use super::fuse::SurfaceFusion;
use super::placed::{Shaped, placed_and_shaped, placed_views};
use super::{Engine, MapEvent, PredictionId, Sink, Step};
use crate::chunks::StoredChunk;
use crate::error::Error;
use crate::input::trajectory::TrajectorySource;
use std::sync::Arc;
use vidar_align::Placement;
use vidar_align::chunking::ChunkSpan;
use vidar_core::{ChunkId, TriangleMesh, Warning};
use vidar_fusion::{Floor, FusionConfig};

/// Share of a surface below the floor from which it is asked what is seen through the floor, and share of the depth from which that is left out (less does
/// not pay for fusing again). Of a walk through a flat with tiles 11 % of the surface lay below, of a hall seen from a drone 6 %, none of it through the floor.
const LEAST_BELOW: f64 = 0.005;
const LEAST_THROUGH: f64 = 0.002;

impl Engine<'_> {
    /// The next chunk that later keyframes cannot change.
    pub(super) fn next_chunk(&self, is_complete: bool) -> Result<Option<(ChunkId, ChunkSpan)>, Error> {
        let Some(world) = self.world.as_ref().filter(|_| !(self.cancelled)()) else { return Ok(None) };
        let chunk = match is_complete {
            true => self.rule.chunks(&world.frames)?.into_iter().nth(world.chunks),
            false => self.rule.decided(world.chunks, &world.frames)?.into_iter().next(),
        };
        let is_ready = |c: &ChunkSpan| is_complete || self.observer.is_decided(&world.keyframes, c.seen.end);
        Ok(chunk.filter(is_ready).map(|c| (number(world.chunks), c)))
    }

    /// Predict: depth of a chunk; `None` when cancelled.
    pub(super) fn predict(
        &mut self,
        id: ChunkId,
        chunk: &ChunkSpan,
        sink: &mut Sink<'_>,
    ) -> Result<Option<StoredChunk>, Error> {
        self.enter(Step::Predict, sink)?;
        let Some(world) = &mut self.world else { return Ok(None) };
        if let Some(track) = self.track.longest() {
            for keyframe in &mut world.keyframes[chunk.seen.clone()] {
                keyframe.as_calibrated(track, self.readout, &self.camera_model);
            }
        }
        let mut events = Vec::new();
        let prediction = self.predictor.predict(id, chunk, &world.keyframes, &mut events)?;
        events.into_iter().try_for_each(&mut *sink)?;
        Ok(prediction)
    }

    /// Align: the chunk in the metric world, and the loops that it closes.
    pub(super) fn align(
        &mut self,
        id: ChunkId,
        chunk: &ChunkSpan,
        stored: StoredChunk,
        sink: &mut Sink<'_>,
    ) -> Result<(), Error> {
        self.enter(Step::Align, sink)?;
        let Some(world) = &mut self.world else { return Ok(()) };
        world.chunks += 1;
        let mut events = Vec::new();
        match &stored.failure {
            Some(reason) => world.failures.push(reason.clone()),
            None => {
                let descriptors = self.predictor.places.descriptors(&stored);
                let keyframes = &world.keyframes;
                let prediction = stored.prediction;
                let by_stereo = self.predictor.landmarks(chunk, keyframes, &prediction, &mut events);
                let observation =
                    self.observer.observe(keyframes, chunk, prediction, &descriptors, &by_stereo);
                events.push(MapEvent::ChunkObserved { chunk: id, frames: observation.frames.clone() });
                let report = world.aligner.push(observation)?;
                if !report.status.is_usable() {
                    let mut message = format!("not placed: {}", report.status.description());
                    if report.center_rms_m.is_finite() {
                        message += &format!(" (RMS distance of camera centres {:.3} m)", report.center_rms_m);
                    }
                    world.failures.push(message.clone());
                    let warning = Warning::degraded("chunk-not-placed", message).at(PredictionId::Chunk(id));
                    events.push(MapEvent::Warning(warning));
                }
                events.push(MapEvent::ChunkPlaced(report));
            }
        }
        let predicts_loops = self.predictor.geometry.predicts_any_views() && self.config.coupling.loop_chunks;
        let candidates = match self.config.coupling.loops {
            true => world.aligner.loop_candidates(),
            false => Vec::new(),
        };
        for candidate in candidates {
            let together = match predicts_loops {
                true => self.predictor.predict_loop(&candidate, &world.keyframes, &mut events)?,
                false => None,
            };
            events.push(MapEvent::LoopMeasured(world.aligner.push_loop(&candidate, together.as_ref())?));
        }
        if let Some(growing) = &mut self.growing {
            let placement = Arc::new(world.aligner.provisional_placement());
            if std::mem::take(&mut world.is_resettled) {
                growing.fuse_again(&placement, self.predictor.store)?;
            }
            let stored = self.predictor.store.read(PredictionId::Chunk(id))?;
            let grown =
                growing.grow(id, &placed_views(&placement, stored)?, &placement, self.predictor.store)?;
            events.push(MapEvent::PlacementsRevised { placement, is_final: false });
            events.extend(grown);
        }
        events.into_iter().try_for_each(&mut *sink)
    }

    /// Every chunk and keyframe, placed by all that was measured.
    pub(super) fn place(&mut self, sink: &mut Sink<'_>) -> Result<Arc<Placement>, Error> {
        let is_cancelled = (self.cancelled)();
        let without_pose = self.track.without_pose;
        if without_pose > 0 && self.poses.is_some() {
            let message =
                format!("{without_pose} of {} images have no pose and are skipped", self.candidates.len());
            let hint = "they lie outside the trajectory, or in a gap longer than input.max_pose_gap_secs";
            sink(MapEvent::Warning(Warning::new("images-without-pose", message).hint(hint)))?;
        }
        let needed = self.predictor.geometry.info().min_views.max(1);
        let found = self.world.as_ref().map_or(0, |w| w.keyframes.len());
        if found < needed && !is_cancelled {
            return Err(Error::TooFewKeyframes { found, needed });
        }
        if self.world.is_none() {
            self.begin_world(None, sink)?;
        }
        let world = self.world.take().ok_or(Error::TooFewKeyframes { found, needed })?;
        self.enter(Step::Align, sink)?;
        let placement = Arc::new(world.aligner.finish());
        if placement.views.is_empty() && !is_cancelled {
            let reason = world.failures.last().cloned();
            let reason = reason.unwrap_or_else(|| "no keyframe image could be read".into());
            return Err(Error::Empty { keyframes: found, reason });
        }
        sink(MapEvent::PlacementsRevised { placement: placement.clone(), is_final: true })?;
        Ok(placement)
    }

    /// Fuse: every placed chunk's own keyframes into one surface.
    pub(super) fn fuse(&mut self, placement: &Placement, sink: &mut Sink<'_>) -> Result<(), Error> {
        self.enter(Step::Fuse, sink)?;
        let fusion =
            FusionConfig { memory_budget_bytes: self.volume_budget_bytes, ..self.config.fusion.clone() };
        // Asked to stop while predicting, what was predicted is fused; asked to stop now, fusing stops.
        let was_cancelled = (self.cancelled)();
        let cancelled = self.cancelled;
        let is_stopped = || cancelled() && !was_cancelled;
        let owns_views = |c: &ChunkId| placement.views.iter().any(|v| v.owner == *c);
        let chunks: Vec<ChunkId> = placement.chunks.iter().map(|c| c.chunk_id).filter(owns_views).collect();
        let (completes, store) = (self.predictor.geometry.completes(), self.predictor.store);
        let read = |chunk: ChunkId, floor: Option<&Floor>| {
            read_views(placement, store.read(PredictionId::Chunk(chunk))?, floor)
        };
        let fuse = |floor: Option<&Floor>, sink: &mut Sink<'_>| {
            let mut surface = SurfaceFusion::new(&fusion)?;
            let mut fused = 0;
            while fused < chunks.len() && !is_stopped() {
                let views: Vec<_> = read(chunks[fused], floor)?.into_iter().map(|s| s.view).collect();
                surface.fuse(&views).into_iter().try_for_each(&mut *sink)?;
                if !completes {
                    sink(MapEvent::ViewsFused(views))?;
                }
                fused += 1;
            }
            Ok::<_, Error>((surface, fused))
        };
        let (mut surface, mut fused) = fuse(None, sink)?;
        if completes {
            let mut mesh = surface.mesh();
            let floor = self.floor_with_much_below(&mesh, placement).filter(|_| !is_stopped());
            let unmasked = |chunk| read(chunk, None);
            let through =
                floor.as_ref().map(|f| share_through(f, &chunks[..fused], &unmasked)).transpose()?;
            let floor = floor.filter(|_| through.is_some_and(|share| share > LEAST_THROUGH));
            if let (Some(floor), Some(share)) = (&floor, through) {
                (surface, fused) = fuse(Some(floor), sink)?;
                mesh = surface.mesh();
                sink(MapEvent::Warning(seen_through(share)))?;
            }
            self.enter(Step::Complete, sink)?;
            let read = |chunk| read(chunk, floor.as_ref());
            complete_chunks(&chunks[..fused], &read, &mesh, &mut surface, &is_stopped, sink)?;
        }
        let (surface, warnings) = surface.finish();
        for warning in warnings {
            sink(MapEvent::Warning(warning))?;
        }
        sink(MapEvent::SurfaceChanged { surface: Arc::new(surface), shown: Vec::new(), is_final: true })
    }

    /// The floor of a world with z up, where much of the surface lies below it.
    fn floor_with_much_below(&self, mesh: &TriangleMesh, placement: &Placement) -> Option<Floor> {
        self.poses.as_ref().filter(|p| p.source() == TrajectorySource::Odometry)?;
        let centres: Vec<_> = placement.views.iter().map(|v| v.world_from_camera.translation).collect();
        Floor::of_mesh(mesh, &centres).filter(|floor| floor.share_below(mesh) > LEAST_BELOW)
    }
}

/// The views of a chunk where they are placed, without what they show through `floor`.
fn read_views(
    placement: &Placement,
    stored: StoredChunk,
    floor: Option<&Floor>,
) -> Result<Vec<Shaped>, Error> {
    let without_floor = |s: Shaped| match floor.and_then(|f| f.seen_through(&s.view)) {
        Some(mask) => Ok(Shaped { view: without(&s.view, &mask)?, ..s }),
        None => Ok(s),
    };
    placed_and_shaped(placement, stored)?.into_iter().map(without_floor).collect()
}

/// Share of the views' depth that is seen through the floor.
fn share_through(
    floor: &Floor,
    chunks: &[ChunkId],
    read: &dyn Fn(ChunkId) -> Result<Vec<Shaped>, Error>,
) -> Result<f64, Error> {
    let (mut through, mut all) = (0, 0);
    for chunk in chunks {
        for Shaped { view, .. } in read(*chunk)? {
            all += view.depth().image().data().iter().filter(|z| z.is_finite()).count();
            let mask = floor.seen_through(&view);
            through += mask.map_or(0, |m| m.data().iter().filter(|is| **is).count());
        }
    }
    Ok(through as f64 / all.max(1) as f64)
}

fn seen_through(share: f64) -> Warning {
    let message = format!("{:.1} % of the depth is seen through the floor and left out", 100.0 * share);
    let hint =
        "a shiny floor mirrors what is above it; if this one does not, poses and depth contradict each other";
    Warning::new("seen-through-floor", message).hint(hint)
}

fn number(chunk: usize) -> ChunkId {
    ChunkId(u32::try_from(chunk).unwrap_or(u32::MAX))
}
