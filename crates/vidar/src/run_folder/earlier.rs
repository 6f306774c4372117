//! What an earlier attempt left in a run folder: whether it is the same run, and which files are its own.

use super::Manifest;
use crate::error::Error;
use crate::system::{MAX_JSON_BYTES, read_text_up_to};
use std::collections::BTreeSet;
use std::path::{Component, Path};

/// An earlier attempt's record.
#[derive(Debug)]
pub struct Earlier {
    /// Its manifest as it was when the attempt began or ended.
    manifest: Manifest,
    /// Its configuration, `section.key = value` by line.
    config: BTreeSet<String>,
    /// Its files, relative to the folder.
    files: BTreeSet<String>,
}

impl Earlier {
    /// Reads what is in `root`; none where the folder is empty or absent.
    ///
    /// # Errors
    /// [`Error::NotARun`]: there are files, but no manifest that can be read.
    pub fn read(root: &Path) -> Result<Option<Self>, Error> {
        let is_occupied = std::fs::read_dir(root).is_ok_and(|mut entries| entries.next().is_some());
        if !is_occupied {
            return Ok(None);
        }
        let not_a_run = |reason: String| Error::NotARun { path: root.to_owned(), reason };
        let text = |name: &str| {
            read_text_up_to(&root.join(name), MAX_JSON_BYTES).map_err(|e| not_a_run(format!("{name}: {e}")))
        };
        let manifest: Manifest = serde_json::from_str(&text("manifest.json")?)
            .map_err(|e| not_a_run(format!("manifest.json: {e}")))?;
        let config = settings(&text("config.resolved.toml").unwrap_or_default());
        let mut files: BTreeSet<String> = manifest.artifacts.iter().cloned().collect();
        // An attempt that was killed has no list of files, but a log.
        files.extend(text("log.jsonl").unwrap_or_default().lines().filter_map(artifact));
        files.retain(|f| is_inside(f));
        Ok(Some(Self { manifest, config, files }))
    }

    /// Why `manifest` describes another run; none where it is the same.
    pub fn difference(&self, manifest: &Manifest, config: &str) -> Option<String> {
        let (before, now) = (&self.manifest, manifest);
        if before.dataset_sha256 != now.dataset_sha256 {
            let name = |m: &Manifest| m.dataset["path"].as_str().unwrap_or("another recording").to_owned();
            return Some(format!(
                "it is of another recording, or the recording changed: {} before, {} now",
                name(before),
                name(now)
            ));
        }
        if before.config_sha256 != now.config_sha256 {
            let config = settings(config);
            // How other machines are reached changes no result.
            let matters = |line: &&String| !line.starts_with("link.");
            let differing = |a: &BTreeSet<String>, b: &BTreeSet<String>| -> Vec<String> {
                a.difference(b).filter(matters).take(3).cloned().collect()
            };
            let (old, new) = (differing(&self.config, &config), differing(&config, &self.config));
            if old.is_empty() && new.is_empty() {
                return None;
            }
            return Some(format!(
                "its settings are others: {} before, {} now",
                old.join(", "),
                new.join(", ")
            ));
        }
        None
    }

    /// Removes the earlier attempt's own files except `kept`. Files of others stay.
    pub fn remove_all_but(&self, root: &Path, kept: &BTreeSet<String>) {
        for file in self.files.difference(kept) {
            // What cannot be removed is only left behind.
            let _ = std::fs::remove_file(root.join(file));
            if let Some(parent) = Path::new(file).parent().filter(|p| !p.as_os_str().is_empty()) {
                // Fails where other files are left, as it should.
                let _ = std::fs::remove_dir(root.join(parent));
            }
        }
    }
}

/// `section.key = value` of every line, without comments.
fn settings(toml: &str) -> BTreeSet<String> {
    let table = toml.parse::<toml::Table>().unwrap_or_default();
    let mut found = BTreeSet::new();
    walk("", &toml::Value::Table(table), &mut found);
    found
}

fn walk(key: &str, value: &toml::Value, found: &mut BTreeSet<String>) {
    match value.as_table() {
        Some(table) => table.iter().for_each(|(name, inner)| {
            let key = if key.is_empty() { name.clone() } else { format!("{key}.{name}") };
            walk(&key, inner, found);
        }),
        None => {
            found.insert(format!("{key} = {value}"));
        }
    }
}

/// The path of an `artifact-written` line.
fn artifact(line: &str) -> Option<String> {
    if !line.contains("\"artifact-written\"") {
        return None;
    }
    let event: serde_json::Value = serde_json::from_str(line).ok()?;
    Some(event["path"].as_str()?.to_owned())
}

/// Whether a path of a manifest leads into the folder: a manifest that came from elsewhere must not name other files.
fn is_inside(path: &str) -> bool {
    let path = Path::new(path);
    path.components().count() > 0 && path.components().all(|c| matches!(c, Component::Normal(_)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_files_of_the_run_are_removed_and_none_outside() {
        let base = tempfile::tempdir().unwrap();
        let root = base.path().join("run");
        std::fs::create_dir_all(root.join("pictures")).unwrap();
        for name in ["pictures/old.png", "pictures/kept.png", "mine.txt", "../outside.txt"] {
            std::fs::write(root.join(name), "x").unwrap();
        }
        let manifest = Manifest {
            artifacts: ["pictures/old.png", "../outside.txt", "/etc/none"].map(String::from).to_vec(),
            ..Manifest::default()
        };
        std::fs::write(root.join("manifest.json"), super::super::pretty(&manifest).unwrap()).unwrap();
        let line =
            r#"{"schema":"vidar.event/1","event":"artifact-written","path":"pictures/kept.png","bytes":1}"#;
        std::fs::write(root.join("log.jsonl"), line).unwrap();
        let earlier = Earlier::read(&root).unwrap().unwrap();
        earlier.remove_all_but(&root, &["pictures/kept.png".to_owned()].into());
        assert!(!root.join("pictures/old.png").exists() && root.join("pictures/kept.png").exists());
        assert!(root.join("mine.txt").exists() && base.path().join("outside.txt").exists());
        assert!(earlier.difference(&Manifest::default(), "").is_none());
        let other = Manifest { dataset_sha256: "b".into(), ..Manifest::default() };
        assert!(earlier.difference(&other, "").unwrap().contains("another recording"));
        assert!(matches!(Earlier::read(base.path()), Err(Error::NotARun { .. })));
    }

    #[test]
    fn settings_that_differ_are_named() {
        let all = settings("[fusion]\nvoxel_size_m = 0.04 # file\n[a.b]\nc = [1, 2]\n");
        assert_eq!(all.into_iter().collect::<Vec<_>>(), ["a.b.c = [1, 2]", "fusion.voxel_size_m = 0.04"]);
    }
}
