//! What the tests of this folder share.

#![allow(dead_code)] // each test file uses a part
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::print_stderr)] // helpers of tests

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use vidar_da3::config::json;
use vidar_da3::weights::inventory::{Parameter, parameters};
use vidar_da3::weights::synthetic::tensor;
use vidar_da3::{Da3, Da3Config, Da3Options};

/// A file of the repository's own reference material.
pub fn own(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name)
}

/// The description of a tiny network, as `config.json` has it.
pub fn tiny_json(file: &str) -> String {
    let manifest = std::fs::read_to_string(own("manifest.json")).unwrap();
    let manifest: serde_json::Value = serde_json::from_str(&manifest).unwrap();
    manifest["files"][file]["config"].to_string()
}

pub fn tiny_config() -> Da3Config {
    json::parse(&tiny_json("tiny_free_v3.safetensors"), "tiny").unwrap()
}

pub fn tiny() -> Da3 {
    Da3::synthetic_of(tiny_config(), &Da3Options::default()).unwrap()
}

/// All tensors of a network with synthetic weights.
pub fn tensors(config: &Da3Config) -> BTreeMap<String, (Vec<usize>, Vec<f32>)> {
    let made = |p: Parameter| (p.name.clone(), (p.shape.clone(), tensor(&p.name, &p.shape)));
    parameters(config).into_iter().map(made).collect()
}

/// Writes `model.safetensors`.
pub fn write_safetensors(path: &Path, tensors: &BTreeMap<String, (Vec<usize>, Vec<f32>)>) {
    let (mut header, mut blob) = (serde_json::Map::new(), Vec::new());
    for (name, (shape, values)) in tensors {
        let start = blob.len();
        blob.extend(values.iter().flat_map(|v| v.to_le_bytes()));
        let entry = serde_json::json!({"dtype": "F32", "shape": shape, "data_offsets": [start, blob.len()]});
        header.insert(name.clone(), entry);
    }
    let mut text = serde_json::to_vec(&header).unwrap();
    text.resize(text.len().next_multiple_of(8), b' ');
    let mut bytes = (text.len() as u64).to_le_bytes().to_vec();
    bytes.extend(text);
    bytes.extend(blob);
    std::fs::write(path, bytes).unwrap();
}

/// A folder with a tiny model as it would lie on the hub.
pub fn tiny_folder() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    write_safetensors(&folder.path().join("model.safetensors"), &tensors(&tiny_config()));
    std::fs::write(folder.path().join("config.json"), tiny_json("tiny_free_v3.safetensors")).unwrap();
    folder
}
