//! The crate's error.

use thiserror::Error;
use vidar_core::{ChunkId, GeometryError};

/// Why the aligner cannot take a configuration, a chunk or a loop.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum AlignError {
    /// A configuration value is not finite and positive.
    #[error("align.{key} must be finite and positive, found {found}")]
    BadConfig {
        /// Which key.
        key: &'static str,
        /// The value.
        found: f64,
    },
    /// A configuration value is outside its range.
    #[error("align.{key} must be between {least} and {most}, found {found}")]
    OutOfRange {
        /// Which key.
        key: &'static str,
        /// The value.
        found: f64,
        /// Smallest value allowed.
        least: f64,
        /// Largest value allowed.
        most: f64,
    },
    /// An overlap as long as the chunk never advances.
    #[error(
        "chunks of {size} keyframes cannot overlap by {overlap}: the overlap must be smaller than the chunk"
    )]
    BadChunking {
        /// Keyframes per chunk.
        size: usize,
        /// Keyframes shared by neighbours.
        overlap: usize,
    },
    /// A loop names a chunk that was never pushed.
    #[error("chunk {chunk} was never pushed")]
    UnknownChunk {
        /// Which chunk.
        chunk: ChunkId,
    },
    /// A chunk was pushed twice.
    #[error("chunk {chunk} was pushed before")]
    RepeatedChunk {
        /// Which chunk.
        chunk: ChunkId,
    },
    /// A predicted view cannot become a metric view.
    #[error("chunk {chunk}: {source}")]
    Geometry {
        /// Which chunk.
        chunk: ChunkId,
        /// What is wrong with the view.
        source: GeometryError,
    },
}
