//! SHA-256 of what streams by and of what lies on the disk.

use crate::download::{Progress, Watch};
use crate::error::HubError;
use sha2::{Digest as _, Sha256};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

const PIECE: usize = 1 << 20;

/// A hash under way, and how many bytes went in.
#[derive(Clone)]
pub(crate) struct Digest {
    hash: Sha256,
    bytes: u64,
}

impl Digest {
    pub fn new() -> Self {
        Self { hash: Sha256::new(), bytes: 0 }
    }

    pub fn update(&mut self, piece: &[u8]) {
        self.hash.update(piece);
        self.bytes += piece.len() as u64;
    }

    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Small hexadecimal letters.
    pub fn hex(&self) -> String {
        self.hash.clone().finalize().iter().map(|b| format!("{b:02x}")).collect()
    }
}

/// Hashes what `file` holds and leaves it at its end; a file longer than `most` is emptied.
pub(crate) fn hash_prefix(
    file: &mut File,
    path: &Path,
    most: u64,
    watch: &Watch<'_>,
) -> Result<Digest, HubError> {
    let length = file.metadata().map_err(HubError::io("look at", path))?.len();
    if length > most {
        file.set_len(0).map_err(HubError::io("truncate", path))?;
    }
    file.seek(SeekFrom::Start(0)).map_err(HubError::io("read", path))?;
    hash_rest(file, path, length, watch)
}

/// Length and SHA-256 of a file.
pub fn sha256_of(path: &Path, watch: &Watch<'_>) -> Result<(u64, String), HubError> {
    let mut file = File::open(path).map_err(HubError::io("read", path))?;
    let total = file.metadata().map_err(HubError::io("look at", path))?.len();
    let digest = hash_rest(&mut file, path, total, watch)?;
    Ok((digest.bytes(), digest.hex()))
}

fn hash_rest(file: &mut File, path: &Path, total: u64, watch: &Watch<'_>) -> Result<Digest, HubError> {
    let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    let mut digest = Digest::new();
    let mut piece = vec![0; PIECE];
    loop {
        watch.stop()?;
        let n = match file.read(&mut piece) {
            Ok(0) => return Ok(digest),
            Ok(n) => n,
            Err(e) if e.kind() == std::io::ErrorKind::Interrupted => continue,
            Err(e) => return Err(HubError::io("read", path)(e)),
        };
        digest.update(&piece[..n]);
        (watch.progress)(Progress { file: &name, done: digest.bytes(), total });
    }
}
