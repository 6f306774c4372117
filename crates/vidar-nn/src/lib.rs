//! Checkpoint reading and CPU kernels: the only crate that knows how a network is computed.
//!
//! Numbers are `f32` at every boundary, row-major; feature maps are NHWC (`[rows, cols, channels]`). Operations take slices
//! and write slices; a [`Compute`] says which kernel set and which precision of matrix products to use, and every
//! operation with kernels asks for one, so that a forced kernel set is used throughout. They run on the rayon pool they are
//! called in and give the same bits for any number of threads.
//!
//! Slice lengths are the responsibility of the caller and are asserted; everything that comes from a file is checked when it is read
//! ([`Checkpoint`]) or when a layer is constructed (`new`), and reported as an error.

pub mod activation;
mod attention;
mod checkpoint;
mod compute;
mod conv;
mod error;
mod head;
mod isa;
mod kernels;
mod linear;
mod norm;
mod resize;
mod rope;
mod weight;

pub use attention::{AttentionSpec, KeyValues, TokenRows, attention, attention_separate};
pub use checkpoint::{Checkpoint, CheckpointError, Dtype, TensorView, WeightSource};
pub use compute::{Compute, Precision};
pub use conv::{Conv2d, ConvInput, ConvTranspose2d, MapRef};
pub use error::NnError;
pub use head::{HeadBranch, HeadInput, head};
pub use isa::Isa;
pub use linear::{Epilogue, Linear};
pub use norm::LayerNorm;
pub use resize::{Corners, GridEmbedding, MapSize, resize_bicubic_scaled, resize_bilinear};
pub use rope::RopeTable;
pub use weight::Weight;
