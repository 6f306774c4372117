//! Named objects of a batch in a local folder or an object store.
//!
//! Names are paths with `/`, relative to the store's address. An object is written whole or not at all, whoever is killed
//! when; the last writer of a name wins. Calls block; each does its own transfer on the calling thread.
//!
//! ```
//! let folder = tempfile::tempdir().unwrap();
//! let store = vidar_store::Store::create(folder.path().to_str().unwrap())?;
//! store.put("records/a.json", b"{}".to_vec())?;
//! assert_eq!(store.get("records/a.json", 100)?.as_deref(), Some(&b"{}"[..]));
//! assert_eq!(store.list("records")?, ["records/a.json"]);
//! assert!(store.get("records/b.json", 100)?.is_none());
//! # Ok::<(), vidar_store::StoreError>(())
//! ```

mod address;
mod error;

pub use error::StoreError;

use futures_util::{StreamExt, TryStreamExt};
use object_store::path::Path as Name;
use object_store::{ObjectStore, ObjectStoreExt, PutPayload, WriteMultipart};
use std::future::Future;
use std::io::{Read, Write};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use tokio::runtime::Runtime;

/// Files above this are sent in parts of this size, so that a map of gigabytes is never held in memory. S3 wants parts of at
/// least 5 MiB and takes 10 000 of them: 80 GiB.
const PART_BYTES: usize = 8 << 20;

/// An open store.
pub struct Store {
    uri: String,
    objects: Arc<dyn ObjectStore>,
    /// In front of every name.
    prefix: Name,
    /// One thread: transfers are waited for one by one.
    runtime: Runtime,
    read: AtomicU64,
    written: AtomicU64,
}

/// Bytes that went through a store.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Traffic {
    /// Read from it, bytes.
    pub read: u64,
    /// Written to it, bytes.
    pub written: u64,
}

impl Store {
    /// Opens a store: the path of a folder, `file:///…`, or with the feature `s3` `s3://bucket/prefix`, whose credentials and
    /// endpoint come from the `AWS_…` variables.
    ///
    /// # Errors
    /// The address names no store.
    pub fn open(uri: &str) -> Result<Self, StoreError> {
        Self::at(uri, false)
    }

    /// As [`Store::open`]; a folder that is missing is made.
    ///
    /// # Errors
    /// As [`Store::open`], and the folder cannot be made.
    pub fn create(uri: &str) -> Result<Self, StoreError> {
        Self::at(uri, true)
    }

    fn at(uri: &str, makes_folder: bool) -> Result<Self, StoreError> {
        let (objects, prefix) = address::open(uri, makes_folder)?;
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
        let runtime = runtime.map_err(|e| bad(uri, e.to_string()))?;
        let uri = uri.trim_end_matches('/').to_owned();
        let (read, written) = Default::default();
        Ok(Self { uri, objects, prefix, runtime, read, written })
    }

    /// The address as given, without a final `/`.
    pub fn uri(&self) -> &str {
        &self.uri
    }

    /// What went through it so far.
    pub fn traffic(&self) -> Traffic {
        let load = |n: &AtomicU64| n.load(Ordering::Relaxed);
        Traffic { read: load(&self.read), written: load(&self.written) }
    }

    /// An object of at most `limit` bytes; `None` where there is none of that name.
    ///
    /// # Errors
    /// The store cannot be read, or the object is larger.
    pub fn get(&self, name: &str, limit: u64) -> Result<Option<Vec<u8>>, StoreError> {
        let at = self.name(name)?;
        let bytes = self.wait(async {
            let found = match self.objects.get(&at).await {
                Ok(found) => found,
                Err(object_store::Error::NotFound { .. }) => return Ok(None),
                Err(error) => return Err(self.failed("read", name, error)),
            };
            if found.meta.size > limit {
                let (name, uri) = (name.to_owned(), self.uri.clone());
                return Err(StoreError::TooLarge { name, uri, bytes: found.meta.size, limit });
            }
            found.bytes().await.map(|b| Some(Vec::from(b))).map_err(|e| self.failed("read", name, e))
        })?;
        self.read.fetch_add(bytes.as_ref().map_or(0, |b| b.len() as u64), Ordering::Relaxed);
        Ok(bytes)
    }

    /// Writes an object.
    ///
    /// # Errors
    /// The store cannot be written; what was there before is as it was.
    pub fn put(&self, name: &str, bytes: Vec<u8>) -> Result<(), StoreError> {
        let (at, count) = (self.name(name)?, bytes.len() as u64);
        let put = self.wait(self.objects.put(&at, PutPayload::from(bytes)));
        put.map_err(|e| self.failed("write", name, e))?;
        self.written.fetch_add(count, Ordering::Relaxed);
        Ok(())
    }

