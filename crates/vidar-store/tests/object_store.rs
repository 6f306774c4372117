//! A store that speaks S3 does what a folder does.
#![cfg(feature = "s3")]

use vidar_store::Store;

/// More than two parts of a file that is sent in parts.
const PARTS_BYTES: usize = 2 * 8 * 1024 * 1024 + 12_345;

/// Against a server that speaks S3: `VIDAR_TEST_S3=s3://bucket/prefix`, with its endpoint and keys in `AWS_…`.
#[test]
fn an_object_store_does_what_a_folder_does() {
    let Ok(uri) = std::env::var("VIDAR_TEST_S3") else {
        return vidar_core::testing::skipped(&"VIDAR_TEST_S3 names no bucket");
    };
    let (store, base) = (Store::open(&uri).unwrap(), tempfile::tempdir().unwrap());
    assert!(store.get("records/none.json", 10).unwrap().is_none());
    store.put("records/a.json", b"{}".to_vec()).unwrap();
    assert_eq!(store.get("records/a.json", 10).unwrap().unwrap(), b"{}");
    assert!(store.get("records/a.json", 1).is_err());
    let bytes: Vec<u8> = (0..PARTS_BYTES).map(|i| (i * 31 % 251) as u8).collect();
    let (file, back) = (base.path().join("file"), base.path().join("back"));
    std::fs::write(&file, &bytes).unwrap();
    store.put_file("maps/a/mesh.ply", &file).unwrap();
    assert_eq!(store.get_file("maps/a/mesh.ply", &back).unwrap(), bytes.len() as u64);
    assert!(std::fs::read(&back).unwrap() == bytes);
    assert_eq!(store.list("maps").unwrap(), ["maps/a/mesh.ply"]);
}
