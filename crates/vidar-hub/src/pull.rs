//! `pull` and `import`: adding checkpoints to the store.

use crate::catalogue::{CHECKPOINTS, CONFIG, Checkpoint, WEIGHTS, of_hash, of_size};
use crate::client::Client;
use crate::digest::sha256_of;
use crate::download::{FileRequest, fetch};
use crate::error::HubError;
use crate::header::{Header, read_header};
use crate::lock::Lock;
use crate::progress::TransferCallbacks;
use crate::record::{Acceptance, IdentifiedBy, RECORD, RecordedFile, record_of};
use crate::store::{CheckpointLocation, InstalledCheckpoint, Store, make_folder, minimal_config, write_json};
use std::fs;
use std::path::{Path, PathBuf};

/// How a checkpoint is pulled.
#[derive(Clone, Debug, Default)]
pub struct PullOptions {
    /// The acceptance of its licence, where the user gave one.
    pub acceptance: Option<Acceptance>,
    /// Another commit or branch than the one described here; only the hub then states their hashes.
    pub revision: Option<String>,
    /// Fetch again, even if it is present.
    pub again: bool,
    /// The current time, RFC 3339.
    pub now: String,
}

impl Store {
    /// Fetches a checkpoint, continuing an earlier call. Nothing is fetched if the checkpoint is present.
    pub fn pull(
        &self,
        checkpoint: &'static Checkpoint,
        options: &PullOptions,
        callbacks: &TransferCallbacks<'_>,
    ) -> Result<InstalledCheckpoint, HubError> {
        if let Some(acceptance) = &options.acceptance {
            self.accept(checkpoint, acceptance)?;
        }
        self.require_acceptance(checkpoint)?;
        if !options.again
            && options.revision.is_none()
            && let Some(installed) = self.find(checkpoint)?
        {
            return Ok(installed);
        }
        if self.settings().offline {
            return Err(HubError::Offline { what: checkpoint.name.to_owned() });
        }
        let folder = self.folder(checkpoint);
        make_folder(&folder)?;
        let _lock = Lock::take(&folder)?;
        self.pull_files(checkpoint, options, &folder, callbacks)?;
        self.installed(checkpoint)
    }

    fn pull_files(
        &self,
        checkpoint: &'static Checkpoint,
        options: &PullOptions,
        folder: &Path,
        callbacks: &TransferCallbacks<'_>,
    ) -> Result<(), HubError> {
        let settings = self.settings();
        let page = checkpoint.page(&settings.endpoint);
        let client = Client::new(settings, page.clone());
        let revision = checked_revision(options.revision.as_deref().unwrap_or(checkpoint.revision))?;
        let pinned = options.revision.is_none();
        let mut files = Vec::new();
        let mut commit = None;
        for official in &checkpoint.files {
            let url = checkpoint.url(&settings.endpoint, revision, official.name);
            let target = folder.join(official.name);
            let wanted = FileRequest {
                url: &url,
                target: &target,
                name: official.name,
                bytes: official.bytes.filter(|_| pinned || official.name == WEIGHTS),
                sha256: official.sha256.filter(|_| pinned),
            };
            let fetched = fetch(&client, settings, &wanted, callbacks)?;
            if official.name == WEIGHTS {
                check_weights(&target, checkpoint)?;
            }
            let identified_by = match (wanted.sha256.is_some(), fetched.hash_was_known) {
                (true, _) => IdentifiedBy::Catalogue,
                (false, true) => IdentifiedBy::Hub,
                (false, false) => IdentifiedBy::Nobody,
            };
            commit = commit.or(fetched.revision);
            let (name, bytes, sha256) = (official.name.to_owned(), fetched.bytes, fetched.sha256);
            files.push(RecordedFile { name, bytes, sha256, identified_by });
        }
        let commit = commit.or_else(|| pinned.then(|| checkpoint.revision.to_owned()));
        write_json(&folder.join(RECORD), &record_of(checkpoint, page, commit, &options.now, files))
    }

    /// Copies a checkpoint that the user has: `model.safetensors`, or a folder with it and `config.json`.
    ///
    /// The checkpoint is identified by its hash, else by `name`, else by its length if only one has that length.
    pub fn import(
        &self,
        path: &Path,
        name: Option<&'static Checkpoint>,
        options: &PullOptions,
        callbacks: &TransferCallbacks<'_>,
    ) -> Result<InstalledCheckpoint, HubError> {
        let weights = weights_in(path)?;
        let (bytes, sha256) = sha256_of(&weights, callbacks)?;
        let checkpoint = identify(&weights, name, bytes, &sha256)?;
        if let Some(acceptance) = &options.acceptance {
            self.accept(checkpoint, acceptance)?;
        }
        self.require_acceptance(checkpoint)?;
        check_weights(&weights, checkpoint)?;
        let folder = self.folder(checkpoint);
        make_folder(&folder)?;
        let _lock = Lock::take(&folder)?;
        copy(&weights, &folder.join(WEIGHTS), bytes, callbacks)?;
        let identified_by = match checkpoint.weights().sha256 {
            Some(_) => IdentifiedBy::Catalogue,
            None => IdentifiedBy::Nobody,
        };
        let config = import_config(&weights, &folder, checkpoint, callbacks)?;
        let weights_file = RecordedFile { name: WEIGHTS.to_owned(), bytes, sha256, identified_by };
        let source = weights.display().to_string();
        let record = record_of(checkpoint, source, None, &options.now, vec![config, weights_file]);
        write_json(&folder.join(RECORD), &record)?;
        self.installed(checkpoint)
    }

