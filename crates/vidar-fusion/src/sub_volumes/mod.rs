//! Sub-volumes: one volume per chunk, moved when the pose graph moves its chunk (Voxgraph: Reijgwart et al., RA-L 2020).
//!
//! Views are fused at the poses that the graph estimates at that time. When a loop closes, the graph moves the keyframes
//! of earlier chunks; their sub-volumes are then moved by the similarity that best fits the motion of their surfaces. A
//! chunk that moved by more than a voxel is [stale](Revision::stale): it is resampled at its present pose until its
//! views are fused again ([`SubVolumes::rebuild`]), which is exact also when the motion is not a similarity. Chunks that
//! moved less are unchanged, to the bit.
//!
//! A finished chunk can be [offloaded](SubVolumes::offload) as bytes, for instance to a file, and can still be moved, so
//! memory does not grow with the length of the sequence.
//!
//! [`SubVolumes::merged`] adds all sub-volumes to one. Sums are integers, so as long as nothing moved the result is
//! the volume that fusing all views at once would have made, to the bit, and with any motion it does not depend on
//! the order in which chunks came or on the number of threads. The sum is kept: what has not moved since stays in it.

mod motion;
mod resample;
mod snapshot;
mod sum;

use crate::{FusionConfig, FusionError, IntegrationStats, TsdfVolume};
use motion::SurfaceProbe;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use sum::Sum;
use vidar_core::{AlignedView, ChunkId, FrameId, LieGroup, Se3, Sim3, TriangleMesh, Warning};

/// Settings of sub-volumes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SubVolumeConfig {
    /// Settings of each sub-volume and of the merged one. `memory_budget_bytes` is for all sub-volumes together; the
    /// merged volume may hold as much again while it exists.
    pub fusion: FusionConfig,
    /// Motion of a chunk's surface, voxels, 0.01 to 100, from which on the chunk is moved and due for fusing again.
    pub move_tolerance_voxels: f64,
}

impl Default for SubVolumeConfig {
    fn default() -> Self {
        Self { fusion: FusionConfig::default(), move_tolerance_voxels: 1.0 }
    }
}

impl SubVolumeConfig {
    /// Checks every field against the range in its description.
    pub fn validate(&self) -> Result<(), FusionError> {
        self.fusion.validate()?;
        let found = self.move_tolerance_voxels;
        if !(0.01..=100.0).contains(&found) {
            return Err(FusionError::BadConfig {
                field: "move_tolerance_voxels",
                min: 0.01,
                max: 100.0,
                found,
            });
        }
        Ok(())
    }
}

/// A keyframe's present pose in the graph.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RevisedView {
    /// Which keyframe.
    pub frame_id: FrameId,
    /// Its pose now.
    pub world_from_camera: Se3,
    /// Its present depth over its depth when fused (e^dσ of its chunk).
    pub depth_factor: f64,
}

/// Effect of a graph update on a chunk.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Revision {
    /// Largest motion of a point of its surface since it was fused, m.
    pub moved_m: f64,
    /// Largest residual of a point of its surface after the fitted similarity, m: the non-rigid sub_volume of the motion.
    pub bent_m: f64,
    /// Whether it moved by more than the tolerance and its views should be fused again.
    pub stale: bool,
}

/// State of all sub-volumes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SubVolumeReport {
    /// Chunks with views.
    pub chunks: u64,
    /// Views fused.
    pub views: u64,
    /// Stale chunks.
    pub stale: u64,
    /// Chunks that were fused again so far.
    pub rebuilt: u64,
    /// Bytes held now.
    pub memory_bytes: u64,
    /// Most bytes held at once.
    pub peak_memory_bytes: u64,
    /// Times that a block was rejected for lack of memory.
    pub dropped_by_budget: u64,
}

/// A volume per chunk.
#[derive(Clone, Debug)]
pub struct SubVolumes {
    config: SubVolumeConfig,
    chunks: BTreeMap<ChunkId, SubVolume>,
    owners: BTreeMap<FrameId, ChunkId>,
    /// Of the last surface.
    sum: Option<Sum>,
    rebuilt: u64,
    peak_bytes: u64,
    dropped: u64,
}