    /// Writes the content of a local file as an object; returns its size, bytes.
    ///
    /// # Errors
    /// The file cannot be read, or the store cannot be written; what was there before is as it was.
    pub fn put_file(&self, name: &str, file: &Path) -> Result<u64, StoreError> {
        let unreadable = |source| StoreError::File { action: "read", path: file.to_owned(), source };
        let mut open = std::fs::File::open(file).map_err(unreadable)?;
        let mut part = read_part(&mut open).map_err(unreadable)?;
        if part.len() < PART_BYTES {
            let count = part.len() as u64;
            return self.put(name, part).map(|()| count);
        }
        let at = self.name(name)?;
        let count = self.wait(async {
            let upload = self.objects.put_multipart(&at).await.map_err(|e| self.failed("write", name, e))?;
            let mut upload = WriteMultipart::new_with_chunk_size(upload, PART_BYTES);
            let mut count = 0;
            while !part.is_empty() {
                count += part.len() as u64;
                let sent = upload.wait_for_capacity(1).await;
                sent.map_err(|e| self.failed("write", name, e))?;
                upload.write(&part);
                part = match read_part(&mut open) {
                    Ok(part) => part,
                    Err(error) => {
                        // What was sent is of no use; a store that cannot even forget it cleans up by its own rules.
                        let _ = upload.abort().await;
                        return Err(unreadable(error));
                    }
                };
            }
            upload.finish().await.map(|_| count).map_err(|e| self.failed("write", name, e))
        })?;
        self.written.fetch_add(count, Ordering::Relaxed);
        Ok(count)
    }

    /// Copies an object into a new local file, whose folder exists; returns its size, bytes.
    ///
    /// # Errors
    /// There is no such object, or the file cannot be written.
    pub fn get_file(&self, name: &str, file: &Path) -> Result<u64, StoreError> {
        let unwritable = |source| StoreError::File { action: "write", path: file.to_owned(), source };
        let at = self.name(name)?;
        let mut out = std::fs::File::create(file).map_err(unwritable)?;
        let count = self.wait(async {
            let found = self.objects.get(&at).await.map_err(|e| self.failed("read", name, e))?;
            let (mut parts, mut count) = (found.into_stream(), 0);
            while let Some(part) = parts.next().await {
                let part = part.map_err(|e| self.failed("read", name, e))?;
                out.write_all(&part).map_err(unwritable)?;
                count += part.len() as u64;
            }
            Ok(count)
        })?;
        self.read.fetch_add(count, Ordering::Relaxed);
        Ok(count)
    }

    /// The names of all objects below `folder`, sorted.
    ///
    /// # Errors
    /// The store cannot be read.
    pub fn list(&self, folder: &str) -> Result<Vec<String>, StoreError> {
        let at = self.name(folder)?;
        let found = self.wait(self.objects.list(Some(&at)).map_ok(|o| o.location).try_collect::<Vec<_>>());
        let found = found.map_err(|e| self.failed("list", folder, e))?;
        let relative = |name: &Name| {
            let rest: Vec<_> = name.prefix_match(&self.prefix)?.collect();
            Some(rest.iter().map(|p| p.as_ref()).collect::<Vec<_>>().join("/"))
        };
        let mut names: Vec<String> = found.iter().filter_map(relative).collect();
        names.sort();
        Ok(names)
    }

    fn name(&self, name: &str) -> Result<Name, StoreError> {
        let relative = Name::parse(name).map_err(|e| bad(name, e.to_string()))?;
        Ok(self.prefix.parts().chain(relative.parts()).collect())
    }

    fn wait<T>(&self, work: impl Future<Output = T>) -> T {
        self.runtime.block_on(work)
    }

    fn failed(&self, action: &'static str, name: &str, source: object_store::Error) -> StoreError {
        StoreError::Access { action, name: name.to_owned(), uri: self.uri.clone(), source: Box::new(source) }
    }
}

impl std::fmt::Debug for Store {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Store")
            .field("uri", &self.uri)
            .field("traffic", &self.traffic())
            .finish_non_exhaustive()
    }
}

/// Up to [`PART_BYTES`] of what is left of a file.
fn read_part(file: &mut std::fs::File) -> std::io::Result<Vec<u8>> {
    let mut part = Vec::new();
    file.take(PART_BYTES as u64).read_to_end(&mut part)?;
    Ok(part)
}

fn bad(uri: &str, reason: String) -> StoreError {
    StoreError::BadAddress { uri: uri.to_owned(), reason }
}

#[cfg(test)]
mod tests;
