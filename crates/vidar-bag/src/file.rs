//! Random access to a file, with a small window for walking through it.

use crate::error::BagError;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, PoisonError};

/// An open file, of known length or still written.
#[derive(Debug)]
pub(crate) struct BagFile {
    path: PathBuf,
    length: AtomicU64,
    grows: bool,
    // Positioned reads differ between systems; one lock around seek and read works on all of them.
    file: Mutex<File>,
}

impl BagFile {
    pub(crate) fn open(path: &Path) -> Result<Self, BagError> {
        let failed = |source| BagError::Io { path: path.to_path_buf(), source };
        let file = File::open(path).map_err(failed)?;
        let metadata = file.metadata().map_err(failed)?;
        if !metadata.is_file() {
            let found = if metadata.is_dir() { "a folder" } else { "a device or a pipe" };
            let expected = "a file, because messages are read in any order".to_string();
            return Err(BagError::NotABag { path: path.to_path_buf(), found: found.into(), expected });
        }
        let length = AtomicU64::new(metadata.len());
        Ok(Self { path: path.to_path_buf(), length, grows: false, file: Mutex::new(file) })
    }

    /// A file that is still written.
    pub(crate) fn growing(path: &Path) -> Result<Self, BagError> {
        Ok(Self { grows: true, ..Self::open(path)? })
    }

    /// The first bytes of a file, as if it had no more.
    pub(crate) fn beginning(path: &Path, length: u64) -> Result<Self, BagError> {
        let file = Self::open(path)?;
        file.length.fetch_min(length, Ordering::Relaxed);
        Ok(file)
    }

    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    pub(crate) fn length(&self) -> u64 {
        self.length.load(Ordering::Relaxed)
    }

    /// Whether the file has so many bytes by now.
    fn reaches(&self, end: u64) -> Result<bool, BagError> {
        if self.grows && end > self.length() {
            let failed = |source| BagError::Io { path: self.path.clone(), source };
            let file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
            self.length.fetch_max(file.metadata().map_err(failed)?.len(), Ordering::Relaxed);
        }
        Ok(end <= self.length())
    }

    /// The bytes from `offset`; an error where the file ends before. The length is checked before memory is taken.
    pub(crate) fn read(&self, offset: u64, length: u64) -> Result<Vec<u8>, BagError> {
        if !self.reaches(offset.saturating_add(length))? {
            let found = format!("the end of the file (of {} bytes)", self.length());
            return Err(self.malformed(offset, found, format!("{length} bytes")));
        }
        let mut bytes = vec![0; length as usize];
        self.read_into(offset, &mut bytes)?;
        Ok(bytes)
    }

    fn read_into(&self, offset: u64, bytes: &mut [u8]) -> Result<(), BagError> {
        let failed = |source| BagError::Io { path: self.path.clone(), source };
        let mut file = self.file.lock().unwrap_or_else(PoisonError::into_inner);
        file.seek(SeekFrom::Start(offset)).map_err(failed)?;
        file.read_exact(bytes).map_err(failed)
    }

    pub(crate) fn malformed(
        &self,
        offset: u64,
        found: impl Into<String>,
        expected: impl Into<String>,
    ) -> BagError {
        BagError::Malformed {
            path: self.path.clone(),
            offset,
            found: found.into(),
            expected: expected.into(),
        }
    }

    pub(crate) fn unsupported(&self, found: impl Into<String>, way: impl Into<String>) -> BagError {
        BagError::Unsupported { path: self.path.clone(), found: found.into(), way: way.into() }
    }
}

/// Bytes read ahead while walking: some hundred small records, and far less than a chunk that is skipped.
const WINDOW_BYTES: u64 = 64 << 10;

/// Bytes read with the head of one message: an IMU sample of ROS has 320 and comes in one system call.
pub(crate) const MESSAGE_AHEAD_BYTES: u64 = 1 << 10;

/// Reads small pieces at growing offsets without one system call for each.
pub(crate) struct Window<'a> {
    file: &'a BagFile,
    ahead: u64,
    start: u64,
    bytes: Vec<u8>,
}

impl<'a> Window<'a> {
    pub(crate) fn new(file: &'a BagFile) -> Self {
        Self::reading_ahead(file, WINDOW_BYTES)
    }

    /// For few reads near each other, such as one message.
    pub(crate) fn reading_ahead(file: &'a BagFile, ahead: u64) -> Self {
        Self { file, ahead, start: 0, bytes: Vec::new() }
    }

    /// The bytes from `offset`, or `None` where the file ends before.
    pub(crate) fn get(&mut self, offset: u64, length: u64) -> Result<Option<&[u8]>, BagError> {
        let end = offset.saturating_add(length);
        if !self.file.reaches(end)? {
            return Ok(None);
        }
        if offset < self.start || end > self.start + self.bytes.len() as u64 {
            let wanted = length.max(self.ahead).min(self.file.length() - offset);
            self.bytes = self.file.read(offset, wanted)?;
            self.start = offset;
        }
        let from = (offset - self.start) as usize;
        Ok(self.bytes.get(from..from + length as usize))
    }
}
