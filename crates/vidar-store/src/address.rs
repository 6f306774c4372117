//! Which store an address names.

use crate::bad;
use crate::error::StoreError;
use object_store::ObjectStore;
use object_store::local::LocalFileSystem;
use object_store::path::Path as Name;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// An open store, and what stands in front of every name in it.
pub(crate) type Opened = (Arc<dyn ObjectStore>, Name);

/// Opens the store of an address.
pub(crate) fn open(uri: &str, makes_folder: bool) -> Result<Opened, StoreError> {
    match uri.split_once("://") {
        None if uri.is_empty() => Err(bad(uri, "it is empty".into())),
        None => local(Path::new(uri), makes_folder),
        Some(("file", path)) if path.starts_with('/') => local(&PathBuf::from(path), makes_folder),
        Some(("file", _)) => Err(bad(uri, "write file:///absolute/path".into())),
        Some(("s3", rest)) => s3(uri, rest),
        Some((scheme, _)) => {
            Err(bad(uri, format!("{scheme}:// is unknown; give a folder or s3://bucket/prefix")))
        }
    }
}

fn local(folder: &Path, makes_folder: bool) -> Result<Opened, StoreError> {
    let failed = |action| move |source| StoreError::File { action, path: folder.to_owned(), source };
    if makes_folder {
        std::fs::create_dir_all(folder).map_err(failed("make"))?;
    }
    std::fs::read_dir(folder).map_err(failed("open"))?;
    let store = LocalFileSystem::new_with_prefix(folder);
    let store = store.map_err(|e| bad(&folder.display().to_string(), e.to_string()))?;
    Ok((Arc::new(store), Name::default()))
}

#[cfg(feature = "s3")]
fn s3(uri: &str, rest: &str) -> Result<Opened, StoreError> {
    let (bucket, prefix) = rest.split_once('/').unwrap_or((rest, ""));
    // Fails where the process has chosen one already, which serves as well.
    let _ = rustls::crypto::ring::default_provider().install_default();
    let store = object_store::aws::AmazonS3Builder::from_env().with_bucket_name(bucket).build();
    let prefix = Name::parse(prefix).map_err(|e| bad(uri, e.to_string()))?;
    Ok((Arc::new(store.map_err(|e| bad(uri, e.to_string()))?), prefix))
}

#[cfg(not(feature = "s3"))]
fn s3(uri: &str, _: &str) -> Result<Opened, StoreError> {
    Err(bad(uri, "this program was built without object stores; build it with --features s3".into()))
}
