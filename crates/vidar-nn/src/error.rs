//! What can go wrong when kernels are chosen or layers are put together.

/// A layer that cannot be built, or a kernel set that this machine does not have.
///
/// Wrong slice lengths given to an operation are programming errors, not data, and are asserted instead.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum NnError {
    /// The kernel set was asked for by name, but this processor (or build) lacks it.
    #[error("kernel set {asked} does not run on this machine; it has: {available}")]
    IsaUnavailable {
        /// What was asked for.
        asked: &'static str,
        /// What would run, comma separated.
        available: String,
    },
    /// A word that names no kernel set or precision.
    #[error("unknown {what} {found:?}; expected one of: {expected}")]
    UnknownName {
        /// "kernel set" or "precision".
        what: &'static str,
        /// The word.
        found: String,
        /// The words that are known.
        expected: &'static str,
    },
    /// A weight whose shape does not fit its layer.
    #[error("{layer}: weight {name:?} has shape {found:?}, expected {expected}")]
    WeightShape {
        /// The kind of layer.
        layer: &'static str,
        /// The weight's key.
        name: String,
        /// Its shape.
        found: Vec<usize>,
        /// The shape the layer needs, in words.
        expected: String,
    },
    /// A setting of a layer outside its range (a stride of zero, say).
    #[error("{layer}: {what}")]
    Setting {
        /// The kind of layer.
        layer: &'static str,
        /// What is wrong, with the value found and the range expected.
        what: String,
    },
}
