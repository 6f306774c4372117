//! Pose-free: chunks chained by overlaps, closed by loops. Not metric (the paper's PF column), but where landmarks give the
//! chain its unit.

use super::super::chain::{Chains, Link, chain, landmark_scale};
use super::super::chunk::Chunk;
use super::super::estimate::Estimate;
use super::super::history::{History, LoopMeasurement};
use super::super::pose_fit::CameraPair;
use super::{Coupling, initialise_by_overlap};
use vidar_core::Sim3;

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

/// The first chain, in metres where it has landmarks; chunks of other chains share nothing with it and are left out.
pub(super) fn first_chain(history: &History, loops: Vec<LoopMeasurement>) -> Estimate {
    let Chains { links, failures } = chain(&history.chunks, &history.loop_edges(&loops));
    let root = links.iter().flatten().map(|l| l.root).next();
    let unit = root.and_then(|root| landmark_scale(&history.chunks, &links, root));
    let world_from_root = Sim3 { scale: unit.map_or(1.0, |z| z.log_scale.exp()), ..Sim3::IDENTITY };
    let place = |l: Link| world_from_root * l.root_from_chunk;
    let chunks = links.iter().map(|l| l.filter(|l| Some(l.root) == root).map(place)).collect();
    Estimate { failures, ..Estimate::new(history, chunks, loops, false) }
}
