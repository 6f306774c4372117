//! Two chunks that may show one place.

use vidar_core::{ChunkId, FrameId};

/// Two chunks whose keyframes have similar descriptors.
#[derive(Clone, Debug, PartialEq)]
pub struct LoopCandidate {
    /// The later chunk.
    pub later: ChunkId,
    /// Its frame of the most similar pair.
    pub later_frame: FrameId,
    /// Frames of the later chunk around it: one half of a loop chunk.
    pub later_window: Vec<FrameId>,
    /// The earlier chunk.
    pub earlier: ChunkId,
    /// Its frame of the most similar pair.
    pub earlier_frame: FrameId,
    /// Frames of the earlier chunk around it: the other half.
    pub earlier_window: Vec<FrameId>,
    /// Inner product of the two descriptors.
    pub similarity: f32,
}
