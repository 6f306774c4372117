//! Loop candidates from place recognition descriptors.

use super::candidate::LoopCandidate;
use crate::aligner::chunk::{Chunk, View};
use crate::aligner::config::LoopsConfig;
use crate::aligner::history::History;
use crate::aligner::observation::FrameObservation;
use crate::place_recognition::PlaceIndex;
use std::collections::{BTreeMap, BTreeSet};
use vidar_core::FrameId;

/// The most similar pair of frames of a pair of chunks so far.
#[derive(Clone, Copy, Debug)]
struct FrameMatch {
    later_frame: FrameId,
    earlier_frame: FrameId,
    similarity: f32,
    is_evaluated: bool,
}

/// Descriptors of all keyframes, and the pairs of chunks that they suggest.
#[derive(Debug, Default)]
pub(in crate::aligner) struct LoopSearch {
    index: PlaceIndex,
    indexed: BTreeSet<FrameId>,
    /// By (later, earlier) chunk.
    matches: BTreeMap<(usize, usize), FrameMatch>,
}

impl LoopSearch {
    /// A search that compares descriptors after whitening ([`PlaceIndex::whitened`]).
    pub fn whitened() -> Self {
        Self { index: PlaceIndex::whitened(), ..Self::default() }
    }

    pub fn memory_bytes(&self) -> usize {
        self.index.memory_bytes()
    }

    /// Searches the index for the descriptors of the newest chunk, then adds them to it. `min_travel_m` is the path along
    /// pose priors that must lie between the two ends; 0 where there are none.
    pub fn update(&mut self, history: &History, frames: &[FrameObservation], min_travel_m: f64) {
        let Some(newest) = history.chunks.len().checked_sub(1) else { return };
        let config = &history.config.loops;
        for frame in frames {
            let Some(descriptor) = &frame.descriptor else { continue };
            if history.chunks[newest].view(frame.frame_id).is_none() {
                continue;
            }
            let travel = history.frames.travel_m(frame.frame_id);
            let min_travel_m = if travel.is_some() { min_travel_m } else { 0.0 };
            let travel = travel.unwrap_or(0.0);
            let found = self.index.search(
                frame.time,
                travel,
                descriptor,
                config.top_k,
                config.min_gap_s,
                min_travel_m,
            );
            let min_similarity = self.min_similarity(config);
            for place in found.into_iter().filter(|m| m.similarity > min_similarity) {
                let found = FrameMatch {
                    later_frame: frame.frame_id,
                    earlier_frame: place.frame_id,
                    similarity: place.similarity,
                    is_evaluated: false,
                };
                self.keep_best(&history.chunks, newest, found);
            }
            if self.indexed.insert(frame.frame_id) {
                self.index.add(frame.frame_id, frame.time, travel, descriptor);
            }
        }
    }

    fn min_similarity(&self, config: &LoopsConfig) -> f32 {
        if self.index.is_whitened() { config.min_token_similarity } else { config.min_similarity }
    }

    fn keep_best(&mut self, chunks: &[Chunk], newest: usize, found: FrameMatch) {
        let holds = |c: &Chunk| c.is_usable() && c.view(found.earlier_frame).is_some();
        let Some(earlier) = chunks[..newest].iter().rposition(holds) else { return };
        if !chunks[newest].is_usable() || newest - earlier <= 1 {
            return;
        }
        let best = self.matches.entry((newest, earlier)).or_insert(found);
        if !best.is_evaluated && found.similarity > best.similarity {
            *best = found;
        }
    }

    /// Pairs of chunks that were not measured yet, most similar first: the best pair of frames each, at most
    /// [`LoopsConfig::max_per_chunk`] per later chunk, measured ones counted.
    pub fn candidates(&self, history: &History) -> Vec<LoopCandidate> {
        let mut waiting: Vec<(&(usize, usize), &FrameMatch)> =
            self.matches.iter().filter(|(_, m)| !m.is_evaluated).collect();
        waiting.sort_by(|a, b| b.1.similarity.total_cmp(&a.1.similarity).then(a.0.cmp(b.0)));
        let evaluated =
            |chunk: usize| self.matches.iter().filter(|(k, m)| k.0 == chunk && m.is_evaluated).count();
        let mut taken = vec![0usize; history.chunks.len()];
        let mut candidates = Vec::new();
        let config = &history.config.loops;
        for (&(later, earlier), found) in waiting {
            if taken[later] + evaluated(later) >= config.max_per_chunk {
                continue;
            }
            taken[later] += 1;
            let (a, b) = (&history.chunks[later], &history.chunks[earlier]);
            candidates.push(LoopCandidate {
                later: a.id,
                later_frame: found.later_frame,
                later_window: window(a, found.later_frame, config.window),
                earlier: b.id,
                earlier_frame: found.earlier_frame,
                earlier_window: window(b, found.earlier_frame, config.window),
                similarity: found.similarity,
            });
        }
        candidates
    }

    /// Marks a pair of chunks as measured.
    pub fn mark_evaluated(&mut self, later: usize, earlier: usize) {
        if let Some(found) = self.matches.get_mut(&(later, earlier)) {
            found.is_evaluated = true;
        }
    }
}

/// Frames of a chunk around one of them, shifted inwards at the chunk's ends.
fn window(chunk: &Chunk, frame: FrameId, half: usize) -> Vec<FrameId> {
    let n = chunk.views.len();
    let at = chunk.views.iter().position(|v: &View| v.frame_id == frame).unwrap_or(0);
    let start = at.saturating_sub(half).min(n.saturating_sub(2 * half));
    chunk.views[start..n.min(start + 2 * half)].iter().map(|v| v.frame_id).collect()
}