    fn installed(&self, checkpoint: &'static Checkpoint) -> Result<InstalledCheckpoint, HubError> {
        match self.find(checkpoint)? {
            Some(installed) if installed.location == CheckpointLocation::Store => Ok(installed),
            _ => Err(HubError::NotInstalled {
                name: checkpoint.name.to_owned(),
                looked: self.folder(checkpoint),
            }),
        }
    }
}

/// A revision is part of an address; only valid names of revisions are accepted.
fn checked_revision(revision: &str) -> Result<&str, HubError> {
    let fits = |c: char| c.is_ascii_alphanumeric() || "._-".contains(c);
    if !revision.is_empty() && revision.chars().all(fits) && !revision.starts_with('.') {
        return Ok(revision);
    }
    let expected = "a commit or the name of a branch";
    Err(HubError::BadSetting { name: "--revision", found: revision.to_owned(), expected })
}

fn weights_in(path: &Path) -> Result<PathBuf, HubError> {
    let weights = if path.is_dir() { path.join(WEIGHTS) } else { path.to_owned() };
    match fs::metadata(&weights) {
        Ok(m) if m.is_file() => Ok(weights),
        Ok(_) => Err(HubError::NotACheckpoint { path: weights, reason: "it is not a file".to_owned() }),
        Err(e) => Err(HubError::io("read", &weights)(e)),
    }
}

fn identify(
    weights: &Path,
    name: Option<&'static Checkpoint>,
    bytes: u64,
    sha256: &str,
) -> Result<&'static Checkpoint, HubError> {
    let what = || weights.display().to_string();
    let by_hash = of_hash(sha256);
    if let Some(named) = name {
        if let Some(expected) = named.weights().bytes.filter(|b| *b != bytes) {
            return Err(HubError::WrongSize { what: what(), found: bytes, expected });
        }
        return match named.weights().sha256 {
            Some(expected) if expected != sha256 => {
                let (found, expected) = (sha256.to_owned(), expected.to_owned());
                Err(HubError::WrongHash { what: what(), found, expected })
            }
            _ => Ok(named),
        };
    }
    if let Some(checkpoint) = by_hash {
        return Ok(checkpoint);
    }
    // Without a matching hash, it can only be a checkpoint whose hash is unknown.
    let mut candidates = of_size(bytes).filter(|c| c.weights().sha256.is_none());
    match (candidates.next(), candidates.next()) {
        (Some(only), None) => Ok(only),
        _ => {
            let known = CHECKPOINTS.iter().map(|c| c.name).collect::<Vec<_>>().join(", ");
            let reason = format!(
                "{bytes} bytes with SHA-256 {sha256} match none of {known}; other weights are used in place with \
                 --model-dir"
            );
            Err(HubError::NotACheckpoint { path: weights.to_owned(), reason })
        }
    }
}

/// Checks that the file is a complete safetensors file with the checkpoint's number of tensors.
fn check_weights(path: &Path, checkpoint: &Checkpoint) -> Result<(), HubError> {
    let Header { tensors, .. } = read_header(path)?;
    if tensors == checkpoint.tensors {
        return Ok(());
    }
    let reason = format!("{tensors} tensors, {} has {}", checkpoint.name, checkpoint.tensors);
    Err(HubError::NotACheckpoint { path: path.to_owned(), reason })
}

fn copy(from: &Path, to: &Path, bytes: u64, callbacks: &TransferCallbacks<'_>) -> Result<(), HubError> {
    callbacks.stop()?;
    if is_same(from, to) {
        return Ok(());
    }
    let folder = to.parent().unwrap_or(Path::new("."));
    if let Some(available) = crate::disk::free_bytes(folder).filter(|free| *free < bytes) {
        return Err(HubError::NoSpace { path: folder.to_owned(), available, needed: bytes });
    }
    let part = to.with_extension("import.part");
    let copied = fs::copy(from, &part).and_then(|_| fs::rename(&part, to));
    copied.map_err(|e| {
        // An incomplete copy; the first error is the one to report.
        let _ = fs::remove_file(&part);
        HubError::io("copy to", to)(e)
    })
}

fn is_same(a: &Path, b: &Path) -> bool {
    matches!((fs::canonicalize(a), fs::canonicalize(b)), (Ok(a), Ok(b)) if a == b)
}

/// The `config.json` next to the weights, if it is the official one; else one that names the architecture.
fn import_config(
    weights: &Path,
    folder: &Path,
    checkpoint: &Checkpoint,
    callbacks: &TransferCallbacks<'_>,
) -> Result<RecordedFile, HubError> {
    let target = folder.join(CONFIG);
    let official = &checkpoint.files[0];
    let beside = weights.with_file_name(CONFIG);
    if beside.is_file() {
        let (bytes, sha256) = sha256_of(&beside, callbacks)?;
        let fits = official.bytes.is_none_or(|b| b == bytes) && official.sha256.is_none_or(|h| h == sha256);
        if fits {
            copy(&beside, &target, bytes, callbacks)?;
            let identified_by = match official.sha256 {
                Some(_) => IdentifiedBy::Catalogue,
                None => IdentifiedBy::Nobody,
            };
            return Ok(RecordedFile { name: CONFIG.to_owned(), bytes, sha256, identified_by });
        }
        let what = beside.display().to_string();
        let expected = official.sha256.unwrap_or("another length").to_owned();
        return Err(HubError::WrongHash { what, found: sha256, expected });
    }
    fs::write(&target, minimal_config(checkpoint)).map_err(HubError::io("write", &target))?;
    let (bytes, sha256) = sha256_of(&target, callbacks)?;
    Ok(RecordedFile { name: CONFIG.to_owned(), bytes, sha256, identified_by: IdentifiedBy::Nobody })
}
