//! The store on a local folder.

use super::*;

fn store() -> (tempfile::TempDir, Store) {
    let base = tempfile::tempdir().unwrap();
    // Spaces and letters of any script in the path.
    let store = Store::create(base.path().join("my store 測試").to_str().unwrap()).unwrap();
    (base, store)
}

#[test]
fn large_files_go_through_in_parts_and_come_back_the_same() {
    let (base, store) = store();
    for size in [0, 1, PART_BYTES - 1, PART_BYTES, 2 * PART_BYTES + 12_345] {
        let bytes: Vec<u8> = (0..size).map(|i| (i * 31 % 251) as u8).collect();
        let (file, back) = (base.path().join("file"), base.path().join("back"));
        std::fs::write(&file, &bytes).unwrap();
        assert_eq!(store.put_file("maps/a/mesh.ply", &file).unwrap(), size as u64);
        assert_eq!(store.get_file("maps/a/mesh.ply", &back).unwrap(), size as u64);
        assert!(std::fs::read(&back).unwrap() == bytes, "{size}");
    }
    assert_eq!(store.traffic().read, store.traffic().written);
    assert_eq!(store.list("maps").unwrap(), ["maps/a/mesh.ply"]);
}

#[test]
fn what_is_larger_than_allowed_is_not_read() {
    let (_base, store) = store();
    store.put("plan.json", vec![b'x'; 1000]).unwrap();
    let error = store.get("plan.json", 999).unwrap_err().to_string();
    assert!(error.contains("1000 bytes") && error.contains("999"), "{error}");
    assert_eq!(store.get("plan.json", 1000).unwrap().unwrap().len(), 1000);
}

#[test]
fn no_name_leads_out_of_the_store() {
    let (base, store) = store();
    std::fs::write(base.path().join("secret"), "x").unwrap();
    for name in ["../secret", "a/../../secret", "/etc/passwd/", "a//b", "."] {
        assert!(!matches!(store.get(name, 100), Ok(Some(_))), "{name}");
        let _ = store.put(name, b"y".to_vec());
    }
    assert_eq!(std::fs::read(base.path().join("secret")).unwrap(), b"x");
}

#[test]
fn addresses_that_name_no_store_are_refused_with_what_to_write() {
    for (uri, word) in [("", "empty"), ("ftp://host/x", "s3://bucket"), ("file://relative", "file:///")] {
        let error = Store::open(uri).unwrap_err().to_string();
        assert!(error.contains(word), "{error}");
    }
}

#[test]
fn a_store_that_cannot_be_written_names_the_systems_reason() {
    let base = tempfile::tempdir().unwrap();
    let file = base.path().join("file");
    std::fs::write(&file, "x").unwrap();
    let missing = Store::open(base.path().join("none").to_str().unwrap()).unwrap_err();
    assert!(missing.io().is_some() && !base.path().join("none").exists(), "{missing}");
    let error = Store::create(file.join("store").to_str().unwrap()).unwrap_err();
    assert!(error.io().is_some(), "{error}");
    let (_base, store) = store();
    store.put("a", b"1".to_vec()).unwrap();
    let error = store.put("a/b", b"2".to_vec()).unwrap_err();
    assert!(error.io().is_some(), "{error}: {error:?}");
    assert_eq!(store.get("a", 10).unwrap().unwrap(), b"1");
}
