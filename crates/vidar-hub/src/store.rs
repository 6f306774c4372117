//! Checkpoints on this machine.
//!
//! ```text
//! $VIDAR_MODELS/
//!   da3-small/
//!     config.json  model.safetensors    as on the hub
//!     vidar-model.json                  source, lengths, SHA-256
//!     acceptance.json                   who accepted a non-commercial licence, when, and which text
//! ```
//!
//! If a checkpoint is missing there, the cache of the hub's official programs is searched
//! (`models--depth-anything--DA3-SMALL/snapshots/…`). That cache is never written.

use crate::catalogue::{CHECKPOINTS, CONFIG, Checkpoint, OfficialFile, WEIGHTS};
use crate::digest::sha256_of;
use crate::error::HubError;
use crate::licence::Licence;
use crate::progress::TransferCallbacks;
use crate::record::{ACCEPTANCE, Acceptance, IdentifiedBy, RECORD, RECORD_SCHEMA, Record};
use crate::settings::HubSettings;
use serde::{Serialize, de::DeserializeOwned};
use std::fs;
use std::io::{ErrorKind, Read, Write};
use std::path::{Path, PathBuf};

/// Largest JSON file next to weights, bytes.
const MOST_JSON: u64 = 1 << 20;

/// Where the files of a checkpoint are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum CheckpointLocation {
    /// In the store of this program.
    Store,
    /// In the cache of the hub's official programs.
    HubCache,
}

/// A checkpoint that is on this machine.
#[derive(Clone, Debug)]
pub struct InstalledCheckpoint {
    /// Which one.
    pub checkpoint: &'static Checkpoint,
    /// The folder of its files.
    pub folder: PathBuf,
    /// Whether the folder is in the store or in the cache.
    pub location: CheckpointLocation,
    /// Its record; only in the store.
    pub record: Option<Record>,
    /// The acceptance of its licence, if one is needed and recorded.
    pub acceptance: Option<Acceptance>,
}

impl InstalledCheckpoint {
    /// The file of weights.
    pub fn weights(&self) -> PathBuf {
        self.folder.join(WEIGHTS)
    }

    /// SHA-256 of the weights as recorded when they were added.
    pub fn recorded_sha256(&self) -> Option<&str> {
        let files = &self.record.as_ref()?.files;
        files.iter().find(|f| f.name == WEIGHTS).map(|f| f.sha256.as_str())
    }
}

/// A verified file.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct VerifiedFile {
    /// Which file.
    pub name: String,
    /// Its length.
    pub bytes: u64,
    /// Its SHA-256.
    pub sha256: String,
    /// The source of the expected hash.
    pub identified_by: IdentifiedBy,
}

/// The checkpoints of this machine.
#[derive(Clone, Debug)]
pub struct Store {
    settings: HubSettings,
}

impl Store {
    /// The store that the settings describe.
    pub fn new(settings: HubSettings) -> Self {
        Self { settings }
    }

    /// Its settings.
    pub fn settings(&self) -> &HubSettings {
        &self.settings
    }

    /// The folder of a checkpoint, whether it exists or not.
    pub fn folder(&self, checkpoint: &Checkpoint) -> PathBuf {
        self.settings.root.join(checkpoint.name)
    }

    /// The checkpoint, if all of its files are present; `None` otherwise. Lengths are checked, hashes are not.
    pub fn find(&self, checkpoint: &'static Checkpoint) -> Result<Option<InstalledCheckpoint>, HubError> {
        let folder = self.folder(checkpoint);
        let acceptance = self.acceptance(checkpoint)?;
        if is_complete(&folder, checkpoint) {
            let record = read_record(&folder, checkpoint)?;
            return Ok(Some(InstalledCheckpoint {
                checkpoint,
                folder,
                location: CheckpointLocation::Store,
                record,
                acceptance,
            }));
        }
        let cached = self.settings.hub_cache.as_ref().and_then(|cache| in_hub_cache(cache, checkpoint));
        Ok(cached.map(|folder| InstalledCheckpoint {
            checkpoint,
            folder,
            location: CheckpointLocation::HubCache,
            record: None,
            acceptance,
        }))
    }

