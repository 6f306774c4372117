//! Everything that was observed so far: what couplings estimate from.

use super::chunk::Chunk;
use super::config::AlignerConfig;
use super::frames::Frames;
use super::pose_fit::{CameraPair, PoseFit, fit_about_rotations};
use super::report::{LoopRejection, LoopReport};
use nalgebra::SMatrix;
use vidar_core::Sim3;

/// Chunks fewer than this apart are neighbours: a frame that both hold is an overlap, not a revisit.
pub(super) const NEIGHBOURS: usize = 3;

/// A loop with what the graph needs of it.
#[derive(Clone, Debug)]
pub(super) struct LoopMeasurement {
    /// Index of the later chunk.
    pub later: usize,
    /// Index of the earlier chunk.
    pub earlier: usize,
    pub earlier_from_later: Sim3,
    /// Of δ in `earlier_from_later · exp(δ)`, units of the later chunk.
    pub covariance: SMatrix<f64, 7, 7>,
    pub report: LoopReport,
}

/// Frames, chunks and loops of a run.
#[derive(Debug)]
pub(super) struct History {
    pub config: AlignerConfig,
    pub frames: Frames,
    pub chunks: Vec<Chunk>,
    pub loops: Vec<LoopMeasurement>,
}

impl History {
    pub fn new(config: AlignerConfig) -> Self {
        Self { config, frames: Frames::default(), chunks: Vec::new(), loops: Vec::new() }
    }

    /// The last chunk that is usable.
    pub fn last_usable(&self) -> Option<&Chunk> {
        self.chunks.iter().rev().find(|c| c.is_usable())
    }

    /// Where the overlap puts a new chunk, from the initial place of the chunk before.
    pub fn initial_by_overlap(&self, chunk: &Chunk) -> Option<Sim3> {
        let overlap = chunk.overlap.as_ref()?;
        self.chunks[overlap.earlier].initial.map(|g| g * overlap.fit.target_from_source)
    }

    /// The chunk onto its pose priors alone; `scale` (m per unit) is used where the centres determine none.
    pub fn pose_fit(&self, chunk: &Chunk, pairs: &[CameraPair], scale: f64) -> Option<PoseFit> {
        let floor = self.config.graph.attachment_depth_ratio * chunk.median_depth() * scale;
        fit_about_rotations(pairs, scale, floor)
    }

    /// Accepted loops as (later, earlier, `earlier_from_later`), chunks by index, followed by frames that came back.
    pub fn loop_edges(&self, loops: &[LoopMeasurement]) -> Vec<(usize, usize, Sim3)> {
        let revisits = self
            .chunks
            .iter()
            .enumerate()
            .flat_map(|(k, c)| c.revisits.iter().map(move |o| (k, o.earlier, o.fit.target_from_source)));
        loops
            .iter()
            .filter(|l| l.report.rejection.is_none())
            .map(|l| (l.later, l.earlier, l.earlier_from_later))
            .chain(revisits)
            .collect()
    }
}

/// The reports of loops.
pub(super) fn reports(loops: Vec<LoopMeasurement>) -> Vec<LoopReport> {
    loops.into_iter().map(|l| l.report).collect()
}

/// Marks a loop as rejected.
pub(super) fn reject(measurement: &mut LoopMeasurement, reason: LoopRejection) {
    measurement.report.rejection = Some(reason);
}
