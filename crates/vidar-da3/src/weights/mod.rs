//! Sources of weights: the hub's files, checked key by key, and synthetic weights.

mod identify;
pub mod inventory;
mod scope;
mod slot;
pub mod synthetic;

pub use identify::{detect, verify};
pub(crate) use scope::{ConvShape, Scope};
pub use slot::Residency;
pub(crate) use slot::Slot;

use vidar_nn::{CheckpointError, Weight, WeightSource};

/// Synthetic weights ([`synthetic`]), generated one tensor at a time when requested.
#[derive(Clone, Copy, Debug, Default)]
pub struct SyntheticWeights;

impl WeightSource for SyntheticWeights {
    fn weight(&self, name: &str, shape: &[usize]) -> Result<Weight, CheckpointError> {
        Ok(Weight::owned(name, shape, synthetic::tensor(name, shape)))
    }

    /// Every key that a network requests exists, under its stored name only.
    fn has(&self, name: &str) -> bool {
        inventory::stored_name(name).is_none()
    }
}
