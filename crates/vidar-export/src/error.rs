//! Errors of writing and reading files: place, found value, expected value.

use std::io;
use std::path::PathBuf;
use thiserror::Error;
use vidar_core::trajectory::TrajectoryError;

/// Longest piece of a foreign file that an error repeats, characters.
const QUOTED_CHARS: usize = 48;

/// Errors of writing or reading a file.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ExportError {
    /// The writer refused bytes (full device, closed pipe).
    #[error("cannot write {format}: {source}")]
    Write {
        /// What was being written.
        format: &'static str,
        /// The system's reason.
        source: io::Error,
    },
    /// A file or folder could not be opened, written, renamed or read.
    #[error("cannot {action} {}: {source}", path.display())]
    File {
        /// What was tried (`create`, `write`, `rename`, `read`).
        action: &'static str,
        /// Which file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// The bytes are not a valid file of this format.
    #[error("{format}, {place}: expected {expected}, found {found}")]
    Malformed {
        /// Which format.
        format: &'static str,
        /// Where: a line, a byte, an element.
        place: String,
        /// The expected content.
        expected: String,
        /// The content found, shortened.
        found: String,
    },
    /// The file is valid but uses a part of the format that VIDAR does not read.
    #[error("{format}, {place}: {feature} is not supported; {hint}")]
    Unsupported {
        /// Which format.
        format: &'static str,
        /// Where.
        place: String,
        /// The unsupported part.
        feature: String,
        /// What to do instead.
        hint: &'static str,
    },
    /// The data cannot be represented in this format (not finite, inconsistent, too large).
    #[error("{format} cannot hold {what}: {reason}")]
    Unwritable {
        /// Which format.
        format: &'static str,
        /// Which part of the data.
        what: String,
        /// Why not.
        reason: String,
    },
    /// The poses of a file are not a trajectory.
    #[error("{format}: {source}")]
    Trajectory {
        /// Which format.
        format: &'static str,
        /// Why not.
        source: TrajectoryError,
    },
}

impl ExportError {
    pub(crate) fn malformed(
        format: &'static str,
        place: impl Into<String>,
        expected: impl Into<String>,
        found: impl Into<String>,
    ) -> Self {
        Self::Malformed { format, place: place.into(), expected: expected.into(), found: found.into() }
    }

    pub(crate) fn unwritable(
        format: &'static str,
        what: impl Into<String>,
        reason: impl Into<String>,
    ) -> Self {
        Self::Unwritable { format, what: what.into(), reason: reason.into() }
    }
}

/// Gives an I/O error its format.
pub(crate) fn write_error(format: &'static str) -> impl Fn(io::Error) -> ExportError {
    move |source| ExportError::Write { format, source }
}

/// A quoted, shortened piece of a foreign file.
pub(crate) fn quoted(text: &str) -> String {
    let mut short: String = text.chars().take(QUOTED_CHARS).collect();
    if short.len() < text.len() {
        short.push('…');
    }
    format!("{short:?}")
}