    /// The checkpoint, ready to be used: present, and its licence accepted if needed.
    pub fn require(&self, checkpoint: &'static Checkpoint) -> Result<InstalledCheckpoint, HubError> {
        let Some(installed) = self.find(checkpoint)? else {
            let (name, looked) = (checkpoint.name.to_owned(), self.folder(checkpoint));
            return Err(HubError::NotInstalled { name, looked });
        };
        self.require_acceptance(checkpoint)?;
        Ok(installed)
    }

    /// The acceptance of the checkpoint's licence, if there is one.
    pub fn acceptance(&self, checkpoint: &Checkpoint) -> Result<Option<Acceptance>, HubError> {
        let path = self.folder(checkpoint).join(ACCEPTANCE);
        let read: Option<Acceptance> = read_json(&path)?;
        match read {
            Some(acceptance) if !acceptance.is_of(checkpoint) => {
                let reason =
                    format!("it is not an acceptance of {} for {}", checkpoint.licence, checkpoint.name);
                Err(HubError::BadRecord { path, reason })
            }
            other => Ok(other),
        }
    }

    /// An error unless the licence allows every use or was accepted.
    pub fn require_acceptance(&self, checkpoint: &Checkpoint) -> Result<Option<Acceptance>, HubError> {
        let acceptance = self.acceptance(checkpoint)?;
        if acceptance.is_none() && !checkpoint.licence.allows_commercial_use() {
            let (name, licence) = (checkpoint.name.to_owned(), checkpoint.licence);
            return Err(HubError::LicenceNotAccepted { name, licence });
        }
        Ok(acceptance)
    }

    /// Records an acceptance next to the weights.
    pub fn accept(&self, checkpoint: &Checkpoint, acceptance: &Acceptance) -> Result<(), HubError> {
        if !acceptance.is_of(checkpoint) {
            let (name, licence) = (checkpoint.name.to_owned(), checkpoint.licence);
            return Err(HubError::WrongLicence { name, licence, given: acceptance.licence.clone() });
        }
        let folder = self.folder(checkpoint);
        make_folder(&folder)?;
        write_json(&folder.join(ACCEPTANCE), acceptance)
    }

    /// Every official checkpoint, with its installation if it is present.
    pub fn list(&self) -> Result<Vec<(&'static Checkpoint, Option<InstalledCheckpoint>)>, HubError> {
        CHECKPOINTS.iter().map(|c| Ok((c, self.find(c)?))).collect()
    }

    /// Reads every byte of a checkpoint and compares lengths and hashes with catalogue and record.
    pub fn verify(
        &self,
        checkpoint: &'static Checkpoint,
        callbacks: &TransferCallbacks<'_>,
    ) -> Result<Vec<VerifiedFile>, HubError> {
        let Some(installed) = self.find(checkpoint)? else {
            let (name, looked) = (checkpoint.name.to_owned(), self.folder(checkpoint));
            return Err(HubError::NotInstalled { name, looked });
        };
        let recorded = |name: &str| {
            let files = installed.record.as_ref().map(|r| r.files.as_slice()).unwrap_or_default();
            files.iter().find(|f| f.name == name)
        };
        let mut verified = Vec::new();
        for official in &checkpoint.files {
            let path = installed.folder.join(official.name);
            let (bytes, sha256) = sha256_of(&path, callbacks)?;
            let what = || path.display().to_string();
            let record = recorded(official.name);
            // Another commit, or a generated config.json: only the record has the expected hashes.
            let own = record.is_some_and(|r| r.identified_by != IdentifiedBy::Catalogue);
            let official =
                if own { OfficialFile { bytes: None, sha256: None, ..*official } } else { *official };
            for expected in [official.bytes, record.map(|r| r.bytes)].into_iter().flatten() {
                if expected != bytes {
                    return Err(HubError::WrongSize { what: what(), found: bytes, expected });
                }
            }
            for expected in [official.sha256, record.map(|r| r.sha256.as_str())].into_iter().flatten() {
                if expected != sha256 {
                    let expected = expected.to_owned();
                    return Err(HubError::WrongHash { what: what(), found: sha256, expected });
                }
            }
            let identified_by = match (official.sha256, record) {
                (Some(_), _) => IdentifiedBy::Catalogue,
                (None, Some(record)) => record.identified_by,
                (None, None) => IdentifiedBy::Nobody,
            };
            verified.push(VerifiedFile { name: official.name.to_owned(), bytes, sha256, identified_by });
        }
        Ok(verified)
    }
}

