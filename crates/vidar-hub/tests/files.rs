//! Checkpoints on the disk: imported, found in the hub's cache, verified, corrupted.
#![allow(clippy::unwrap_used, clippy::panic)] // Helpers of tests may stop at the first surprise, as tests may.

use std::fs;
use std::path::{Path, PathBuf};
use vidar_hub::catalogue::{CONFIG, WEIGHTS};
use vidar_hub::{
    Checkpoint, CheckpointLocation, HubError, HubSettings, IdentifiedBy, Licence, OfficialFile, PullOptions,
    Store, TransferCallbacks, catalogue,
};

fn weights(value: u8) -> Vec<u8> {
    let header = br#"{"w":{"dtype":"U8","shape":[1000],"data_offsets":[0,1000]}}"#;
    [&(header.len() as u64).to_le_bytes()[..], header, &[value; 1000]].concat()
}

fn checkpoint() -> &'static Checkpoint {
    let hash: String = vidar_hub::sha256_hex(&weights(1));
    Box::leak(Box::new(Checkpoint {
        name: "tiny",
        repo: "maker/TINY",
        revision: "0123456789abcdef0123456789abcdef01234567",
        architecture: "da3-small",
        licence: Licence::Apache2,
        parameters: 1,
        tensors: 1,
        files: [
            OfficialFile { name: CONFIG, bytes: None, sha256: None },
            OfficialFile { name: WEIGHTS, bytes: Some(weights(1).len() as u64), sha256: Some(hash.leak()) },
        ],
        abilities: &[],
        note: "",
    }))
}

fn bench() -> (tempfile::TempDir, Store) {
    let folder = tempfile::tempdir().unwrap();
    let settings = HubSettings {
        offline: true,
        hub_cache: Some(folder.path().join("cache")),
        ..HubSettings::new(folder.path().join("models"))
    };
    (folder, Store::new(settings))
}

fn quiet() -> TransferCallbacks<'static> {
    TransferCallbacks { progress: &|_| {}, cancel: &|| false }
}

fn write(path: PathBuf, bytes: &[u8]) -> PathBuf {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    fs::write(&path, bytes).unwrap();
    path
}

fn import(store: &Store, path: &Path) -> Result<vidar_hub::InstalledCheckpoint, HubError> {
    store.import(path, Some(checkpoint()), &PullOptions::default(), &quiet())
}

#[test]
fn a_file_and_a_folder_are_imported_and_verified() {
    let (folder, store) = bench();
    let file = write(folder.path().join("mine/any name.safetensors"), &weights(1));
    let installed = import(&store, &file).unwrap();
    assert_eq!(fs::read(installed.weights()).unwrap(), weights(1));
    let config = fs::read_to_string(installed.folder.join(CONFIG)).unwrap();
    assert!(config.contains("\"model_name\": \"da3-small\""), "{config}");
    assert_eq!(installed.location, CheckpointLocation::Store);
    let verified = store.verify(checkpoint(), &quiet()).unwrap();
    assert_eq!(
        verified.iter().map(|v| v.identified_by).collect::<Vec<_>>(),
        [IdentifiedBy::Nobody, IdentifiedBy::Catalogue]
    );
    // The whole folder, with its own config.json; and once more from where it already is.
    write(folder.path().join("whole").join(WEIGHTS), &weights(1));
    write(folder.path().join("whole").join(CONFIG), b"{\"model_name\": \"x\"}");
    let installed = import(&store, &folder.path().join("whole")).unwrap();
    assert!(fs::read_to_string(installed.folder.join(CONFIG)).unwrap().contains("\"x\""));
    import(&store, &installed.folder).unwrap();
    store.verify(checkpoint(), &quiet()).unwrap();
}

#[test]
fn files_of_another_checkpoint_are_not_imported() {
    let (folder, store) = bench();
    let other = write(folder.path().join("other"), &weights(2));
    assert!(matches!(import(&store, &other).unwrap_err(), HubError::WrongHash { .. }));
    let short = write(folder.path().join("short"), &weights(1)[..500]);
    assert!(matches!(import(&store, &short).unwrap_err(), HubError::WrongSize { found: 500, .. }));
    assert!(matches!(import(&store, &folder.path().join("none")).unwrap_err(), HubError::Io { .. }));
    assert!(matches!(import(&store, folder.path()).unwrap_err(), HubError::Io { .. }), "no weights in it");
    let named = store.import(&other, None, &PullOptions::default(), &quiet()).unwrap_err();
    assert!(named.to_string().contains("--model-dir"), "{named}");
    assert!(!store.settings().root.exists(), "a refused import left something");
}

