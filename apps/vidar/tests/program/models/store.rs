//! `vidar model`: the checkpoints of this machine, and fetching others.

use super::{bench, read_json, text};
use crate::support::{ProgramOutput, command, http_server, keys};
use serde_json::json;
use std::path::Path;
use std::process::Command;

/// The program with a store and a hub cache of its own, and no network.
pub(super) fn command_with_store(root: &Path) -> Command {
    let mut command = command();
    command
        .current_dir(root)
        .env("VIDAR_MODELS", root.join("models"))
        .env("HF_HUB_CACHE", root.join("cache"));
    for name in
        ["HF_ENDPOINT", "HF_TOKEN", "HF_HUB_OFFLINE", "HTTP_PROXY", "http_proxy", "ALL_PROXY", "all_proxy"]
    {
        command.env_remove(name);
    }
    command
}

/// A hub that has only small files: `config.json` of DA3-SMALL's name, and nothing else.
fn hub() -> String {
    http_server(|first| {
        let status = if first.contains("GATED") || first.contains("LARGE") { 403 } else { 404 };
        format!("HTTP/1.1 {status} X\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
    })
}

#[test]
fn models_are_listed_with_licence_size_and_abilities() {
    let folder = tempfile::tempdir().unwrap();
    let run = |args: &[&str]| -> ProgramOutput {
        command_with_store(folder.path()).args(args).output().unwrap().into()
    };
    let ran = run(&["model", "list"]).ends_with(0);
    for word in [
        "da3-small",
        "Apache-2.0",
        "CC-BY-NC-4.0 (no commercial use)",
        "130.9 MiB",
        "cameras",
        "metric depth",
    ] {
        assert!(ran.stdout.contains(word), "{word:?} is missing in\n{}", ran.stdout);
    }
    let json = run(&["model", "list", "--json"]).ends_with(0).json();
    assert_eq!(json["schema"], "vidar.models/1");
    let models = json["models"].as_array().unwrap();
    assert_eq!(models.len(), 11);
    assert_eq!(
        keys(&models[0], 1),
        [
            "name",
            "repository",
            "licence",
            "commercial_use",
            "parameters",
            "bytes",
            "sha256",
            "abilities",
            "note",
            "installed",
            "location"
        ]
    );
    assert_eq!((&models[0]["name"], &models[0]["location"]), (&json!("da3-nano"), &json!("program")));
    assert!(models.iter().all(|m| keys(m, 1) == keys(&models[0], 1)));
    assert!(models[1..].iter().all(|m| m["installed"].is_null()));
    let ran = run(&["model", "where"]).ends_with(0);
    assert_eq!(ran.stdout.trim(), text(&folder.path().join("models")));
    run(&["model", "where", "da3-small"]).ends_with(4).says(&["error[E0403]", "vidar model pull da3-small"]);
    run(&["demo", "--model", "da3-small", "-q"]).ends_with(4).says(&["error[E0403]"]);
    assert!(!folder.path().join("runs").exists(), "reported before anything was rendered");
    run(&["model", "verify"]).ends_with(0);
    run(&["model", "verify", "da3-small"]).ends_with(4);
    for verb in ["where", "verify", "pull"] {
        let ran = run(&["model", verb, "da3-nano"]).ends_with(0);
        assert!(ran.stdout.contains("built into the program"), "{}", ran.stdout);
        assert_eq!(run(&["model", verb, "da3-nano", "--json"]).ends_with(0).json()["location"], "program");
    }
    run(&["model", "pull", "da3-huge"]).ends_with(2).says(&["error[E0105]", "da3-small"]);
}

#[test]
fn the_built_in_network_needs_no_download_and_warns_of_its_limits() {
    let b = bench();
    let out = b.root.join("nano");
    let args = ["depth", text(&b.images), "--model", "da3-nano", "-o", text(&out), "-q"];
    let mut command = command_with_store(&b.root);
    let ran: ProgramOutput = command.args(args).output().unwrap().into();
    ran.ends_with(0).says(&["small-network", "vidar model pull da3-small"]);
    let manifest = read_json(&out.join("manifest.json"));
    let model = &manifest["model"];
    assert_eq!((&model["name"], &model["licence"]), (&json!("da3-nano"), &json!("MIT OR Apache-2.0")));
    assert_eq!(model["weights_sha256"].as_str().map(str::len), Some(64));
    assert_eq!(read_json(&out.join("predictions.json"))["width"], 280, "the training size of da3-nano");
}

#[test]
fn pulling_uses_the_mirror_needs_acceptance_and_respects_offline() {
    let folder = tempfile::tempdir().unwrap();
    let hub = hub();
    let run = |args: &[&str]| -> ProgramOutput {
        command_with_store(folder.path()).env("HF_ENDPOINT", &hub).args(args).output().unwrap().into()
    };
    let ran = run(&["model", "pull", "da3-small", "-q"]).ends_with(4);
    let ran = ran.says(&["error[E0403]", "status 404", "depth-anything/DA3-SMALL/resolve/"]);
    assert!(ran.stderr.contains(&hub), "{}", ran.stderr);
    run(&["model", "pull", "da3-large-1.1", "-q"]).ends_with(4).says(&[
        "error[E0404]",
        "--accept-licence CC-BY-NC-4.0",
        "legalcode",
    ]);
    run(&["model", "pull", "da3-large-1.1", "-q", "--accept-licence", "MIT"])
        .ends_with(2)
        .says(&["CC-BY-NC-4.0"]);
    let acceptance = folder.path().join("models/da3-large-1.1/acceptance.json");
    assert!(!acceptance.exists());
    let accepting = [
        "model",
        "pull",
        "da3-large-1.1",
        "-q",
        "--accept-licence",
        "CC-BY-NC-4.0",
        "--accepted-by",
        "A. Person",
    ];
    run(&accepting).ends_with(4).says(&["error[E0403]", "status 403", "HF_TOKEN"]);
    let written = read_json(&acceptance);
    assert_eq!((&written["accepted_by"], &written["model"]), (&json!("A. Person"), &json!("da3-large-1.1")));
    run(&["model", "pull", "da3-base", "--offline", "-q"]).ends_with(4).says(&["network use is disabled"]);
}

#[test]
fn other_files_than_official_checkpoints_are_not_imported() {
    let folder = tempfile::tempdir().unwrap();
    let b = bench();
    let run = |args: &[&str]| -> ProgramOutput {
        command_with_store(folder.path()).args(args).output().unwrap().into()
    };
    run(&["model", "import", text(&b.model), "-q"]).ends_with(4).says(&["error[E0405]", "--model-dir"]);
    run(&["model", "import", text(&b.model), "--model", "da3-small", "-q"])
        .ends_with(4)
        .says(&["error[E0405]", "expected 137248940"]);
    run(&["model", "import", "nothing.safetensors", "-q"]).ends_with(4).says(&["error[E0401]"]);
    assert!(!folder.path().join("models").exists());
}
