//! One writer per checkpoint.

use crate::error::HubError;
use std::fs::{File, OpenOptions, TryLockError};
use std::path::Path;

/// Held while a checkpoint is written; the system releases it when the process ends.
pub(crate) struct Lock {
    _file: File,
}

impl Lock {
    pub fn take(folder: &Path) -> Result<Self, HubError> {
        let path = folder.join(".lock");
        let mut options = OpenOptions::new();
        let opened = options.write(true).create(true).truncate(false).open(&path);
        let file = opened.map_err(HubError::io("create", &path))?;
        match file.try_lock() {
            Ok(()) => Ok(Self { _file: file }),
            Err(TryLockError::WouldBlock) => Err(HubError::Busy { path: folder.to_owned() }),
            // A file system without locks: two concurrent writers are detected by the hash.
            Err(TryLockError::Error(_)) => Ok(Self { _file: file }),
        }
    }
}
