//! Predictions on disk: what a run keeps between its stages, and what another program recorded.
//!
//! A chunk is two files. `000003.npz` holds what numpy reads too, in the official program's names and conventions; `000003.json`
//! says which frames it is of, in which frame its poses are, and what it was made of. The second is written last: a chunk
//! exists when it does.

mod arrays;
mod memory;
mod recorded;
mod store;

pub use memory::MemoryStore;
pub use recorded::{RECORDED, RecordedChunk, RecordedGeometry, RecordedModel, RecordedShapes};
pub use store::{ChunkStore, StoredChunk};
