//! Explanations of keys, generated from the doc comments of the configuration structs.

use super::{Config, Layered};
use crate::error::Error;
use schemars::schema_for;
use serde_json::Value;

/// Meaning, kind and default of one key.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Explanation {
    /// The key.
    pub key: String,
    /// Meaning, unit, range, and when to change it.
    pub about: String,
    /// The default as TOML.
    pub default: String,
}

/// JSON schema of the whole configuration.
pub fn schema() -> Value {
    schema_for!(Config).to_value()
}

/// Explains one key, or every key of a section.
pub fn explain(key: &str) -> Result<Vec<Explanation>, Error> {
    let schema = schema();
    let defaults = Layered::defaults()?;
    let inside = format!("{key}.");
    let found: Vec<Explanation> = defaults
        .entries()
        .into_iter()
        .filter(|(k, _, _)| k == key || k.starts_with(&inside))
        .map(|(k, default, _)| Explanation { about: about(&schema, &k), key: k, default })
        .collect();
    if found.is_empty() {
        return Err(Error::UnknownKey {
            key: key.to_owned(),
            nearest: nearest(&defaults, key),
            origin: "the argument of `vidar config explain`".to_owned(),
        });
    }
    Ok(found)
}

/// The key or section that `key` is probably a misspelling of.
fn nearest(defaults: &Layered, key: &str) -> Option<String> {
    /// Jaro-Winkler similarity of a misspelling: lower values also accept unrelated words.
    const MISSPELLING: f64 = 0.85;
    let keys = defaults.entries().into_iter().map(|(k, _, _)| k);
    let sections =
        schema()["properties"].as_object().into_iter().flat_map(|o| o.keys().cloned()).collect::<Vec<_>>();
    // A key without its section counts as close to the full one.
    let score = |candidate: &str| {
        let tail = candidate.rsplit('.').next().unwrap_or(candidate);
        strsim::jaro_winkler(key, candidate).max(strsim::jaro_winkler(key, tail))
    };
    keys.chain(sections)
        .map(|k| (score(&k), k))
        .filter(|(s, _)| *s > MISSPELLING)
        .max_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(_, k)| k)
}

/// Every key of the configuration, in sections, sorted.
pub(super) fn keys() -> Vec<String> {
    let schema = schema();
    let mut found = Vec::new();
    collect(&schema, &schema, "", &mut found);
    found
}

fn collect(schema: &Value, node: &Value, prefix: &str, found: &mut Vec<String>) {
    let node = resolve(schema, node);
    let Some(properties) = node["properties"].as_object() else {
        found.push(prefix.to_owned());
        return;
    };
    for (name, inner) in properties {
        let key = if prefix.is_empty() { name.clone() } else { format!("{prefix}.{name}") };
        collect(schema, inner, &key, found);
    }
}

fn about(schema: &Value, key: &str) -> String {
    let mut node = schema;
    for part in key.split('.') {
        node = &resolve(schema, node)["properties"][part];
    }
    let own = node["description"].as_str().unwrap_or_default();
    own.split_whitespace().collect::<Vec<_>>().join(" ")
}

/// Follows `$ref` and the one-element `allOf` that holds a reference next to a description.
fn resolve<'a>(schema: &'a Value, node: &'a Value) -> &'a Value {
    let reference = node["$ref"].as_str().or_else(|| node["allOf"][0]["$ref"].as_str());
    match reference.and_then(|r| r.strip_prefix('#')).and_then(|pointer| schema.pointer(pointer)) {
        Some(target) => resolve(schema, target),
        None => node,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_key_has_an_explanation() {
        for (key, _, _) in Layered::defaults().unwrap().entries() {
            let found = explain(&key).unwrap();
            assert_eq!(found.len(), 1, "{key}");
            assert!(found[0].about.len() > 15, "{key} is not explained: {:?}", found[0].about);
        }
    }

    #[test]
    fn a_section_explains_all_its_keys_and_an_unknown_key_is_refused() {
        assert!(explain("keyframes").unwrap().len() >= 3);
        let suggested = |key: &str| match explain(key) {
            Err(Error::UnknownKey { nearest, .. }) => nearest,
            other => panic!("{key}: {other:?}"),
        };
        assert_eq!(suggested("keyframes.min_translation").as_deref(), Some("keyframes.min_translation_m"));
        assert_eq!(suggested("keyframe").as_deref(), Some("keyframes"));
        assert_eq!(suggested("voxl_size_m").as_deref(), Some("fusion.voxel_size_m"));
        assert_eq!(suggested("nonsense"), None);
        let error = explain("nonsense").unwrap_err();
        assert!(error.to_string().contains("\"nonsense\""), "{error}");
        assert!(error.hint().is_some_and(|h| h.contains("vidar config show")), "{:?}", error.hint());
    }
}
