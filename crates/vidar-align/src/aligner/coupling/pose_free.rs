//! Pose-free: chunks chained by overlaps, closed by loops. Not metric (the paper's PF column).

use super::super::chain::{Chains, chain};
use super::super::chunk::Chunk;
use super::super::estimate::Estimate;
use super::super::history::{History, LoopMeasurement};
use super::super::pose_fit::CameraPair;
use super::{Coupling, initialise_by_overlap};

/// The coupling.
#[derive(Debug)]
pub(in crate::aligner) struct PoseFree;

impl Coupling for PoseFree {
    fn initialise(&self, history: &History, chunk: &mut Chunk, _pairs: &[CameraPair]) {
        initialise_by_overlap(history, chunk);
    }

    fn loop_chi2(&self, _: &History, _: &super::checks::CheckedLoop<'_>) -> Option<f64> {
        None
    }

    fn estimate(&self, history: &History) -> Estimate {
        first_chain(history, self.loops(history))
    }
}

/// The first chain; chunks of other chains share nothing with it and are left out.
pub(super) fn first_chain(history: &History, loops: Vec<LoopMeasurement>) -> Estimate {
    let Chains { links, failures } = chain(&history.chunks, &history.loop_edges(&loops));
    let root = links.iter().flatten().map(|l| l.root).next();
    let chunks =
        links.iter().map(|l| l.filter(|l| Some(l.root) == root).map(|l| l.root_from_chunk)).collect();
    Estimate { failures, ..Estimate::new(history, chunks, loops, false) }
}