#[derive(Clone, Debug)]
struct SubVolume {
    volume: TsdfVolume,
    /// Motion of the chunk since it was fused.
    now_from_fused: Sim3,
    /// Points of its surface from which its motion is estimated.
    probes: BTreeMap<FrameId, SurfaceProbe>,
    revision: Revision,
    /// Whether `volume` is empty because its bytes were offloaded.
    is_offloaded: bool,
}

impl SubVolumes {
    /// Without chunks; fails for a configuration that is out of range.
    pub fn new(config: &SubVolumeConfig) -> Result<Self, FusionError> {
        config.validate()?;
        Ok(Self {
            config: config.clone(),
            chunks: BTreeMap::new(),
            owners: BTreeMap::new(),
            sum: None,
            rebuilt: 0,
            peak_bytes: 0,
            dropped: 0,
        })
    }

    /// The settings.
    pub fn config(&self) -> &SubVolumeConfig {
        &self.config
    }

    /// Chunks with views, in the order of their numbers.
    pub fn chunks(&self) -> impl Iterator<Item = ChunkId> + '_ {
        self.chunks.keys().copied()
    }

    /// Which chunk fused a keyframe.
    pub fn owner(&self, frame: FrameId) -> Option<ChunkId> {
        self.owners.get(&frame).copied()
    }

    /// Fuses a keyframe into its chunk. Each keyframe is fused once, by the chunk that owns it.
    ///
    /// Views of a chunk that was moved are transformed to the frame in which it was fused.
    ///
    /// # Errors
    /// A keyframe that was fused already, and the errors of [`TsdfVolume::integrate`]; nothing changes then.
    pub fn integrate(&mut self, chunk: ChunkId, view: &AlignedView) -> Result<IntegrationStats, FusionError> {
        let frame = view.frame_id();
        if let Some(owner) = self.owner(frame) {
            return Err(FusionError::FusedAlready { frame, owner, chunk });
        }
        let others = self.memory_bytes() - self.chunks.get(&chunk).map_or(0, |c| c.volume.memory_bytes());
        let budget = self.config.fusion.memory_budget_bytes.saturating_sub(others);
        let mut fresh = None;
        let sub_volume = match self.chunks.get_mut(&chunk) {
            Some(sub_volume) => sub_volume,
            None => fresh.insert(SubVolume::new(&self.config.fusion)?),
        };
        if sub_volume.is_offloaded {
            return Err(FusionError::Offloaded { chunk });
        }
        take_out(&mut self.sum, chunk, sub_volume);
        sub_volume.volume.set_budget(budget);
        let stats = sub_volume.integrate(view)?;
        if let Some(fresh) = fresh {
            self.chunks.insert(chunk, fresh);
        }
        self.owners.insert(frame, chunk);
        self.dropped += stats.dropped_by_budget;
        self.peak_bytes = self.peak_bytes.max(self.memory_bytes());
        Ok(stats)
    }

    /// Moves a chunk to the present poses of its keyframes; keyframes that are not named move with the others.
    ///
    /// # Errors
    /// A chunk without views, a keyframe that is not the chunk's, a pose that is not finite; nothing changes then.
    pub fn revise(&mut self, chunk: ChunkId, revised: &[RevisedView]) -> Result<Revision, FusionError> {
        let sub_volume = self.chunks.get_mut(&chunk).ok_or(FusionError::NoSuchChunk { chunk })?;
        let mut pairs = Vec::with_capacity(revised.len());
        for view in revised {
            let frame = view.frame_id;
            let probe = sub_volume.probes.get(&frame).ok_or(FusionError::NotOfChunk { frame, chunk })?;
            let factor = view.depth_factor;
            if !(view.world_from_camera.is_finite() && factor.is_finite() && factor > 0.0) {
                return Err(FusionError::BadMove { frame, chunk });
            }
            pairs.push((probe, view));
        }
        let voxel_m = self.config.fusion.voxel_size_m;
        let tolerance_m = self.config.move_tolerance_voxels * voxel_m;
        let (now_from_fused, revision) = motion::fit(&pairs, &sub_volume.now_from_fused, tolerance_m);
        sub_volume.now_from_fused = now_from_fused;
        sub_volume.revision = revision;
        Ok(revision)
    }

    /// The stale chunks, largest motion first.
    pub fn stale(&self) -> Vec<(ChunkId, Revision)> {
        let mut stale: Vec<_> = self
            .chunks
            .iter()
            .map(|(id, sub_volume)| (*id, sub_volume.revision))
            .filter(|(_, r)| r.stale)
            .collect();
        stale.sort_by(|a, b| b.1.moved_m.total_cmp(&a.1.moved_m).then(a.0.cmp(&b.0)));
        stale
    }

    /// Fuses a chunk again from its views at their present poses, and replaces its volume.
    ///
    /// # Errors
    /// A chunk without views, a keyframe that another chunk owns, and the errors of [`TsdfVolume::integrate`]; the
    /// chunk is then as it was.
    pub fn rebuild(
        &mut self,
        chunk: ChunkId,
        views: impl IntoIterator<Item = AlignedView>,
    ) -> Result<IntegrationStats, FusionError> {
        let old = self.chunks.get(&chunk).ok_or(FusionError::NoSuchChunk { chunk })?;
        let others = self.memory_bytes() - old.volume.memory_bytes();
        let mut sub_volume = SubVolume::new(&self.config.fusion)?;
        sub_volume.volume.set_budget(self.config.fusion.memory_budget_bytes.saturating_sub(others));
        let mut total = IntegrationStats::default();
        for view in views {
            let frame = view.frame_id();
            if let Some(owner) = self
                .owner(frame)
                .filter(|owner| *owner != chunk)
                .or(sub_volume.probes.contains_key(&frame).then_some(chunk))
            {
                return Err(FusionError::FusedAlready { frame, owner, chunk });
            }
            let stats = sub_volume.integrate(&view)?;
            total.pixels_used += stats.pixels_used;
            total.blocks_touched += stats.blocks_touched;
            total.blocks_total = stats.blocks_total;
            total.dropped_by_budget += stats.dropped_by_budget;
            total.blocks_carved += stats.blocks_carved;
        }
        // Both exist for a moment.
        self.peak_bytes = self.peak_bytes.max(self.memory_bytes() + sub_volume.volume.memory_bytes());
        self.dropped += total.dropped_by_budget;
        self.owners.retain(|_, owner| *owner != chunk);
        self.owners.extend(sub_volume.probes.keys().map(|frame| (*frame, chunk)));
        if let Some(old) = self.chunks.insert(chunk, sub_volume) {
            take_out(&mut self.sum, chunk, &old);
        }
        self.rebuilt += 1;
        Ok(total)
    }

    /// Removes a chunk's volume from memory and returns its bytes, which [`Self::merged_with`] reads. The chunk can still
    /// be revised, and [`Self::rebuild`] does not need the bytes.
    ///
    /// # Errors
    /// A chunk without views, or one that is offloaded already.
    pub fn offload(&mut self, chunk: ChunkId) -> Result<Vec<u8>, FusionError> {
        let empty = TsdfVolume::new(&self.config.fusion)?;
        let sub_volume = self.chunks.get_mut(&chunk).ok_or(FusionError::NoSuchChunk { chunk })?;
        if sub_volume.is_offloaded {
            return Err(FusionError::Offloaded { chunk });
        }
        let bytes = snapshot::write(&sub_volume.volume);
        sub_volume.volume = empty;
        sub_volume.is_offloaded = true;
        Ok(bytes)
    }

    /// The offloaded chunks.
    pub fn offloaded(&self) -> impl Iterator<Item = ChunkId> + '_ {
        self.chunks.iter().filter(|(_, sub_volume)| sub_volume.is_offloaded).map(|(id, _)| *id)
    }

    /// All sub-volumes at their present poses, as one volume. It is kept, and costs what is new or moved since it was last asked for.
    ///
    /// Chunks that did not move are added sum by sum, the others are resampled (trilinear, in space and in all sums).
    ///
    /// # Errors
    /// More than 65535 views, or an offloaded chunk: see [`Self::merged_with`].
    pub fn merged(&mut self) -> Result<&TsdfVolume, FusionError> {
        self.merged_with(|chunk| Err(FusionError::Offloaded { chunk }))
    }

    /// As [`Self::merged`]; `load` returns the bytes of each offloaded chunk that is added or moved, one at a time.
    ///
    /// # Errors
    /// More than 65535 views, whatever `load` returns, or bytes that are not a volume.
    pub fn merged_with<E: From<FusionError>>(
        &mut self,
        mut load: impl FnMut(ChunkId) -> Result<Vec<u8>, E>,
    ) -> Result<&TsdfVolume, E> {
        // What the budget rejected cannot be taken out again. Where an error ends this, the sum is made anew next time.
        let kept = self.sum.take().filter(|sum| !sum.volume().is_incomplete());
        let mut sum = kept.map_or_else(|| Sum::new(&self.config.fusion), Ok)?;
        for (chunk, sub_volume) in &self.chunks {
            let before = sum.place(*chunk);
            if before == Some(&sub_volume.now_from_fused) {
                continue;
            }
            let loaded;
            let volume = if sub_volume.is_offloaded {
                loaded = snapshot::read(&load(*chunk)?, &self.config.fusion)?;
                &loaded
            } else {
                &sub_volume.volume
            };
            let limit = crate::grid::MAX_VIEWS;
            if before.is_none() && sum.volume().views() + volume.views() > limit {
                let frame = sub_volume.probes.keys().next().copied().unwrap_or_default();
                return Err(FusionError::TooManyViews { frame, limit }.into());
            }
            sum.set(*chunk, volume, &sub_volume.now_from_fused);
        }
        Ok(self.sum.insert(sum).volume())
    }

    /// The surface of [`Self::merged`].
    ///
    /// # Errors
    /// As [`Self::merged`].
    pub fn extract_mesh(&mut self) -> Result<TriangleMesh, FusionError> {
        Ok(self.merged()?.extract_mesh())
    }

    /// Bytes held now by all sub-volumes; never above the budget.
    pub fn memory_bytes(&self) -> u64 {
        self.chunks.values().map(|sub_volume| sub_volume.volume.memory_bytes()).sum()
    }

    /// Counts and memory.
    pub fn report(&self) -> SubVolumeReport {
        SubVolumeReport {
            chunks: self.chunks.len() as u64,
            views: self.owners.len() as u64,
            stale: self.chunks.values().filter(|sub_volume| sub_volume.revision.stale).count() as u64,
            rebuilt: self.rebuilt,
            memory_bytes: self.memory_bytes(),
            peak_memory_bytes: self.peak_bytes,
            dropped_by_budget: self.dropped,
        }
    }

    /// Degradations so far, as [`TsdfVolume::warnings`] of each chunk, each kind once.
    pub fn warnings(&self) -> Vec<Warning> {
        let mut warnings: Vec<Warning> = Vec::new();
        for warning in self.chunks.values().flat_map(|sub_volume| sub_volume.volume.warnings()) {
            if !warnings.iter().any(|w| w.kind == warning.kind) {
                warnings.push(warning);
            }
        }
        warnings
    }
}