#[test]
fn the_cache_of_the_hubs_programs_is_read_and_not_written() {
    let (folder, store) = bench();
    assert!(matches!(store.require(checkpoint()).unwrap_err(), HubError::NotInstalled { .. }));
    let repository = folder.path().join("cache/models--maker--TINY");
    write(repository.join("snapshots/aaaa").join(WEIGHTS), &weights(1)[..10]);
    write(repository.join("snapshots/aaaa").join(CONFIG), b"{}");
    assert!(store.find(checkpoint()).unwrap().is_none(), "an incomplete snapshot was accepted");
    write(repository.join("snapshots/bbbb").join(WEIGHTS), &weights(1));
    write(repository.join("snapshots/bbbb").join(CONFIG), b"{}");
    let found = store.require(checkpoint()).unwrap();
    assert_eq!(
        (found.location, found.folder),
        (CheckpointLocation::HubCache, repository.join("snapshots/bbbb"))
    );
    write(repository.join("snapshots/cccc").join(WEIGHTS), &weights(1));
    write(repository.join("snapshots/cccc").join(CONFIG), b"{}");
    write(repository.join("refs/main"), b"cccc\n");
    assert!(store.require(checkpoint()).unwrap().folder.ends_with("cccc"));
    store.verify(checkpoint(), &quiet()).unwrap();
    assert!(!store.settings().root.exists());
}

#[test]
fn a_corrupted_checkpoint_is_detected() {
    let (folder, store) = bench();
    let installed = import(&store, &write(folder.path().join("w"), &weights(1))).unwrap();
    let mut rotten = weights(1);
    rotten[700] ^= 4;
    fs::write(installed.weights(), rotten).unwrap();
    assert!(matches!(store.verify(checkpoint(), &quiet()).unwrap_err(), HubError::WrongHash { .. }));
    let stop = TransferCallbacks { progress: &|_| {}, cancel: &|| true };
    assert!(matches!(store.verify(checkpoint(), &stop).unwrap_err(), HubError::Cancelled));
    fs::write(installed.weights(), &weights(1)[..20]).unwrap();
    assert!(matches!(store.verify(checkpoint(), &quiet()).unwrap_err(), HubError::NotInstalled { .. }));
}

#[test]
fn a_damaged_record_is_reported_and_never_panics() {
    let (folder, store) = bench();
    let installed = import(&store, &write(folder.path().join("w"), &weights(1))).unwrap();
    let record = installed.folder.join("vidar-model.json");
    let good = fs::read(&record).unwrap();
    for n in (0..good.len()).step_by(3) {
        // Cut off anywhere, and one byte turned over anywhere.
        for bytes in [good[..n].to_vec(), [&good[..n], &[good[n] ^ 0x55], &good[n + 1..]].concat()] {
            fs::write(&record, bytes).unwrap();
            if let Err(error) = store.find(checkpoint()) {
                assert!(matches!(error, HubError::BadRecord { .. }), "{error}");
            }
        }
    }
    fs::write(&record, vec![b'['; 2 << 20]).unwrap();
    assert!(matches!(store.find(checkpoint()).unwrap_err(), HubError::BadRecord { .. }));
    fs::write(&record, "[".repeat(100_000)).unwrap();
    assert!(matches!(store.find(checkpoint()).unwrap_err(), HubError::BadRecord { .. }));
    fs::write(&record, &good).unwrap();
    fs::write(installed.folder.join("acceptance.json"), b"{}").unwrap();
    let error = store.find(checkpoint()).unwrap_err();
    assert!(matches!(error, HubError::BadRecord { .. }) && error.hint().is_some(), "{error}");
}

#[test]
fn every_official_checkpoint_is_listed() {
    let (_folder, store) = bench();
    let listed = store.list().unwrap();
    assert_eq!(listed.len(), catalogue::CHECKPOINTS.len());
    assert!(listed.iter().all(|(_, installed)| installed.is_none()));
}
