//! The dense heads, `head`: from features to maps at the image's size. They run view by view.

mod dpt;
mod dual_dpt;
mod fusion;
mod map;
mod stages;
mod tail;
mod uv;

pub(crate) use dpt::Dpt;
pub(crate) use dual_dpt::{DenseView, DualDpt, Embeddings};
pub(crate) use map::Map;
#[cfg(feature = "gpu")]
pub(crate) use uv::embedding;
