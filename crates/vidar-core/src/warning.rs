//! "Did, but": what a stage returns beside its result when the input was not quite right.

use crate::printable::printable;
use serde::{Deserialize, Serialize};
use std::fmt;

/// What a warning means for the result.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Severity {
    /// The result is what such an input gives; the user should know this about the input or the way it was made. That includes what
    /// sound recordings lack as well (images before the odometry starts, keyframes without parallax, metres without an IMU), and what
    /// is provisional.
    #[default]
    Info,
    /// A part of the result that sound recordings have is missing, or it was made in a weaker way than asked for. A run that raised
    /// one ends as degraded (exit code 3).
    Degraded,
}

/// Something the user should know, though the work went on.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Warning {
    /// What it means for the result.
    #[serde(default)]
    pub severity: Severity,
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
    /// A warning of `kind` saying `message`, of severity [`Severity::Info`].
    pub fn new(kind: impl Into<String>, message: impl Into<String>) -> Self {
        Self {
            severity: Severity::Info,
            kind: kind.into(),
            message: printable(&message.into()).into_owned(),
            place: String::new(),
            hint: None,
        }
    }

    /// A warning of `kind` saying `message`: a part of the result is missing or weaker than asked for.
    pub fn degraded(kind: impl Into<String>, message: impl Into<String>) -> Self {
        Self { severity: Severity::Degraded, ..Self::new(kind, message) }
    }

    /// The same warning with its place.
    pub fn at(mut self, place: impl fmt::Display) -> Self {
        self.place = printable(&place.to_string()).into_owned();
        self
    }

    /// The same warning with the next step.
    pub fn hint(mut self, hint: impl Into<String>) -> Self {
        self.hint = Some(printable(&hint.into()).into_owned());
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
