//! Which keyframes form a chunk, decided as soon as later keyframes can no longer change it.

use crate::error::Error;
use vidar_align::chunking::{ChunkSpan, chunks_with_context, divide_overlaps, overlapping_chunks};
use vidar_core::FrameId;

/// How keyframes are cut into chunks.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ChunkRule {
    /// Chunks of `size` keyframes that share `overlap` with the chunk before (DA3-Streaming).
    Overlapping {
        /// Keyframes of a chunk.
        size: usize,
        /// Keyframes shared with the chunk before; smaller than `size`.
        overlap: usize,
    },
    /// Chunks of `size` keyframes without overlap, with up to `context` keyframes seen on each side.
    WithContext {
        /// Keyframes whose depth is computed.
        size: usize,
        /// Keyframes seen on each side.
        context: usize,
    },
    /// The chunks of a recording.
    Prescribed(Vec<Vec<FrameId>>),
}

impl ChunkRule {
    /// Most keyframes that a chunk shows to the model.
    pub fn largest(&self) -> usize {
        match self {
            Self::Overlapping { size, .. } => *size,
            Self::WithContext { size, context } => size + 2 * context,
            Self::Prescribed(chunks) => chunks.iter().map(Vec::len).max().unwrap_or(0),
        }
    }

    /// All chunks of the keyframes `frames`.
    ///
    /// # Errors
    /// An overlap as long as the chunk; prescribed chunks that are not spans of the frames.
    pub fn chunks(&self, frames: &[FrameId]) -> Result<Vec<ChunkSpan>, Error> {
        let n = frames.len();
        match self {
            Self::Overlapping { size, overlap } => Ok(overlapping_chunks(n, *size, *overlap)?),
            Self::WithContext { size, context } => Ok(chunks_with_context(n, *size, *context)),
            Self::Prescribed(chunks) => {
                let span = |chunk: &Vec<FrameId>| {
                    let start = frames.iter().position(|f| Some(f) == chunk.first())?;
                    let span = start..start + chunk.len();
                    (frames.get(span.clone())? == chunk.as_slice()).then_some(span)
                };
                let spans: Option<Vec<_>> = chunks.iter().map(span).collect();
                spans.map(divide_overlaps).ok_or_else(|| Error::BadValue {
                    reason: "the recorded chunks are not spans of consecutive frames".into(),
                })
            }
        }
    }

    /// The chunks from number `first` on that keyframes after `frames` can no longer change.
    ///
    /// # Errors
    /// As [`ChunkRule::chunks`].
    pub fn decided(&self, first: usize, frames: &[FrameId]) -> Result<Vec<ChunkSpan>, Error> {
        let n = frames.len();
        match self {
            Self::Overlapping { size, .. } => {
                // One more keyframe decides what the chunk and its successor own of their overlap.
                let is_decided = |c: &ChunkSpan| c.seen.len() == *size && n > c.seen.end;
                Ok(self.chunks(frames)?.into_iter().skip(first).take_while(is_decided).collect())
            }
            Self::WithContext { size, context } => {
                let is_decided = |c: &ChunkSpan| c.core.len() == *size && n >= c.core.end + context;
                Ok(self.chunks(frames)?.into_iter().skip(first).take_while(is_decided).collect())
            }
            Self::Prescribed(chunks) => {
                // A chunk and its successor are there as soon as the successor's last frame is.
                let last = |chunk: &Vec<FrameId>| chunk.last().copied();
                let complete =
                    chunks.iter().take_while(|c| last(c).is_some_and(|l| frames.contains(&l))).count();
                let there = Self::Prescribed(chunks[..complete].to_vec()).chunks(frames)?;
                let decided = complete.saturating_sub(1);
                Ok(there.into_iter().take(decided).skip(first).collect())
            }
        }
    }

    /// Whether a recording prescribes chunks.
    pub fn is_prescribed(&self) -> bool {
        matches!(self, Self::Prescribed(_))
    }

    /// Whether a recording has a prediction of the frame.
    pub fn prescribes(&self, frame: FrameId) -> bool {
        match self {
            Self::Prescribed(chunks) => chunks.iter().any(|c| c.contains(&frame)),
            Self::Overlapping { .. } | Self::WithContext { .. } => false,
        }
    }

    /// Frames that the rule prescribes as keyframes; none where keyframes are selected.
    pub fn prescribed_frames(&self) -> Option<Vec<FrameId>> {
        match self {
            Self::Prescribed(chunks) => Some(prescribed_frames(chunks)),
            Self::Overlapping { .. } | Self::WithContext { .. } => None,
        }
    }
}

/// Frames of the chunks that a recording prescribes, each once, ascending.
fn prescribed_frames(chunks: &[Vec<FrameId>]) -> Vec<FrameId> {
    let mut frames: Vec<FrameId> = chunks.iter().flatten().copied().collect();
    frames.sort_unstable();
    frames.dedup();
    frames
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frames(n: usize) -> Vec<FrameId> {
        (0..n as u32).map(FrameId).collect()
    }

    #[test]
    fn chunks_cut_as_keyframes_come_are_those_of_the_whole_sequence() {
        let prescribed = vec![frames(5), frames(9)[3..].to_vec()];
        for rule in [
            ChunkRule::Overlapping { size: 6, overlap: 2 },
            ChunkRule::WithContext { size: 5, context: 3 },
            ChunkRule::Prescribed(prescribed),
        ] {
            for n in 9..40 {
                let all = frames(n);
                let whole = rule.chunks(&all).unwrap();
                let mut chunks: Vec<ChunkSpan> = Vec::new();
                for end in 1..=n {
                    let decided = rule.decided(chunks.len(), &all[..end]).unwrap();
                    chunks.extend(decided);
                }
                assert_eq!(chunks, whole[..chunks.len()], "{rule:?} {n}");
                assert!(chunks.len() + 2 >= whole.len(), "{rule:?} {n}: {} of {}", chunks.len(), whole.len());
            }
        }
    }

    #[test]
    fn rules_that_cannot_be_followed_are_refused() {
        assert!(ChunkRule::Prescribed(vec![vec![FrameId(0), FrameId(2)]]).chunks(&frames(4)).is_err());
        assert!(ChunkRule::Overlapping { size: 4, overlap: 4 }.chunks(&frames(4)).is_err());
    }
}
