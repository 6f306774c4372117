//! Why something between machines failed.

use std::path::PathBuf;
use thiserror::Error;

/// Why a link cannot be used.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum LinkError {
    /// The program was built without Zenoh.
    #[error("this program was built without links to other machines")]
    NotBuilt,
    /// An address, a key or a file of settings cannot be used.
    #[error("{what}: {reason}")]
    BadSetting {
        /// What was given.
        what: String,
        /// What is wrong with it.
        reason: String,
    },
    /// The file of settings cannot be read.
    #[error("cannot read {path}: {source}", path = path.display())]
    File {
        /// Which file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// Zenoh reported an error.
    #[error("{action}: {reason}")]
    Transport {
        /// The action that failed.
        action: String,
        /// What Zenoh says.
        reason: String,
    },
    /// Nobody answers under a key.
    #[error("no worker answers under {key}: {reason}")]
    NoWorker {
        /// The key.
        key: String,
        /// What was tried.
        reason: String,
    },
    /// The workers under a key are not what was asked for.
    #[error("the workers under {key} are not usable: {reason}")]
    OtherModel {
        /// The key.
        key: String,
        /// What was found and what was expected.
        reason: String,
    },
    /// The caller asked to stop.
    #[error("cancelled")]
    Cancelled,
}

/// What is wrong with bytes that came from elsewhere.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum WireError {
    /// The bytes end before what they announce.
    #[error("{what}: {found} bytes, expected {expected}")]
    Length {
        /// Which part.
        what: &'static str,
        /// Bytes there.
        found: usize,
        /// Bytes announced or needed.
        expected: usize,
    },
    /// They are of another program or version.
    #[error("it is no message of this protocol (version {expected})")]
    OtherProtocol {
        /// The version that is read.
        expected: u32,
    },
    /// A number is beyond its bound.
    #[error("{what} is {found}, at most {limit} is accepted")]
    TooLarge {
        /// Which number.
        what: &'static str,
        /// As announced.
        found: u64,
        /// The bound.
        limit: u64,
    },
    /// A value cannot be used.
    #[error("{what}: {reason}")]
    Bad {
        /// Which value.
        what: &'static str,
        /// What was found and expected.
        reason: String,
    },
}

impl WireError {
    pub(crate) fn bad(what: &'static str, reason: impl ToString) -> Self {
        Self::Bad { what, reason: reason.to_string() }
    }
}
