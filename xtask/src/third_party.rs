//! One file with the licences of everything that is linked into the program, the Python module or the C library.
//!
//! Their conditions ask for it: copyright notices and licence texts go along with a binary. Texts are those in the
//! packages; a crate that offers Apache-2.0 is used under Apache-2.0, whose text is the same for all of them.

use anyhow::{Context, Result, bail};
use cargo_metadata::{CargoOpt, DependencyKind, Metadata, MetadataCommand, Package, PackageId};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::path::Path;

/// The file, in the root of the repository.
pub const FILE: &str = "THIRD-PARTY-LICENSES.txt";

/// What is shipped.
const SHIPPED: [&str; 3] = ["vidar-cli", "vidar-python", "vidar-c"];

const HEAD: &str = "\
THIRD-PARTY LICENCES

VIDAR is licensed under MIT OR Apache-2.0 (LICENSE-MIT, LICENSE-APACHE, NOTICE). Its program, Python module and C library
also contain the crates listed here, with any feature and on any platform, and the Rust standard library (MIT OR
Apache-2.0, copyright The Rust Project Developers). `cargo xtask third-party` writes this file from the packages that
the lock file names.
";

/// Work of others that a crate contains, and whose licence its manifest does not name.
const CONTAINED: &[(&str, &str, &str)] = &[(
    "noto-sans-mono-bitmap",
    "pictures of letters of the font Noto Sans Mono, copyright 2022 The Noto Project Authors\n\
     (https://github.com/notofonts/latin-greek-cyrillic), SIL Open Font License 1.1",
    include_str!("../licences/OFL-1.1.txt"),
)];

/// The terms of the MIT licence, for crates whose package has no file of them.
const MIT: &str = include_str!("../../LICENSE-MIT");
const APACHE: &str = include_str!("../../LICENSE-APACHE");

/// Writes the file.
pub fn write(root: &Path) -> Result<()> {
    std::fs::write(root.join(FILE), text(root)?).context(FILE)
}

/// Reports a file that is not what [`write()`] writes.
pub fn check(root: &Path) -> Result<Vec<String>> {
    let found = std::fs::read_to_string(root.join(FILE)).unwrap_or_default();
    Ok(difference(&found, &text(root)?).into_iter().collect())
}

/// What to do where the file differs, with the first line that does.
fn difference(found: &str, wanted: &str) -> Option<String> {
    let found = unix(found);
    let lines = || found.lines().chain([""]).zip(wanted.lines().chain([""]));
    let first = lines().find(|(a, b)| a != b).map_or("its end", |(_, wanted)| wanted);
    (found != wanted).then(|| format!("{FILE} is stale at {first:?}: run `cargo xtask third-party`"))
}

fn text(root: &Path) -> Result<String> {
    let metadata = MetadataCommand::new()
        .manifest_path(root.join("Cargo.toml"))
        .features(CargoOpt::AllFeatures)
        .other_options(["--locked".to_owned()])
        .exec()?;
    let mut packages = BTreeMap::new();
    for shipped in SHIPPED {
        for package in linked(&metadata, shipped)? {
            packages.insert((package.name.to_string(), package.version.clone()), package.clone());
        }
    }
    let (mut list, mut texts) = (String::new(), BTreeMap::<String, BTreeSet<String>>::new());
    for ((name, version), package) in &packages {
        let licence = package.license.as_deref().unwrap_or_default();
        let source = package.repository.as_deref().or(package.homepage.as_deref()).unwrap_or_default();
        writeln!(list, "{name} {version} ({licence}) {source}")?;
        for text in texts_of(package)? {
            texts.entry(text).or_default().insert(format!("{name} {version}"));
        }
    }
    for (name, what, text) in CONTAINED {
        if !packages.keys().any(|(n, _)| n == name) {
            bail!("{name} is not linked any more: remove it from xtask/src/third_party.rs");
        }
        texts.entry(tidy(text)).or_default().insert(format!("{name}: {what}"));
    }
    Ok(assembled(&list, &texts))
}

/// List and texts as one file; the text that most crates share comes first.
fn assembled(list: &str, texts: &BTreeMap<String, BTreeSet<String>>) -> String {
    let mut ordered: Vec<_> = texts.iter().collect();
    ordered.sort_by_key(|(_, users)| std::cmp::Reverse(users.len()));
    let line = "=".repeat(100);
    let mut all = format!("{HEAD}\n{line}\n\n{list}");
    for (text, users) in ordered {
        let users: Vec<&str> = users.iter().map(String::as_str).collect();
        all += &format!("\n{line}\n{}\n{line}\n\n{text}\n", wrapped(&users));
    }
    all
}

/// Names in lines of at most 100 characters.
fn wrapped(names: &[&str]) -> String {
    let mut lines = vec![String::new()];
    for (k, name) in names.iter().enumerate() {
        let word = if k + 1 < names.len() { format!("{name}, ") } else { (*name).to_owned() };
        match lines.last_mut() {
            Some(line) if line.len() + word.len() <= 100 || line.is_empty() => *line += &word,
            _ => lines.push(word),
        }
    }
    lines.iter().map(|line| line.trim_end()).collect::<Vec<_>>().join("\n")
}

