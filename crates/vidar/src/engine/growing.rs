//! The surface while the map grows: it follows the graph.
//!
//! Each chunk is a volume of its own, placed where the aligner has it now; when a loop moves chunks, their volumes move with
//! them. Volumes of older chunks are kept outside, so that memory stays flat. Keyframes that wait for their chunk may be shown
//! before ([`super::preview`]); the chunk replaces them. The final map is fused from the predictions at their final poses, each
//! keyframe once.

use super::events::{MapEvent, ShownKeyframe, Surface};
use super::placed::placed_views;
use super::setup::{PredictionId, PredictionStore};
use crate::config::Config;
use crate::error::Error;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use vidar_align::Placement;
use vidar_core::{AlignedView, ChunkId, FrameId, Warning};
use vidar_fusion::{RevisedView, SubVolumeConfig, SubVolumes, median_depth};

/// Chunks whose volumes are kept in memory.
const IN_MEMORY: usize = 2;

/// Least share of its pixels with depth for a keyframe to be called shown. A camera that rests gives some pixels at random: with none
/// asked for, a RealSense's first keyframe was called shown by a surface without a triangle. Of what moves a third or more have depth.
const LEAST_SHOWN: f64 = 0.05;

/// A growing surface.
pub struct GrowingSurface {
    config: SubVolumeConfig,
    volumes: SubVolumes,
    /// Depth scale that each keyframe was fused with.
    fused: BTreeMap<FrameId, f64>,
    /// Keyframes that are shown before their chunk is there.
    previewed: BTreeMap<FrameId, ChunkId>,
    /// Chunks in memory, oldest first.
    in_memory: Vec<ChunkId>,
}

impl GrowingSurface {
    /// A surface without chunks.
    pub fn new(config: &Config) -> Result<Self, Error> {
        let config = SubVolumeConfig { fusion: config.fusion.clone(), ..SubVolumeConfig::default() };
        let volumes = SubVolumes::new(&config)?;
        let (fused, previewed) = (BTreeMap::new(), BTreeMap::new());
        Ok(Self { config, volumes, fused, previewed, in_memory: Vec::new() })
    }

    /// Removes every chunk.
    pub fn reset(&mut self) -> Result<(), Error> {
        self.volumes = SubVolumes::new(&self.config)?;
        self.fused.clear();
        self.previewed.clear();
        self.in_memory.clear();
        Ok(())
    }

    /// Adds a chunk's views and moves the others to where they are now; the surface at these placements.
    pub fn grow(
        &mut self,
        chunk: ChunkId,
        views: &[AlignedView],
        placement: &Placement,
        store: &dyn PredictionStore,
    ) -> Result<Vec<MapEvent>, Error> {
        let (mut events, shown) = self.add(chunk, views, placement, store)?;
        self.follow(placement)?;
        events.push(self.surface(shown, store)?);
        Ok(events)
    }

    /// Fuses all chunks so far again at these placements: scaled by as much as a settled scale does, volumes are blurred, and their blocks grow
    /// with the cube.
    pub fn fuse_again(&mut self, placement: &Placement, store: &dyn PredictionStore) -> Result<(), Error> {
        let chunks: BTreeSet<ChunkId> =
            self.fused.keys().filter_map(|frame| self.volumes.owner(*frame)).collect();
        self.reset()?;
        for chunk in chunks {
            let views = placed_views(placement, store.read(PredictionId::Chunk(chunk))?)?;
            self.add(chunk, &views, placement, store)?;
        }
        Ok(())
    }

