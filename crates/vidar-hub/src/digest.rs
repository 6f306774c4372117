//! SHA-256 of streams and of files.

use crate::error::HubError;
use crate::progress::{Progress, TransferCallbacks};
use sha2::{Digest as _, Sha256};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

const PIECE: usize = 1 << 20;

/// Bytes as lower-case hexadecimal digits.
pub fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

/// SHA-256 of `bytes` as lower-case hexadecimal digits.
pub fn sha256_hex(bytes: &[u8]) -> String {
    hex(&Sha256::digest(bytes))
}

/// An incremental hash and the number of bytes hashed.
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

    /// Lower-case hexadecimal digits.
    pub fn hex(&self) -> String {
        hex(&self.hash.clone().finalize())
    }
}

/// Hashes the content of `file` and leaves the position at its end. A file longer than `most` is emptied.
pub(crate) fn hash_prefix(
    file: &mut File,
    path: &Path,
    most: u64,
    callbacks: &TransferCallbacks<'_>,
) -> Result<Digest, HubError> {
    let length = file.metadata().map_err(HubError::io("look at", path))?.len();
    if length > most {
        file.set_len(0).map_err(HubError::io("truncate", path))?;
    }
    file.seek(SeekFrom::Start(0)).map_err(HubError::io("read", path))?;
    hash_rest(file, path, length, callbacks)
}

/// Length and SHA-256 of a file.
pub fn sha256_of(path: &Path, callbacks: &TransferCallbacks<'_>) -> Result<(u64, String), HubError> {
    let mut file = File::open(path).map_err(HubError::io("read", path))?;
    let total = file.metadata().map_err(HubError::io("look at", path))?.len();
    let digest = hash_rest(&mut file, path, total, callbacks)?;
    Ok((digest.bytes(), digest.hex()))
}

fn hash_rest(
    file: &mut File,
    path: &Path,
    total: u64,
    callbacks: &TransferCallbacks<'_>,
) -> Result<Digest, HubError> {
    let name = path.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    let mut digest = Digest::new();
    let mut piece = vec![0; PIECE];
    loop {
        callbacks.stop()?;
        let n = match file.read(&mut piece) {
            Ok(0) => return Ok(digest),
            Ok(n) => n,
            Err(e) if e.kind() == std::io::ErrorKind::Interrupted => continue,
            Err(e) => return Err(HubError::io("read", path)(e)),
        };
        digest.update(&piece[..n]);
        (callbacks.progress)(Progress { file: &name, done: digest.bytes(), total });
    }
}
