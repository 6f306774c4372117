//! The reference pipeline, DA3-Streaming, stage by stage: chunks that overlap, point maps tied by a robust
//! similarity, loops found by descriptors, a Sim(3) pose graph.
//!
//! ```text
//! chunk_ranges ─▶ (model per chunk) ─▶ unproject ─▶ align_overlap ─▶ accumulate ─▶ world
//!                      └─▶ detect_loops ─▶ loop_windows ─▶ (model per loop) ─▶ loop_constraint ─▶ optimise_chain ┘
//! ```
//!
//! Everything is computed in f64 from f32 depth. What the reference does by accident and what changes results is
//! kept behind [`Compat`], off by default; each such place is documented.

mod chain;
mod chunks;
mod closed_form;
mod depth_scale;
mod irls;
mod loops;
mod overlap;
mod pose_graph;
mod unproject;

pub use chain::{accumulate, loop_constraint};
pub use chunks::{ChunkRange, chunk_ranges};
pub use closed_form::{AlignMethod, weighted_similarity};
pub use depth_scale::{DepthScale, ScaleMethod, depth_scale};
pub use irls::{IrlsConfig, IrlsOutcome, IrlsStep, fit_irls};
pub use loops::{FramePair, LoopDetection, LoopWindow, detect_loops, loop_windows};
pub use overlap::{OverlapFit, PointMap, align_overlap};
pub use pose_graph::{LmStep, LoopConstraint, PoseGraphConfig, PoseGraphOutcome, optimise_chain};
pub use unproject::unproject;

use thiserror::Error;

/// Whether to follow the reference where it errs.
#[derive(
    Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize, schemars::JsonSchema,
)]
#[serde(rename_all = "kebab-case")]
pub enum Compat {
    /// What the reference meant.
    #[default]
    Off,
    /// What the reference does, number for number.
    Reference,
}

impl Compat {
    /// Whether the reference's quirks are wanted.
    pub fn is_reference(self) -> bool {
        self == Self::Reference
    }
}

/// Why a stage has no answer.
#[derive(Clone, Debug, Error, PartialEq)]
#[non_exhaustive]
pub enum StreamingError {
    /// An overlap as long as the chunk never advances.
    #[error(
        "chunks of {chunk_size} frames cannot overlap by {overlap}: the overlap must be smaller than the chunk"
    )]
    BadChunking {
        /// Frames per chunk.
        chunk_size: usize,
        /// Frames shared by neighbours.
        overlap: usize,
    },
    /// Slices that must be of one length are not.
    #[error("{what}: {found} values, expected {expected}")]
    WrongLength {
        /// Which values.
        what: &'static str,
        /// How many there are.
        found: usize,
        /// How many there must be.
        expected: usize,
    },
    /// No pixel of the overlap is confident in both chunks.
    #[error("the overlap has no pixel that is confident in both chunks")]
    NoPairs,
    /// The pairs do not fix a similarity.
    #[error("{pairs} point pairs do not fix a similarity: {reason}")]
    Degenerate {
        /// Pairs with weight.
        pairs: usize,
        /// What is missing.
        reason: &'static str,
    },
    /// A constraint names a chunk that does not exist, or joins a chunk with itself.
    #[error("a loop joins chunks {a} and {b} of {chunks}")]
    BadLoop {
        /// The later chunk.
        a: usize,
        /// The earlier chunk.
        b: usize,
        /// Chunks in the chain.
        chunks: usize,
    },
    /// The graph's equations could not be solved.
    #[error("the pose graph cannot be solved: {reason}")]
    Unsolvable {
        /// What the solver said.
        reason: String,
    },
}