/// Whether every file is present, the weights with the right length. The length of `config.json` is not checked, because
/// weights without one get a generated file.
fn is_complete(folder: &Path, checkpoint: &Checkpoint) -> bool {
    let length =
        |name: &str| fs::metadata(folder.join(name)).ok().filter(fs::Metadata::is_file).map(|m| m.len());
    let weights = length(WEIGHTS).is_some_and(|n| checkpoint.weights().bytes.is_none_or(|bytes| bytes == n));
    weights && length(CONFIG).is_some_and(|n| n <= MOST_JSON)
}

/// The newest complete snapshot in the cache of the hub's official programs.
fn in_hub_cache(cache: &Path, checkpoint: &Checkpoint) -> Option<PathBuf> {
    let repository = cache.join(format!("models--{}", checkpoint.repo.replace('/', "--")));
    let snapshots = repository.join("snapshots");
    let main = fs::read_to_string(repository.join("refs").join("main")).unwrap_or_default();
    let named = [checkpoint.revision, main.trim()].map(|revision| snapshots.join(revision));
    let mut others: Vec<PathBuf> = fs::read_dir(&snapshots).ok()?.flatten().map(|e| e.path()).collect();
    others.sort();
    // An empty name gives `snapshots` itself, which contains no files.
    named.into_iter().chain(others).find(|folder| *folder != snapshots && is_complete(folder, checkpoint))
}

/// The record of a folder, if there is one for that checkpoint.
fn read_record(folder: &Path, checkpoint: &Checkpoint) -> Result<Option<Record>, HubError> {
    let path = folder.join(RECORD);
    let record: Option<Record> = read_json(&path)?;
    match record {
        Some(r) if r.schema != RECORD_SCHEMA || r.name != checkpoint.name => {
            let reason =
                format!("it describes {:?} ({:?}), expected {:?}", r.name, r.schema, checkpoint.name);
            Err(HubError::BadRecord { path, reason })
        }
        other => Ok(other),
    }
}

fn read_json<T: DeserializeOwned>(path: &Path) -> Result<Option<T>, HubError> {
    let file = match fs::File::open(path) {
        Ok(file) => file,
        Err(e) if e.kind() == ErrorKind::NotFound => return Ok(None),
        Err(e) => return Err(HubError::io("read", path)(e)),
    };
    let mut bytes = Vec::new();
    file.take(MOST_JSON + 1).read_to_end(&mut bytes).map_err(HubError::io("read", path))?;
    let bad = |reason: String| HubError::BadRecord { path: path.to_owned(), reason };
    if bytes.len() as u64 > MOST_JSON {
        return Err(bad(format!("longer than {MOST_JSON} bytes")));
    }
    serde_json::from_slice(&bytes).map(Some).map_err(|e| bad(e.to_string()))
}

/// Writes JSON to a temporary file and renames it to `path`, so that the file is never incomplete.
pub(crate) fn write_json(path: &Path, value: &impl Serialize) -> Result<(), HubError> {
    let bad = |e: serde_json::Error| HubError::BadRecord { path: path.to_owned(), reason: e.to_string() };
    let mut bytes = serde_json::to_vec_pretty(value).map_err(bad)?;
    bytes.push(b'\n');
    let part = path.with_extension("json.part");
    let written = fs::File::create(&part)
        .and_then(|mut file| file.write_all(&bytes).and_then(|()| file.sync_all()))
        .and_then(|()| fs::rename(&part, path));
    written.map_err(HubError::io("write", path))
}

pub(crate) fn make_folder(folder: &Path) -> Result<(), HubError> {
    fs::create_dir_all(folder).map_err(HubError::io("create", folder))
}

/// The `config.json` that names an architecture, for weights that came without one.
pub(crate) fn minimal_config(checkpoint: &Checkpoint) -> String {
    format!("{{\"model_name\": {:?}}}\n", checkpoint.architecture)
}

/// The licence of the official checkpoint whose weights have the length of those in `folder`.
///
/// Fine-tuned weights have the length, and mostly the licence, of the official ones.
pub fn official_licence(folder: &Path) -> Option<Licence> {
    let bytes = fs::metadata(folder.join(WEIGHTS)).ok()?.len();
    crate::catalogue::of_size(bytes).map(|c| c.licence).next()
}
