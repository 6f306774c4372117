//! The packages that registries get: `cargo package` for all of them, their sizes and contents, and their order.
//!
//! Nothing is built by `cargo xtask package`, so that CI can afford it. `cargo xtask package --build` also builds the
//! program from the packages alone, which shows that each of them has what the next one needs.

use crate::say;
use anyhow::{Context, Result, bail};
use cargo_metadata::{DependencyKind, MetadataCommand, Package};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;

/// crates.io refuses packages above 10 MiB; other registries count 10 MB.
const MOST_BYTES: u64 = 10_000_000;
/// Files of every package, beside its manifest and sources.
const FILES: [&str; 4] = ["README.md", "LICENSE-MIT", "LICENSE-APACHE", "NOTICE"];

/// Packages everything that is published, and reports what a registry or a user would miss.
pub fn check(root: &Path) -> Result<Vec<String>> {
    let packages = published(root)?;
    let mut arguments = vec!["package", "--quiet", "--locked", "--no-verify", "--allow-dirty"];
    for package in &packages {
        arguments.extend(["--package", package.name.as_str()]);
    }
    run(Command::new(cargo()).current_dir(root).args(&arguments))?;
    let mut problems = Vec::new();
    say("packages, in the order in which they are published:");
    for package in order(&packages)? {
        let archive = archive(root, package)?;
        let bytes = archive.metadata().with_context(|| archive.display().to_string())?.len();
        say(&format!("  {:9.3} MB  {} {}", bytes as f64 / 1e6, package.name, package.version));
        if bytes > MOST_BYTES {
            problems.push(format!("{}: {bytes} bytes, registries accept {MOST_BYTES}", package.name));
        }
        problems.extend(missing_in_manifest(package));
        problems.extend(missing_in(package, &files_in(&archive)?)?);
    }
    Ok(problems)
}

/// Builds the program from the packages alone, and runs it.
pub fn build(root: &Path) -> Result<()> {
    let folder = target(root)?.join("package/from-packages");
    if folder.exists() {
        std::fs::remove_dir_all(&folder)?;
    }
    std::fs::create_dir_all(&folder)?;
    let packages = published(root)?;
    let mut manifest = "[workspace]\nresolver = \"3\"\nmembers = [\"*\"]\n\n[patch.crates-io]\n".to_owned();
    for package in &packages {
        run(Command::new("tar").arg("xzf").arg(archive(root, package)?).arg("-C").arg(&folder))?;
        let (name, version) = (&package.name, &package.version);
        manifest += &format!("{name} = {{ path = \"{name}-{version}\" }}\n");
    }
    std::fs::write(folder.join("Cargo.toml"), manifest)?;
    // The versions of the repository; cargo removes what only the checks in `xtask` use.
    std::fs::copy(root.join("Cargo.lock"), folder.join("Cargo.lock"))?;
    let built = folder.join("target");
    let mut cargo = Command::new(cargo());
    cargo.current_dir(&folder).env("CARGO_TARGET_DIR", &built);
    run(cargo.args(["build", "--package", "vidar-cli"]))?;
    let program = built.join("debug").join(format!("vidar{}", std::env::consts::EXE_SUFFIX));
    run(Command::new(&program).arg("--version"))?;
    // The weights that were packed in two parts.
    run(Command::new(&program).args(["model", "verify", "da3-nano"]))
}

/// The members that are not marked `publish = false`.
fn published(root: &Path) -> Result<Vec<Package>> {
    let metadata = MetadataCommand::new().manifest_path(root.join("Cargo.toml")).no_deps().exec()?;
    Ok(metadata.packages.into_iter().filter(|p| p.publish.as_ref().is_none_or(|to| !to.is_empty())).collect())
}

/// Each package after those that it needs, tests included.
fn order(packages: &[Package]) -> Result<Vec<&Package>> {
    let names: BTreeSet<&str> = packages.iter().map(|p| p.name.as_str()).collect();
    let needs = |package: &Package| -> Vec<String> {
        // A package's own features in its tests have a path and no version: they are left out of the package.
        let is_kept = |d: &&cargo_metadata::Dependency| {
            d.kind != DependencyKind::Development || d.req.to_string() != "*"
        };
        let ours = |d: &&cargo_metadata::Dependency| names.contains(d.name.as_str());
        package.dependencies.iter().filter(ours).filter(is_kept).map(|d| d.name.clone()).collect()
    };
    let (mut ordered, mut done) = (Vec::new(), BTreeSet::new());
    while ordered.len() < packages.len() {
        let is_next =
            |p: &&Package| !done.contains(p.name.as_str()) && needs(p).iter().all(|n| done.contains(n));
        let Some(next) = packages.iter().find(is_next) else {
            let left: Vec<&str> = names.iter().filter(|n| !done.contains(**n)).copied().collect();
            bail!("these packages need each other and cannot be published: {}", left.join(", "));
        };
        done.insert(next.name.to_string());
        ordered.push(next);
    }
    Ok(ordered)
}

