//! A read-only view of a file's bytes: mapped, owned, or part of the program.

use std::fs::File;
use std::path::Path;

use memmap2::Mmap;

/// Bytes of a file that stay where they are.
pub(crate) enum Mapping {
    Mapped(Mmap),
    Owned(Vec<u8>),
    Static(&'static [u8]),
}

impl Mapping {
    pub(crate) fn open(path: &Path) -> std::io::Result<Self> {
        let file = File::open(path)?;
        if file.metadata()?.len() == 0 {
            return Ok(Self::Owned(Vec::new())); // an empty file cannot be mapped
        }
        // SAFETY: the mapping is read-only and private to this process; that nobody truncates or rewrites the file
        // meanwhile is the documented condition of `Checkpoint`, as for every mapped file.
        let map = unsafe { Mmap::map(&file)? };
        Ok(Self::Mapped(map))
    }

    pub(crate) fn bytes(&self) -> &[u8] {
        match self {
            Self::Mapped(map) => map,
            Self::Owned(bytes) => bytes,
            Self::Static(bytes) => bytes,
        }
    }
}

impl From<Vec<u8>> for Mapping {
    fn from(bytes: Vec<u8>) -> Self {
        Self::Owned(bytes)
    }
}

impl std::fmt::Debug for Mapping {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Mapping({} bytes)", self.bytes().len())
    }
}
