//! Why a bag or one of its messages cannot be read.

use std::path::PathBuf;
use thiserror::Error;

/// Why a bag or one of its messages cannot be read: which file, where in it, what was found, what was expected.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum BagError {
    /// The operating system refused.
    #[error("cannot read {}: {source}", path.display())]
    Io {
        /// Which file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The file or folder is no bag.
    #[error("{} is not a bag: {found}; expected {expected}", path.display())]
    NotABag {
        /// What was opened.
        path: PathBuf,
        /// What it is, as far as that is known.
        found: String,
        /// What was expected.
        expected: String,
    },
    /// The file contradicts its format.
    #[error("{}: byte {offset}: found {found}, expected {expected}", path.display())]
    Malformed {
        /// Which file.
        path: PathBuf,
        /// Where in it.
        offset: u64,
        /// What is there.
        found: String,
        /// What should be there.
        expected: String,
    },
    /// The file is whole, but uses something that cannot be read.
    #[error("{}: {found}; {way}", path.display())]
    Unsupported {
        /// Which file.
        path: PathBuf,
        /// What it uses.
        found: String,
        /// The nearest way to read it.
        way: String,
    },
    /// The bag holds no message.
    #[error("{}: the bag holds no message: {found}", path.display())]
    Empty {
        /// Which file.
        path: PathBuf,
        /// What it holds instead.
        found: String,
    },
    /// A size or count is above the limit that keeps memory bounded.
    #[error("{}: {what}: {found}; the limit is {limit}", path.display())]
    TooLarge {
        /// Which file.
        path: PathBuf,
        /// Of what.
        what: &'static str,
        /// The value.
        found: u64,
        /// The limit.
        limit: u64,
    },
    /// One message cannot be decoded.
    #[error("{}: {topic}, message at {time} ({message_type}): {reason}", path.display())]
    BadMessage {
        /// Which file.
        path: PathBuf,
        /// Its topic.
        topic: String,
        /// When it was logged, seconds.
        time: String,
        /// Its type.
        message_type: String,
        /// What is wrong.
        reason: String,
    },
}