/// What crates.io or docs.rs would show a gap for.
fn missing_in_manifest(package: &Package) -> Vec<String> {
    let stated = [
        ("description", package.description.is_some()),
        ("license", package.license.is_some()),
        ("repository", package.repository.is_some()),
        ("readme", package.readme.is_some()),
        ("rust-version", package.rust_version.is_some()),
        ("keywords (1 to 5)", (1..=5).contains(&package.keywords.len())),
        ("categories", !package.categories.is_empty()),
        // Features that users see are documented; `simulation` is for tests.
        (
            "[package.metadata.docs.rs], which names the features to document",
            !package.features.contains_key("gpu") && !package.features.contains_key("device")
                || package.metadata.pointer("/docs/rs").is_some(),
        ),
    ];
    let missing = stated.iter().filter(|(_, is_stated)| !is_stated);
    missing.map(|(what, _)| format!("{}: the manifest has no {what}", package.name)).collect()
}

/// What the archive lacks: documents, and files that the sources include.
fn missing_in(package: &Package, files: &BTreeSet<PathBuf>) -> Result<Vec<String>> {
    let mut wanted: Vec<PathBuf> = FILES.iter().map(PathBuf::from).collect();
    let folder = package.manifest_path.parent().context("a manifest has a folder")?;
    for file in files.iter().filter(|f| f.starts_with("src") && f.extension().is_some_and(|e| e == "rs")) {
        let text = std::fs::read_to_string(folder.as_std_path().join(file))?;
        wanted.extend(included(&text).map(|path| plain(&file.with_file_name(path))));
    }
    let missing = wanted.iter().filter(|file| !files.contains(*file));
    Ok(missing.map(|file| format!("{}: the package lacks {}", package.name, file.display())).collect())
}

/// The paths in `include_str!` and `include_bytes!`.
fn included(text: &str) -> impl Iterator<Item = &str> {
    let starts = ["include_str!(\"", "include_bytes!(\""];
    starts.into_iter().flat_map(|start| text.split(start).skip(1)).filter_map(|rest| rest.split('"').next())
}

/// A relative path without `..`, or as it is where it leaves the package.
fn plain(path: &Path) -> PathBuf {
    let mut parts = Vec::new();
    for part in path {
        if part == ".." && parts.last().is_some_and(|last| *last != "..") {
            parts.pop();
        } else {
            parts.push(part);
        }
    }
    parts.iter().collect()
}

/// The files of an archive, without the folder that all of them are in.
fn files_in(archive: &Path) -> Result<BTreeSet<PathBuf>> {
    let output = Command::new("tar").arg("tzf").arg(archive).output().context("tar")?;
    if !output.status.success() {
        bail!("{}: {}", archive.display(), String::from_utf8_lossy(&output.stderr));
    }
    let names = String::from_utf8_lossy(&output.stdout).into_owned();
    Ok(names.lines().map(|name| Path::new(name).iter().skip(1).collect()).collect())
}

fn archive(root: &Path, package: &Package) -> Result<PathBuf> {
    Ok(target(root)?.join("package").join(format!("{}-{}.crate", package.name, package.version)))
}

fn target(root: &Path) -> Result<PathBuf> {
    let metadata = MetadataCommand::new().manifest_path(root.join("Cargo.toml")).no_deps().exec()?;
    Ok(metadata.target_directory.into_std_path_buf())
}

fn cargo() -> String {
    std::env::var("CARGO").unwrap_or_else(|_| "cargo".into())
}

fn run(command: &mut Command) -> Result<()> {
    let status = command.status().with_context(|| format!("{command:?}"))?;
    if status.success() { Ok(()) } else { bail!("{command:?}: {status}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn included_files_are_found_from_the_source_that_names_them() {
        let text = "a(include_str!(\"../README.md\")); include_bytes!(\"x.bin\")";
        let found: Vec<PathBuf> =
            included(text).map(|p| plain(&Path::new("src/config/a.rs").with_file_name(p))).collect();
        assert_eq!(found, [Path::new("src/README.md"), Path::new("src/config/x.bin")]);
        let outside = plain(&Path::new("src/a.rs").with_file_name("../../presets/fast.toml"));
        assert_eq!(outside, Path::new("../presets/fast.toml"), "no file of a package");
    }

    #[test]
    fn packages_come_after_what_they_need() {
        let packages = published(&Path::new(env!("CARGO_MANIFEST_DIR")).join("..")).unwrap();
        let order = order(&packages).unwrap();
        assert!(order.len() == packages.len() && packages.len() > 20);
        let at = |name: &str| order.iter().position(|p| *p.name == name).unwrap();
        for (first, then) in [
            ("vidar-da3-nano-second-half", "vidar-da3-nano"),
            ("vidar-da3-nano", "vidar-map"),
            ("vidar-export", "vidar-synth"), // a dependency of its tests
            ("vidar-map", "vidar-cli"),
        ] {
            assert!(at(first) < at(then), "{first} before {then}");
        }
        assert!(order.iter().all(|p| *p.name != "xtask"));
    }

    #[test]
    fn gaps_are_reported() {
        let mut packages = published(&Path::new(env!("CARGO_MANIFEST_DIR")).join("..")).unwrap();
        let package = packages.iter_mut().find(|p| *p.name == "vidar-da3").unwrap();
        assert!(missing_in_manifest(package).is_empty());
        let all = ["README.md", "LICENSE-MIT", "LICENSE-APACHE", "NOTICE"].map(PathBuf::from);
        assert!(missing_in(package, &all.iter().cloned().collect()).unwrap().is_empty());
        let missing = missing_in(package, &all[1..].iter().cloned().collect()).unwrap();
        assert_eq!(missing, ["vidar-da3: the package lacks README.md"]);
        package.description = None;
        package.metadata = Default::default();
        assert_eq!(missing_in_manifest(package).len(), 2);
    }
}
