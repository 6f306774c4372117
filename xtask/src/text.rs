//! Checks on the text of the sources: banned names and file sizes.

use anyhow::{Context, Result};
use std::path::{Path, PathBuf};

/// A file above this fails (CODE_STYLE.md).
const MAX_LINES: usize = 400;

/// Words that hide a transform's direction, and the crates at the file-format border that may use them.
const BANNED: &[&str] = &["extrinsic", "c2w", "w2c", "t_cw", "t_wc", "cam_to_world", "world_to_cam"];
const BORDER: &[&str] = &["vidar-dataset", "vidar-export", "xtask"];

/// Rust sources of crates, program, tasks and bindings.
fn sources(root: &Path) -> Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    let mut folders = ["crates", "models", "apps", "xtask", "python/src", "c/src", "c/tests"]
        .map(|folder| root.join(folder))
        .to_vec();
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).with_context(|| folder.display().to_string())? {
            let path = entry?.path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|e| e == "rs") {
                found.push(path);
            }
        }
    }
    found.sort();
    Ok(found)
}

/// Reports every file above the limit.
pub fn check_size(root: &Path) -> Result<Vec<String>> {
    let mut problems = Vec::new();
    for path in sources(root)? {
        let lines = std::fs::read_to_string(&path)?.lines().count();
        if lines > MAX_LINES {
            problems.push(format!("{}: {lines} lines, the limit is {MAX_LINES}", path.display()));
        }
    }
    Ok(problems)
}

/// Reports every code line that uses a banned word outside the border crates.
pub fn check_names(root: &Path) -> Result<Vec<String>> {
    let mut problems = Vec::new();
    for path in sources(root)? {
        let shown = path.display().to_string();
        if BORDER.iter().any(|crate_name| shown.contains(crate_name)) {
            continue;
        }
        for (number, line) in std::fs::read_to_string(&path)?.lines().enumerate() {
            // Comments may use these words; code may not.
            let code = line.split("//").next().unwrap_or_default();
            let code = code.split('"').step_by(2).collect::<String>().to_lowercase();
            let words = code.split(|c: char| !(c.is_alphanumeric() || c == '_'));
            for word in words.filter(|w| BANNED.contains(w)) {
                problems.push(format!("{shown}:{}: {word:?}; name it a_from_b", number + 1));
            }
        }
    }
    Ok(problems)
}
