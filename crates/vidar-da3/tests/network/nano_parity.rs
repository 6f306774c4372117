//! Parity with the training code (`training/nano/golden.py`): the shipped network.

use std::path::{Path, PathBuf};
use vidar_da3::check::{CheckReport, check_file};
use vidar_da3::config::{Networks, json};
use vidar_da3::{Da3Options, Precision};

/// Largest difference over the deviation of the tensor.
const ALLOWED: f64 = 1e-3;

fn golden(file: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/nano").join(file)
}

/// The shipped network as a folder, like those of the official ones.
fn shipped() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("model.safetensors"), vidar_da3_nano::WEIGHTS).unwrap();
    std::fs::write(folder.path().join("config.json"), vidar_da3_nano::CONFIG).unwrap();
    folder
}

fn exact() -> Da3Options {
    Da3Options { precision: Precision::F32, ..Da3Options::default() }
}

fn assert_agrees(report: &CheckReport) {
    let names: Vec<&str> = report.rows.iter().map(|r| r.tensor.as_str()).collect();
    for name in ["block11", "feat3", "head.layer4_rn", "out.depth", "out.depth_conf", "out.ray", "pose_enc"] {
        assert!(names.contains(&name), "{name} is not in {names:?}");
    }
    for row in &report.rows {
        let ratio = row.max_difference / row.deviation;
        assert!(ratio <= ALLOWED, "{}: {ratio:.1e} of its deviation\n{report}", row.tensor);
    }
    eprintln!("{}: worst {:.1e}", report.file.display(), report.worst().unwrap().ratio());
}

#[test]
fn the_shipped_network_agrees_with_the_training_code() {
    let shipped = shipped();
    for file in ["trained_free_v3.safetensors", "trained_posed_v4.safetensors"] {
        assert_agrees(&check_file(&golden(file), Some(shipped.path()), &exact()).unwrap());
    }
}

#[test]
fn the_description_that_the_training_code_writes_is_an_any_view_network() {
    let manifest = std::fs::read_to_string(golden("manifest.json")).unwrap();
    let manifest: serde_json::Value = serde_json::from_str(&manifest).unwrap();
    let text = manifest["files"]["trained_free_v3.safetensors"]["config"].to_string();
    let config = json::parse(&text, "nano").unwrap();
    let Networks::Single(net) = &config.networks else { panic!("{config:?}") };
    assert_eq!((config.name.as_str(), config.variant), ("da3-nano", None));
    assert!(net.is_any_view() && net.camera_encoder.is_some() && net.camera_decoder);
    assert_eq!((net.backbone.dim, net.backbone.depth, net.backbone.heads), (192, 12, 3));
}