/// Takes a chunk out of the sum before its volume changes; where the volume is elsewhere, the sum is made anew.
fn take_out(sum: &mut Option<Sum>, chunk: ChunkId, sub_volume: &SubVolume) {
    match (sub_volume.is_offloaded, &mut *sum) {
        (false, Some(sum)) if !sum.volume().is_incomplete() => sum.remove(chunk, &sub_volume.volume),
        _ => *sum = sum.take().filter(|sum| sum.place(chunk).is_none()),
    }
}

impl SubVolume {
    fn new(config: &FusionConfig) -> Result<Self, FusionError> {
        let volume = TsdfVolume::new(config)?;
        let revision = Revision::default();
        let probes = BTreeMap::new();
        Ok(Self { volume, now_from_fused: Sim3::IDENTITY, probes, revision, is_offloaded: false })
    }

    fn integrate(&mut self, view: &AlignedView) -> Result<IntegrationStats, FusionError> {
        if self.now_from_fused == Sim3::IDENTITY {
            let stats = self.volume.integrate(view)?;
            self.probes.insert(view.frame_id(), SurfaceProbe::new(view, self.volume.config()));
            return Ok(stats);
        }
        let there = motion::moved(view, &self.now_from_fused.inverse())?;
        let stats = self.volume.integrate(&there)?;
        self.probes.insert(view.frame_id(), SurfaceProbe::new(&there, self.volume.config()));
        Ok(stats)
    }
}
