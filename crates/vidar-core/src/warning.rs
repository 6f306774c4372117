//! "Did, but": what a stage returns beside its result when the input was not quite right.

use serde::{Deserialize, Serialize};
use std::fmt;

/// Something the user should know, though the work went on.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Warning {
    /// Stable kebab-case kind, for grouping and for scripts (`time-gap`, `image-truncated`).
    pub kind: String,
    /// What was found, with numbers and units.
    pub message: String,
    /// Where: a file with its line, a frame, a key. Empty when it concerns the whole input.
    pub place: String,
    /// What the user can do about it, if anything.
    pub hint: Option<String>,
}

impl Warning {
    /// A warning of `kind` saying `message`.
    pub fn new(kind: impl Into<String>, message: impl Into<String>) -> Self {
        Self { kind: kind.into(), message: message.into(), place: String::new(), hint: None }
    }

    /// The same warning with its place.
    pub fn at(mut self, place: impl fmt::Display) -> Self {
        self.place = place.to_string();
        self
    }

    /// The same warning with the next step.
    pub fn hint(mut self, hint: impl Into<String>) -> Self {
        self.hint = Some(hint.into());
        self
    }
}

impl fmt::Display for Warning {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "[{}] {}", self.kind, self.message)?;
        if !self.place.is_empty() {
            write!(f, " (at {})", self.place)?;
        }
        Ok(())
    }
}
