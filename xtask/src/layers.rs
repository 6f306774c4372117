//! Checks the layers: dependencies point down only, and stage crates do not depend on each other (ARCHITECTURE.md).

use anyhow::Result;
use cargo_metadata::{DependencyKind, MetadataCommand};
use std::path::Path;

/// Each crate with the crates of the workspace that it may depend on.
const LAYERS: &[(&str, &[&str])] = &[
    ("vidar-core", &[]),
    ("vidar-nn", &[]),
    ("vidar-gpu", &[]),
    ("vidar-hub", &[]),
    ("vidar-store", &[]),
    ("vidar-da3-nano-second-half", &[]),
    ("vidar-da3-nano", &["vidar-da3-nano-second-half"]),
    ("vidar-solve", &["vidar-core"]),
    ("vidar-bag", &["vidar-core"]),
    ("vidar-video", &["vidar-core"]),
    ("vidar-dataset", &["vidar-core", "vidar-bag", "vidar-video"]),
    ("vidar-odometry", &["vidar-core", "vidar-solve"]),
    ("vidar-da3", &["vidar-core", "vidar-nn", "vidar-gpu", "vidar-solve"]),
    ("vidar-stereo", &["vidar-core"]),
    ("vidar-align", &["vidar-core", "vidar-solve"]),
    ("vidar-fusion", &["vidar-core"]),
    ("vidar-eval", &["vidar-core", "vidar-solve"]),
    ("vidar-export", &["vidar-core"]),
    ("vidar-view", &["vidar-core"]),
    ("vidar-synth", &["vidar-core"]),
    ("vidar-link", &["vidar-core"]),
    ("vidar-cli", &["vidar-map"]),
    ("vidar-python", &["vidar-map", "xtask-features"]),
    ("vidar-c", &["vidar-map"]),
    ("xtask", &[]),
    ("xtask-features", &["vidar-odometry"]),
];

/// Third-party crates that only the listed crates may use, with the reason.
const RESERVED: &[(&str, &[&str], &str)] = &[
    ("clap", &["vidar-cli"], "only the program parses flags; libraries take plain values"),
    ("anyhow", &["vidar-cli", "xtask"], "libraries return typed errors"),
    ("indicatif", &["vidar-cli"], "libraries emit events; the program draws them"),
    ("tiny-skia", &["vidar-view"], "pictures are drawn in one place"),
    ("ureq", &["vidar-hub"], "the network is used in one place, and only when asked for"),
    ("object_store", &["vidar-store"], "stores of batches are reached in one place"),
    ("zenoh", &["vidar-link"], "other machines are reached in one place"),
    ("wgpu", &["vidar-gpu"], "graphics processors are used in one place"),
    ("ruzstd", &["vidar-bag"], "recordings are decompressed in one place, within bounds"),
    ("zstd", &["vidar-bag"], "recordings are decompressed in one place, within bounds"),
    ("lz4_flex", &["vidar-bag"], "recordings are decompressed in one place, within bounds"),
    ("re_mp4", &["vidar-video"], "videos are read in one place"),
    ("zip", &["vidar-export"], "archives are read and written in one place, within bounds"),
];

/// Reads the workspace's own dependency graph and reports every forbidden dependency.
pub fn check(root: &Path) -> Result<Vec<String>> {
    let metadata = MetadataCommand::new().manifest_path(root.join("Cargo.toml")).no_deps().exec()?;
    let members: Vec<String> = metadata.packages.iter().map(|p| p.name.to_string()).collect();
    let mut problems = Vec::new();
    for package in &metadata.packages {
        let name = package.name.to_string();
        let may: Option<&[&str]> = LAYERS.iter().find(|(n, _)| *n == name).map(|(_, may)| *may);
        if may.is_none() && name != "vidar-map" {
            problems.push(format!("{name} has no layer; add it to xtask/src/layers.rs and ARCHITECTURE.md"));
        }
        for dependency in &package.dependencies {
            // Development dependencies on the same layer are allowed.
            let ships = dependency.kind != DependencyKind::Development;
            let ours = members.contains(&dependency.name);
            let allowed = match may {
                None => dependency.name != "vidar-cli",
                Some(may) => may.contains(&dependency.name.as_str()),
            };
            if ours && ships && !allowed {
                problems
                    .push(format!("{name} -> {}: this dependency points up or sideways", dependency.name));
            }
            if let Some((_, owners, reason)) = RESERVED.iter().find(|(n, _, _)| *n == dependency.name)
                && ships
                && !owners.contains(&name.as_str())
            {
                problems.push(format!("{name} -> {}: {reason}", dependency.name));
            }
        }
    }
    Ok(problems)
}