/// The packages from registries that the package links, on any platform.
fn linked<'a>(metadata: &'a Metadata, shipped: &str) -> Result<Vec<&'a Package>> {
    let resolve = metadata.resolve.as_ref().context("no dependency graph")?;
    let edges: BTreeMap<&PackageId, _> = resolve.nodes.iter().map(|n| (&n.id, &n.deps)).collect();
    let own = metadata.packages.iter().find(|p| *p.name == shipped).context("the shipped package")?;
    let (mut open, mut seen) = (vec![&own.id], BTreeSet::from([&own.id]));
    while let Some(id) = open.pop() {
        let links = |dep: &&cargo_metadata::NodeDep| {
            dep.dep_kinds.iter().any(|kind| kind.kind == DependencyKind::Normal)
        };
        for dep in edges.get(id).into_iter().flat_map(|deps| deps.iter()).filter(links) {
            if seen.insert(&dep.pkg) {
                open.push(&dep.pkg);
            }
        }
    }
    Ok(metadata.packages.iter().filter(|p| seen.contains(&p.id) && p.source.is_some()).collect())
}

/// The texts that go along with a package.
fn texts_of(package: &Package) -> Result<Vec<String>> {
    let expression = package.license.as_deref().unwrap_or_default();
    let folder = package.manifest_path.parent().context("a manifest has a folder")?;
    let mut files: Vec<(String, std::path::PathBuf)> = Vec::new();
    for entry in std::fs::read_dir(folder)? {
        let entry = entry?;
        let name = entry.file_name().to_string_lossy().to_uppercase();
        let starts = ["LICENSE", "LICENCE", "COPYING", "COPYRIGHT", "NOTICE", "UNLICENSE"];
        if entry.file_type()?.is_file() && starts.iter().any(|start| name.starts_with(start)) {
            files.push((name, entry.path()));
        }
    }
    files.sort();
    let as_apache = is_offered_under_apache(expression);
    if as_apache {
        // What belongs to the other alternatives is left out.
        let others = ["MIT", "ZLIB", "BSD", "ISC", "UNLICENSE", "LGPL"];
        files.retain(|(name, _)| !others.iter().any(|other| name.contains(other)));
    }
    let mut texts = BTreeSet::new();
    for (_, path) in &files {
        let bytes = std::fs::read(path).with_context(|| path.display().to_string())?;
        texts.insert(common(&tidy(&String::from_utf8_lossy(&bytes))));
    }
    if as_apache || expression == "Apache-2.0" {
        texts.insert(tidy(APACHE));
    } else if texts.is_empty() && expression == "MIT" {
        texts.insert(mit_of(package));
    }
    if texts.is_empty() {
        bail!("{} {} ({expression}) has no licence file", package.name, package.version);
    }
    Ok(texts.into_iter().collect())
}

/// Whether one may choose Apache-2.0 alone.
fn is_offered_under_apache(expression: &str) -> bool {
    let is_choice = !expression.contains("AND") && !expression.contains('(');
    is_choice && expression.replace('/', " OR ").split(" OR ").any(|licence| licence.trim() == "Apache-2.0")
}

/// The MIT licence with the names of a manifest: its package has no text of its own.
fn mit_of(package: &Package) -> String {
    let holders = match package.authors.as_slice() {
        [] => format!("the authors of {}", package.name),
        authors => authors.join(", "),
    };
    let lines = MIT.lines().map(|line| match line.starts_with("Copyright") {
        true => format!("Copyright (c) {holders}"),
        false => line.to_owned(),
    });
    tidy(&lines.collect::<Vec<_>>().join("\n"))
}

/// Our copy of the Apache licence in place of a copy that differs in spaces and in the form at its end.
fn common(text: &str) -> String {
    let words = |text: &str| text.split_whitespace().collect::<Vec<_>>().join(" ");
    let (text_words, ours) = (words(text), words(APACHE));
    let end = "END OF TERMS AND CONDITIONS";
    let is_apache = text_words.starts_with("Apache License Version 2.0, January 2004")
        && text_words.split(end).nth(1).is_none_or(|form| form.len() < 1200)
        && text_words.len() < ours.len() + 1600;
    if is_apache { tidy(APACHE) } else { text.to_owned() }
}

fn unix(text: &str) -> String {
    text.replace("\r\n", "\n")
}

/// Without carriage returns, spaces at ends of lines, and empty lines around.
fn tidy(text: &str) -> String {
    let text = unix(text).replace(['\u{feff}', '\u{c}'], "");
    text.lines().map(str::trim_end).collect::<Vec<_>>().join("\n").trim_matches('\n').to_owned()
}

#[cfg(test)]
mod tests;