    /// Adds a chunk's views: what could not be fused, and which of them were not shown before.
    fn add(
        &mut self,
        chunk: ChunkId,
        views: &[AlignedView],
        placement: &Placement,
        store: &dyn PredictionStore,
    ) -> Result<(Vec<MapEvent>, Vec<ShownKeyframe>), Error> {
        let mut events = Vec::new();
        if self.previewed.values().any(|c| *c == chunk) {
            self.volumes.rebuild(chunk, [])?;
        }
        let mut shown = Vec::new();
        for view in views {
            let frame = view.frame_id();
            if self.fused.contains_key(&frame) {
                continue;
            }
            if integrate(&mut self.volumes, chunk, view, &mut events) {
                let scale = placement.view(frame).map_or(1.0, |p| p.metres_per_unit);
                self.fused.insert(frame, scale);
                if !self.previewed.contains_key(&frame) {
                    shown.extend(self.shown_keyframe(view));
                }
            }
        }
        self.previewed.retain(|_, c| *c != chunk);
        self.in_memory.push(chunk);
        while self.in_memory.len() > IN_MEMORY {
            let oldest = self.in_memory.remove(0);
            if self.volumes.chunks().any(|c| c == oldest) {
                store.keep_volume(oldest, &self.volumes.offload(oldest)?)?;
            }
        }
        Ok((events, shown))
    }

    /// Whether it has the depth of a keyframe.
    pub fn shows(&self, frame: FrameId) -> bool {
        self.fused.contains_key(&frame) || self.previewed.contains_key(&frame)
    }

    /// Adds views of chunks that are still to come, but for those that it has.
    pub fn preview(
        &mut self,
        views: Vec<(ChunkId, AlignedView)>,
        store: &dyn PredictionStore,
    ) -> Result<Vec<MapEvent>, Error> {
        let mut events = Vec::new();
        let mut shown = Vec::new();
        for (chunk, view) in views {
            if self.shows(view.frame_id()) {
                continue;
            }
            let Some(keyframe) = self.shown_keyframe(&view) else { continue };
            if integrate(&mut self.volumes, chunk, &view, &mut events) {
                self.previewed.insert(view.frame_id(), chunk);
                shown.push(keyframe);
            }
        }
        if !shown.is_empty() {
            events.push(self.surface(shown, store)?);
        }
        Ok(events)
    }

    /// The keyframe of a view, unless hardly anything of it has depth.
    fn shown_keyframe(&self, view: &AlignedView) -> Option<ShownKeyframe> {
        let is_seen = view.depth().valid_ratio() >= LEAST_SHOWN;
        let median = median_depth(view, self.config.fusion.max_depth_m as f32).filter(|_| is_seen)?;
        Some(ShownKeyframe { frame_id: view.frame_id(), median_depth_m: f64::from(median) })
    }

    fn surface(&mut self, shown: Vec<ShownKeyframe>, store: &dyn PredictionStore) -> Result<MapEvent, Error> {
        let merged = self.volumes.merged_with(|chunk| store.read_volume(chunk))?;
        let surface = Surface { mesh: merged.extract_mesh(), ..Surface::default() };
        Ok(MapEvent::SurfaceChanged { surface: Arc::new(surface), shown, is_final: false })
    }

    /// Moves every chunk with its keyframes.
    fn follow(&mut self, placement: &Placement) -> Result<(), Error> {
        let mut moved = BTreeMap::<ChunkId, Vec<RevisedView>>::new();
        for (frame, scale) in &self.fused {
            let (Some(chunk), Some(now)) = (self.volumes.owner(*frame), placement.view(*frame)) else {
                continue;
            };
            // A frame whose depth comes from another chunk by now still constrains where this one is.
            let depth_factor = if now.owner == chunk { now.metres_per_unit / scale } else { 1.0 };
            let world_from_camera = now.world_from_camera;
            moved.entry(chunk).or_default().push(RevisedView {
                frame_id: *frame,
                world_from_camera,
                depth_factor,
            });
        }
        for (chunk, views) in moved {
            self.volumes.revise(chunk, &views)?;
        }
        Ok(())
    }
}

/// Adds a view, unless it cannot be fused. The final map reports its own losses; this surface is provisional.
fn integrate(
    volumes: &mut SubVolumes,
    chunk: ChunkId,
    view: &AlignedView,
    events: &mut Vec<MapEvent>,
) -> bool {
    let result = volumes.integrate(chunk, view);
    if let Err(error) = &result {
        events.push(MapEvent::Warning(Warning::new("growing-surface", error.to_string())));
    }
    result.is_ok()
}
