//! A hub, a store and a small checkpoint.

use crate::server::{Reply, Request, Server};
use std::path::{Path, PathBuf};
use std::time::Duration;
use vidar_hub::catalogue::{CONFIG, WEIGHTS};
use vidar_hub::{
    Checkpoint, HubError, HubSettings, Licence, OfficialFile, PullOptions, Store, TransferCallbacks,
};

pub const CONFIG_TEXT: &[u8] = b"{\"model_name\": \"da3-small\"}\n";

pub fn hex(bytes: &[u8]) -> String {
    vidar_hub::sha256_hex(bytes)
}

/// A whole safetensors file of one tensor and about 200 kB.
pub fn weights() -> Vec<u8> {
    let data: Vec<u8> = (0..200_000_u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
    let header = format!(r#"{{"w":{{"dtype":"U8","shape":[{0}],"data_offsets":[0,{0}]}}}}"#, data.len());
    [&(header.len() as u64).to_le_bytes()[..], header.as_bytes(), &data].concat()
}

/// An official checkpoint as far as this test's hub is concerned.
pub fn checkpoint(known_hash: bool, licence: Licence) -> &'static Checkpoint {
    let weights = weights();
    let hash: Option<&'static str> = known_hash.then(|| &*hex(&weights).leak());
    Box::leak(Box::new(Checkpoint {
        name: "tiny",
        repo: "maker/TINY",
        revision: "0123456789abcdef0123456789abcdef01234567",
        architecture: "da3-small",
        licence,
        parameters: 1,
        tensors: 1,
        files: [
            OfficialFile { name: CONFIG, bytes: None, sha256: None },
            OfficialFile { name: WEIGHTS, bytes: Some(weights.len() as u64), sha256: hash },
        ],
        abilities: &[],
        note: "",
    }))
}

pub fn tiny() -> &'static Checkpoint {
    checkpoint(true, Licence::Apache2)
}

pub struct Bench {
    pub folder: tempfile::TempDir,
    pub store: Store,
    pub server: Server,
}

impl Bench {
    /// A hub whose weights are answered by `answer`; everything else is as it should be.
    pub fn new(mut answer: impl FnMut(&Request, &[u8]) -> Reply + Send + 'static) -> Self {
        let file = weights();
        Self::plain(move |request| {
            if request.path.ends_with(CONFIG) {
                Reply::file(request, CONFIG_TEXT)
            } else {
                answer(request, &file)
            }
        })
    }

    pub fn plain(answer: impl FnMut(&Request) -> Reply + Send + 'static) -> Self {
        let server = Server::start(answer);
        let folder = tempfile::tempdir().unwrap();
        let store = Store::new(settings(folder.path(), &server.address));
        Self { folder, store, server }
    }

    pub fn pull(&self, checkpoint: &'static Checkpoint) -> Result<vidar_hub::InstalledCheckpoint, HubError> {
        self.store.pull(checkpoint, &options(), &quiet())
    }

    pub fn folder(&self) -> PathBuf {
        self.folder.path().join("models/tiny")
    }

    pub fn files(&self) -> Vec<String> {
        let entries = std::fs::read_dir(self.folder()).into_iter().flatten().flatten();
        let mut names: Vec<String> = entries.map(|e| e.file_name().to_string_lossy().into_owned()).collect();
        names.sort();
        names
    }

    /// Requests for the weights, as method and first byte.
    pub fn asked(&self) -> Vec<(String, Option<usize>)> {
        let requests = self.server.requests();
        requests
            .iter()
            .filter(|r| r.path.contains(WEIGHTS))
            .map(|r| (r.method.clone(), r.range_start()))
            .collect()
    }
}

pub fn settings(folder: &Path, endpoint: &str) -> HubSettings {
    HubSettings {
        endpoint: endpoint.to_owned(),
        proxy_from_environment: false,
        silence: Duration::from_secs(2),
        tries: 3,
        backoff: Duration::from_millis(2),
        longest_wait: Duration::from_secs(2),
        ..HubSettings::new(folder.join("models"))
    }
}

pub fn options() -> PullOptions {
    PullOptions { now: "2026-01-02T03:04:05Z".to_owned(), ..PullOptions::default() }
}

pub fn quiet() -> TransferCallbacks<'static> {
    TransferCallbacks { progress: &|_| {}, cancel: &|| false }
}
