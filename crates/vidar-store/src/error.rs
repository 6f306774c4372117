//! Why a store cannot be used.

use std::path::PathBuf;
use thiserror::Error;

/// Why a store cannot be used.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum StoreError {
    /// The address names no store.
    #[error("{uri:?} is no store: {reason}")]
    BadAddress {
        /// The address as given.
        uri: String,
        /// What is wrong with it.
        reason: String,
    },
    /// The store did not do what it was asked.
    #[error("cannot {action} {name} in the store {uri}: {source}")]
    Access {
        /// `read`, `write`, `list` or `remove`.
        action: &'static str,
        /// The object.
        name: String,
        /// The store.
        uri: String,
        /// Its reason.
        #[source]
        source: Box<object_store::Error>,
    },
    /// An object is larger than what its reader takes.
    #[error("{name} in the store {uri} has {bytes} bytes, at most {limit} are read")]
    TooLarge {
        /// The object.
        name: String,
        /// The store.
        uri: String,
        /// Its size, bytes.
        bytes: u64,
        /// The largest that is read, bytes.
        limit: u64,
    },
    /// A folder could not be opened, or a local file not be copied to or from the store.
    #[error("cannot {action} {path}: {source}", path = path.display())]
    File {
        /// `read`, `write`, `make` or `open`.
        action: &'static str,
        /// Which file or folder.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
}

impl StoreError {
    /// The reason of the operating system, where there is one.
    pub fn io(&self) -> Option<&std::io::Error> {
        let mut error: Option<&(dyn std::error::Error + 'static)> = Some(self);
        while let Some(cause) = error {
            if let Some(io) = cause.downcast_ref::<std::io::Error>() {
                return Some(io);
            }
            error = cause.source();
        }
        None
    }
}
