//! Chunks chained by their overlaps, closed by loops: the reference's world.

use super::memory::Chunk;
use crate::streaming::{LoopConstraint, PoseGraphConfig, optimise_chain};
use vidar_core::{LieGroup, Sim3};

/// Where a chunk stands in its chain.
#[derive(Clone, Copy, Debug)]
pub(super) struct Link {
    /// The chain, by the index of its first chunk: chunks of different chains share nothing.
    pub root: usize,
    /// Maps the chunk to its chain's first one.
    pub root_from_chunk: Sim3,
}

/// Chains usable chunks. `loops` are (later, earlier, `earlier_from_later`) of accepted loops.
pub(super) fn chain(chunks: &[Chunk], loops: &[(usize, usize, Sim3)]) -> Vec<Option<Link>> {
    let mut links: Vec<Option<Link>> = Vec::with_capacity(chunks.len());
    for (index, chunk) in chunks.iter().enumerate() {
        let before = chunk.tie.as_ref().and_then(|t| links[t.to].map(|l| (l, t)));
        links.push(chunk.is_usable().then(|| match before {
            Some((link, tie)) => {
                Link { root: link.root, root_from_chunk: link.root_from_chunk * tie.fit.target_from_source }
            }
            None => Link { root: index, root_from_chunk: Sim3::IDENTITY },
        }));
    }
    let mut roots: Vec<usize> = links.iter().flatten().map(|l| l.root).collect();
    roots.dedup();
    for root in roots {
        close(&mut links, root, loops);
    }
    links
}

/// Spreads the loops of one chain over its links; a chain whose graph has no answer stays open.
fn close(links: &mut [Option<Link>], root: usize, loops: &[(usize, usize, Sim3)]) {
    let members: Vec<usize> =
        (0..links.len()).filter(|&i| links[i].is_some_and(|l| l.root == root)).collect();
    let place = |chunk: usize| members.binary_search(&chunk).ok();
    let constraints: Vec<LoopConstraint> = loops
        .iter()
        .filter_map(|(later, earlier, b_from_a)| {
            Some(LoopConstraint { a: place(*later)?, b: place(*earlier)?, b_from_a: *b_from_a })
        })
        .collect();
    if constraints.is_empty() {
        return;
    }
    let gauges: Vec<Sim3> = members.iter().filter_map(|&m| links[m].map(|l| l.root_from_chunk)).collect();
    let steps: Vec<Sim3> = gauges.windows(2).map(|g| g[0].inverse() * g[1]).collect();
    let Ok(closed) = optimise_chain(&steps, &constraints, &PoseGraphConfig::default()) else { return };
    let mut sum = Sim3::IDENTITY;
    for (member, step) in members.iter().skip(1).zip(&closed.previous_from_next) {
        sum = sum * *step;
        links[*member] = Some(Link { root, root_from_chunk: sum });
    }
}
