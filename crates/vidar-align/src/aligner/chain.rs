//! Chunks chained by their overlaps, closed by loops in a Sim(3) pose graph.

use super::chunk::Chunk;
use super::report::GraphFailure;
use crate::landmark_scale::LogScale;
use crate::streaming::{LoopConstraint, PoseGraphConfig, optimise_chain};
use std::f64::consts::FRAC_PI_2;
use vidar_core::{LieGroup, Sim3};
use vidar_solve::statistics::weighted_median;

/// Where a chunk is in its chain.
#[derive(Clone, Copy, Debug)]
pub(super) struct Link {
    /// The chain, by the index of its first chunk: chunks of different chains share nothing.
    pub root: usize,
    /// Maps the chunk to its chain's first one.
    pub root_from_chunk: Sim3,
}

/// All chains.
pub(super) struct Chains {
    /// Per chunk; `None` for chunks that are not usable.
    pub links: Vec<Option<Link>>,
    /// Chains whose graph has no solution: their loops stay open.
    pub failures: Vec<GraphFailure>,
}

/// Chains usable chunks. `loops` are (later, earlier, `earlier_from_later`) of accepted loops.
pub(super) fn chain(chunks: &[Chunk], loops: &[(usize, usize, Sim3)]) -> Chains {
    let mut links: Vec<Option<Link>> = Vec::with_capacity(chunks.len());
    for (index, chunk) in chunks.iter().enumerate() {
        let before = chunk.overlap.as_ref().and_then(|o| links[o.earlier].map(|l| (l, o)));
        links.push(chunk.is_usable().then(|| match before {
            Some((link, overlap)) => Link {
                root: link.root,
                root_from_chunk: link.root_from_chunk * overlap.fit.target_from_source,
            },
            None => Link { root: index, root_from_chunk: Sim3::IDENTITY },
        }));
    }
    let mut roots: Vec<usize> = links.iter().flatten().map(|l| l.root).collect();
    roots.dedup();
    let failures = roots
        .into_iter()
        .filter_map(|root| close(&mut links, root, loops).err().map(|reason| (root, reason)))
        .map(|(root, reason)| GraphFailure { first_chunk: chunks[root].id, reason })
        .collect();
    Chains { links, failures }
}

/// ln(metres per unit) of the chain's first chunk, from the landmarks of all its chunks; `None` without landmarks.
pub(super) fn landmark_scale(chunks: &[Chunk], links: &[Option<Link>], root: usize) -> Option<LogScale> {
    let members = chunks.iter().zip(links).filter_map(|(c, l)| Some((c, l.filter(|l| l.root == root)?)));
    let of_root = |(c, link): (&Chunk, Link)| {
        let z = c.landmark_scale?;
        Some(LogScale { log_scale: z.log_scale - link.root_from_chunk.scale.ln(), ..z })
    };
    let found: Vec<LogScale> = members.filter_map(of_root).collect();
    let weighted: Vec<(f64, f64)> = found.iter().map(|z| (z.log_scale, z.std.powi(-2))).collect();
    let log_scale = weighted_median(weighted)?;
    let sum = |of: fn(&LogScale) -> f64| found.iter().map(of).sum::<f64>();
    Some(LogScale {
        log_scale,
        // The price of a median of normal errors.
        std: (FRAC_PI_2 / sum(|z| z.std.powi(-2))).sqrt(),
        effective: sum(|z| z.effective),
        observations: found.iter().map(|z| z.observations).sum(),
        shared_std: sum(|z| z.shared_std) / found.len() as f64,
    })
}

/// Distributes the loops of one chain over its links. On an error the links stay as they are.
fn close(links: &mut [Option<Link>], root: usize, loops: &[(usize, usize, Sim3)]) -> Result<(), String> {
    let members: Vec<usize> =
        (0..links.len()).filter(|&i| links[i].is_some_and(|l| l.root == root)).collect();
    let index = |chunk: usize| members.binary_search(&chunk).ok();
    let constraints: Vec<LoopConstraint> = loops
        .iter()
        .filter_map(|(later, earlier, b_from_a)| {
            Some(LoopConstraint { a: index(*later)?, b: index(*earlier)?, b_from_a: *b_from_a })
        })
        .collect();
    if constraints.is_empty() {
        return Ok(());
    }
    let gauges: Vec<Sim3> = members.iter().filter_map(|&m| links[m].map(|l| l.root_from_chunk)).collect();
    let steps: Vec<Sim3> = gauges.windows(2).map(|g| g[0].inverse() * g[1]).collect();
    let closed =
        optimise_chain(&steps, &constraints, &PoseGraphConfig::default()).map_err(|e| e.to_string())?;
    let mut root_from_chunk = Sim3::IDENTITY;
    for (member, step) in members.iter().skip(1).zip(&closed.previous_from_next) {
        root_from_chunk = root_from_chunk * *step;
        links[*member] = Some(Link { root, root_from_chunk });
    }
    Ok(())
}
