//! Why a video cannot be read.

use std::path::PathBuf;
use thiserror::Error;

/// Why a video cannot be read: which file, what was found, what was expected.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum VideoError {
    /// The operating system refused.
    #[error("cannot read {}: {source}", path.display())]
    Io {
        /// Which file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The file contradicts its format.
    #[error("{}: {found}; expected {expected}", path.display())]
    Malformed {
        /// Which file.
        path: PathBuf,
        /// What is there.
        found: String,
        /// What should be there.
        expected: String,
    },
    /// The file is whole, but uses something that is not read.
    #[error("{}: {found}; {way}", path.display())]
    Unsupported {
        /// Which file.
        path: PathBuf,
        /// What it uses.
        found: String,
        /// The nearest way to read it.
        way: String,
    },
    /// A frame cannot be decoded.
    #[error("{}: frame {number}: {reason}", path.display())]
    BadFrame {
        /// Which file.
        path: PathBuf,
        /// The frame, from 0 in the order of display.
        number: usize,
        /// What is wrong.
        reason: String,
    },
}
