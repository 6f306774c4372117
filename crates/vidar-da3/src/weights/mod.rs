//! Where weights come from: the hub's files checked key by key, or weights made by rule.

pub mod deterministic;
pub mod inventory;
mod opened;
mod scope;
mod slot;

pub use opened::{detect, verify};
pub(crate) use scope::{ConvShape, Scope};
pub use slot::Residency;
pub(crate) use slot::Slot;

use vidar_nn::{CheckpointError, Weight, WeightSource};

/// Weights made by rule ([`deterministic`]), one tensor at a time when it is asked for.
#[derive(Clone, Copy, Debug, Default)]
pub struct DeterministicWeights;

impl WeightSource for DeterministicWeights {
    fn weight(&self, name: &str, shape: &[usize]) -> Result<Weight, CheckpointError> {
        Ok(Weight::owned(name, shape, deterministic::tensor(name, shape)))
    }

    /// Every key the network may ask for exists, under its stored name only.
    fn has(&self, name: &str) -> bool {
        inventory::stored_name(name).is_none()
    }
}
