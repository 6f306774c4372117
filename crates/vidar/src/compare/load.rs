//! What a comparison reads of a run folder.

use crate::error::Error;
use crate::export::{depth_units, points, read_views};
use crate::run_folder::{MANIFEST_SCHEMA, Manifest, StoredView, read_json};
use crate::system::{MAX_CLOUD_BYTES, MAX_JSON_BYTES, read_text_up_to, read_up_to};
use serde::Deserialize;
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path, PathBuf};
use vidar_core::{PointCloud, TriangleMesh};

/// A run as its folder has it.
#[derive(Debug)]
pub(super) struct StoredRun {
    /// Distinguishes it from the others.
    pub name: String,
    pub folder: PathBuf,
    pub manifest: Manifest,
    pub metrics: Metrics,
    pub views: Vec<StoredView>,
    /// Depth units per metre of its depth images, if it wrote any.
    pub depth_units: Option<f64>,
    pub mesh: TriangleMesh,
    pub cloud: PointCloud,
    /// Its configuration, `section.key` and value.
    pub settings: BTreeMap<String, Value>,
}

/// What is used of `eval/metrics.json`.
#[derive(Debug, Deserialize)]
pub(super) struct Metrics {
    pub reference: String,
    pub coupling: Value,
    pub verdict: Value,
    pub scale: StoredScale,
    pub scores: BTreeMap<String, f64>,
}

/// What was stated of the scale.
#[derive(Debug, Deserialize)]
pub(super) struct StoredScale {
    pub is_metric: bool,
    pub sigma: Option<f64>,
    pub words: String,
}

impl StoredRun {
    pub(super) fn read(folder: &Path, name: String) -> Result<Self, Error> {
        let not_a_run = |reason: String| Error::NotARun { path: folder.to_owned(), reason };
        let manifest: Manifest = read_json(folder, "manifest.json")?;
        if manifest.schema != MANIFEST_SCHEMA {
            let found =
                format!("manifest.json has schema {:?}, expected {MANIFEST_SCHEMA:?}", manifest.schema);
            return Err(not_a_run(found));
        }
        let path = folder.join("map/mesh.ply");
        let bytes = read_up_to(&path, MAX_CLOUD_BYTES).map_err(|e| Error::io("read", &path, e))?;
        let settings = match read_text_up_to(&folder.join("config.resolved.toml"), MAX_JSON_BYTES) {
            Ok(text) => flattened(&text),
            // Numbers and surfaces can be compared without.
            Err(_) => BTreeMap::new(),
        };
        Ok(Self {
            name,
            folder: folder.to_owned(),
            manifest,
            metrics: read_json(folder, "eval/metrics.json")?,
            views: read_views(folder)?,
            depth_units: depth_units(folder)?,
            mesh: vidar_export::read_ply(&bytes)?.into_mesh(),
            cloud: points(folder)?,
            settings,
        })
    }

    /// Level and reasons of its verdict.
    pub(super) fn verdict_line(&self) -> String {
        let level = self.metrics.verdict["level"].as_str().unwrap_or("unknown");
        let reasons = self.metrics.verdict["reasons"].as_array();
        let reasons: Vec<&str> = reasons.into_iter().flatten().filter_map(Value::as_str).collect();
        format!("{level}: {}", reasons.join("; "))
    }

    /// Side of a voxel of its fusion, metres.
    pub(super) fn voxel_size_m(&self) -> Option<f64> {
        self.settings.get("fusion.voxel_size_m")?.as_f64().filter(|v| *v > 0.0)
    }
}

/// The ends of the paths that tell them apart: folder names, with those above where names are the same.
pub(super) fn names(folders: &[PathBuf]) -> Vec<String> {
    let parts: Vec<Vec<String>> = folders
        .iter()
        .map(|folder| {
            // `latest` is a name that another run has tomorrow.
            let real = std::fs::canonicalize(folder).unwrap_or_else(|_| folder.clone());
            let names = real.components().filter_map(|c| match c {
                Component::Normal(name) => Some(name.to_string_lossy().into_owned()),
                _ => None,
            });
            names.collect()
        })
        .collect();
    let longest = parts.iter().map(Vec::len).max().unwrap_or(0);
    let ends = |n: usize| -> Vec<String> {
        parts.iter().map(|p| p[p.len().saturating_sub(n)..].join("/")).collect()
    };
    let differ = |names: &[String]| names.iter().collect::<BTreeSet<_>>().len() == names.len();
    let found = (1..=longest).map(ends).find(|names| differ(names));
    // The same folder twice, which is no mistake: its distance to itself is zero.
    found
        .unwrap_or_else(|| ends(1).into_iter().enumerate().map(|(i, n)| format!("{n} ({})", i + 1)).collect())
}

/// TOML as `section.key` and value; what cannot be read has no settings.
fn flattened(text: &str) -> BTreeMap<String, Value> {
    fn walk(prefix: &str, value: &Value, found: &mut BTreeMap<String, Value>) {
        match value.as_object() {
            Some(object) => object.iter().for_each(|(key, inner)| {
                let name = if prefix.is_empty() { key.clone() } else { format!("{prefix}.{key}") };
                walk(&name, inner, found);
            }),
            None => {
                found.insert(prefix.to_owned(), value.clone());
            }
        }
    }
    let mut found = BTreeMap::new();
    if let Ok(value) = toml::from_str::<Value>(text) {
        walk("", &value, &mut found);
    }
    found
}

/// Settings that are not the same in all runs, each with its values in the order of the runs.
pub(super) fn differing_settings(runs: &[StoredRun]) -> BTreeMap<String, Value> {
    let keys: BTreeSet<&String> = runs.iter().flat_map(|r| r.settings.keys()).collect();
    let values = |key: &String| -> Vec<Value> {
        runs.iter().map(|r| r.settings.get(key).cloned().unwrap_or(Value::Null)).collect()
    };
    keys.into_iter()
        .map(|key| (key.clone(), values(key)))
        .filter(|(_, values)| values.iter().any(|v| *v != values[0]))
        .map(|(key, values)| (key, Value::Array(values)))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_as_short_as_they_can_be_and_differ() {
        let of = |paths: &[&str]| names(&paths.iter().map(PathBuf::from).collect::<Vec<_>>());
        assert_eq!(of(&["/none/a", "/none/b"]), ["a", "b"]);
        assert_eq!(of(&["/none/a/run", "/none/b/run"]), ["a/run", "b/run"]);
        assert_eq!(of(&["/none/a", "/none/a"]), ["a (1)", "a (2)"]);
    }

    #[test]
    fn settings_are_flat() {
        let flat = flattened("a = 1\n[b]\nc = \"x\"\n[b.d]\ne = [1, 2]\n");
        assert_eq!(flat.keys().collect::<Vec<_>>(), ["a", "b.c", "b.d.e"]);
        assert!(flattened("= no toml").is_empty());
    }
}
