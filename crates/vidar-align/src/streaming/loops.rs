//! Revisits found by image descriptors, and the frames a loop chunk is made of.

use super::{ChunkRange, Compat};
use std::collections::BTreeMap;
use std::ops::Range;

/// How revisits are chosen.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LoopDetection {
    /// Smallest inner product of two descriptors of a loop (exclusive).
    pub min_similarity: f32,
    /// Nearest descriptors asked for per frame.
    pub top_k: usize,
    /// Frames that must lie between the two ends (exclusive).
    pub min_gap_frames: usize,
    /// Frames around an accepted loop's ends in which no other loop may end; 0 keeps all.
    pub suppress_frames: usize,
    /// With [`Compat::Reference`] temporal neighbours are dropped only after the top k were taken, so that in slow or
    /// fast-sampled video all of them are neighbours and no revisit is ever seen.
    pub compat: Compat,
}

impl Default for LoopDetection {
    fn default() -> Self {
        Self { min_similarity: 0.85, top_k: 5, min_gap_frames: 10, suppress_frames: 25, compat: Compat::Off }
    }
}

/// Two frames that look alike.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FramePair {
    /// The later frame.
    pub later: usize,
    /// The earlier frame.
    pub earlier: usize,
    /// Inner product of their descriptors.
    pub similarity: f32,
}

/// Finds revisits among unit-length descriptors of `dimension` numbers each, most similar first. Exact search.
pub fn detect_loops(descriptors: &[f32], dimension: usize, config: &LoopDetection) -> Vec<FramePair> {
    let rows: Vec<&[f32]> = descriptors.chunks_exact(dimension.max(1)).collect();
    let mut found: BTreeMap<(usize, usize), f32> = BTreeMap::new();
    let mut near: Vec<(f32, usize)> = Vec::with_capacity(rows.len());
    for (i, row) in rows.iter().enumerate() {
        near.clear();
        let reference = config.compat.is_reference();
        let candidates =
            rows.iter().enumerate().filter(|&(j, _)| reference || i.abs_diff(j) > config.min_gap_frames);
        near.extend(candidates.map(|(j, other)| (inner(row, other), j)));
        near.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        // The reference asks for one more and throws the first away, trusting it to be the frame itself.
        let skip = usize::from(reference);
        for &(similarity, j) in near.iter().skip(skip).take(config.top_k) {
            if similarity > config.min_similarity && i.abs_diff(j) > config.min_gap_frames {
                found.insert((i.min(j), i.max(j)), similarity);
            }
        }
    }
    let mut pairs: Vec<FramePair> = found
        .into_iter()
        .map(|((earlier, later), similarity)| FramePair { later, earlier, similarity })
        .collect();
    pairs.sort_by(|a, b| b.similarity.total_cmp(&a.similarity));
    if config.suppress_frames > 0 { suppress(&pairs, config.suppress_frames) } else { pairs }
}

/// Keeps a pair unless one of its ends lies near an end of a better one.
fn suppress(pairs: &[FramePair], radius: usize) -> Vec<FramePair> {
    let last = pairs.iter().map(|p| p.later).max().unwrap_or(0);
    let mut taken = vec![false; last + 1];
    let mut kept = Vec::new();
    for pair in pairs {
        let FramePair { later, earlier, .. } = *pair;
        if taken[earlier] || taken[later] {
            continue;
        }
        kept.push(*pair);
        let around_earlier = earlier.saturating_sub(radius)..(earlier + radius + 1).min(later);
        let around_later =
            (earlier + 1).max(later.saturating_sub(radius))..(later + radius + 1).min(last + 1);
        around_earlier.chain(around_later).for_each(|frame| taken[frame] = true);
    }
    kept
}

/// Summed in four lanes, so that the compiler may use vector registers; always in the same order.
fn inner(a: &[f32], b: &[f32]) -> f32 {
    let mut lanes = [0.0f32; 8];
    let (a_chunks, b_chunks) = (a.chunks_exact(8), b.chunks_exact(8));
    let rest: f32 = a_chunks.remainder().iter().zip(b_chunks.remainder()).map(|(x, y)| x * y).sum();
    for (x, y) in a_chunks.zip(b_chunks) {
        for lane in 0..8 {
            lanes[lane] += x[lane] * y[lane];
        }
    }
    lanes.iter().sum::<f32>() + rest
}

/// A loop chunk: frames around both ends, and the chunks they lie in.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LoopWindow {
    /// The later chunk.
    pub a: usize,
    /// Its frames.
    pub frames_a: Range<usize>,
    /// The earlier chunk.
    pub b: usize,
    /// Its frames.
    pub frames_b: Range<usize>,
}

/// One loop chunk per pair of chunks, from the most similar pair of frames, with `half_window` frames on each side where
/// the chunk allows.
///
/// With [`Compat::Reference`] neighbouring chunks count too, although their overlap ties them already.
pub fn loop_windows(
    pairs: &[FramePair],
    chunks: &[ChunkRange],
    half_window: usize,
    compat: Compat,
) -> Vec<LoopWindow> {
    let chunk_of = |frame: usize| chunks.iter().rposition(|c| c.frames.start <= frame);
    let window = |frame: usize, chunk: &Range<usize>| {
        let full = 2 * half_window;
        if frame < chunk.start + half_window {
            chunk.start..chunk.end.min(chunk.start + full)
        } else if frame + half_window > chunk.end {
            chunk.start.max(chunk.end.saturating_sub(full))..chunk.end
        } else {
            frame - half_window..frame + half_window
        }
    };
    let mut windows: Vec<LoopWindow> = Vec::new();
    for pair in pairs {
        let (Some(a), Some(b)) = (chunk_of(pair.later), chunk_of(pair.earlier)) else { continue };
        let apart = if compat.is_reference() { 1 } else { 2 };
        if a.abs_diff(b) < apart || windows.iter().any(|w| (w.a, w.b) == (a, b)) {
            continue;
        }
        let frames_a = window(pair.later, &chunks[a].frames);
        let frames_b = window(pair.earlier, &chunks[b].frames);
        windows.push(LoopWindow { a, frames_a, b, frames_b });
    }
    windows
}
