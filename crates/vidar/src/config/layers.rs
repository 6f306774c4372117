//! Layers of configuration, each value with its origin.

use super::{Config, PRESETS};
use crate::error::Error;
use crate::models::{bundled, geometry};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::{Path, PathBuf};
use toml::{Table, Value};

const SOURCE: &str = "geometry.source";
const WEIGHTS: &str = "model.dir";
/// The model of workers elsewhere.
const REMOTE_MODEL: &str = "remote.model";
const PROCESS_SIZE: &str = "model.network.preprocess.process_size_px";
const POSE_MODE: &str = "model.network.mode";

/// Origin of a value.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Origin {
    /// The program's default.
    Default,
    /// A preset.
    Preset(String),
    /// A file.
    File(PathBuf),
    /// An environment variable.
    Environment(String),
    /// `--set`.
    Set,
    /// A dedicated flag.
    Flag(&'static str),
    /// Derived from the data.
    Derived(&'static str),
}

impl fmt::Display for Origin {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Default => f.write_str("default"),
            Self::Preset(name) => write!(f, "preset {name}"),
            Self::File(path) => write!(f, "file {}", path.display()),
            Self::Environment(name) => write!(f, "environment {name}"),
            Self::Set => f.write_str("--set"),
            Self::Flag(name) => f.write_str(name),
            Self::Derived(why) => write!(f, "derived: {why}"),
        }
    }
}

/// Configuration under construction: values and their origins.
#[derive(Clone, Debug)]
pub struct Layered {
    values: Table,
    origins: BTreeMap<String, Origin>,
    /// Keys that may be absent; they hold [`ABSENT`] then.
    optional: BTreeSet<String>,
}

/// How an optional value that is not set is written: TOML has no null.
const ABSENT: &str = "none";

impl Layered {
    /// The defaults.
    pub fn defaults() -> Result<Self, Error> {
        let mut values =
            Table::try_from(Config::default()).map_err(|e| Error::BadValue { reason: e.to_string() })?;
        // The schema contains every key, the table only those with a default value.
        let optional: BTreeSet<String> =
            super::explain::keys().into_iter().filter(|key| lookup(&values, key).is_none()).collect();
        optional.iter().for_each(|key| store(&mut values, key, Value::String(ABSENT.into())));
        let mut origins = BTreeMap::new();
        for_each_leaf(&values, "", &mut |key, _| {
            origins.insert(key.to_owned(), Origin::Default);
        });
        Ok(Self { values, origins, optional })
    }

    /// Applies a preset by name.
    pub fn preset(&mut self, name: &str) -> Result<(), Error> {
        let preset = PRESETS.iter().find(|p| p.name == name).ok_or_else(|| Error::UnknownPreset {
            name: name.to_owned(),
            known: PRESETS.iter().map(|p| p.name).collect::<Vec<_>>().join(", "),
        })?;
        self.table(preset.toml, &Origin::Preset(name.to_owned()))
    }

    /// Applies a TOML file.
    pub fn file(&mut self, path: &Path) -> Result<(), Error> {
        let fail = |reason: String| Error::ConfigFile { path: path.to_owned(), reason };
        let text = crate::system::read_text_up_to(path, crate::system::MAX_CONFIG_BYTES)
            .map_err(|e| fail(e.to_string()))?;
        self.table(&text, &Origin::File(path.to_owned())).map_err(|error| match error {
            Error::BadValue { reason } => fail(reason),
            other => other,
        })
    }

    /// Applies `VIDAR_SECTION__KEY=value` variables; those without a double underscore are not settings.
    pub fn environment(&mut self, variables: impl Iterator<Item = (String, String)>) -> Result<(), Error> {
        let mut sorted: Vec<_> = variables.collect();
        sorted.sort();
        for (name, value) in sorted {
            if let Some(rest) = name.strip_prefix("VIDAR_")
                && rest.contains("__")
            {
                let key = rest.to_lowercase().replace("__", ".");
                self.value(&key, parse_value(&value), Origin::Environment(name))?;
            }
        }
        Ok(())
    }

    /// Applies `section.key=value`.
    pub fn set(&mut self, assignment: &str) -> Result<(), Error> {
        let Some((key, value)) = assignment.split_once('=') else {
            return Err(Error::Usage {
                what: format!("--set {assignment:?} has no '='"),
                hint: "write --set section.key=value, e.g. --set fusion.voxel_size_m=0.03".into(),
            });
        };
        self.value(key.trim(), parse_value(value.trim()), Origin::Set)
    }

    /// Applies one value.
    pub fn value(&mut self, key: &str, value: Value, origin: Origin) -> Result<(), Error> {
        let Some(current) = lookup(&self.values, key) else {
            return Err(Error::UnknownKey {
                key: key.to_owned(),
                nearest: self.nearest(key),
                origin: origin.to_string(),
            });
        };
        let free = self.optional.contains(key);
        let value = if free { Ok(optional_value(value)) } else { coerce(current, value) }.map_err(
            |(expected, found)| Error::BadValue {
                reason: format!("{key} must be {expected}, found {found} (from {origin})"),
            },
        )?;
        store(&mut self.values, key, value);
        self.origins.insert(key.to_owned(), origin);
        if [SOURCE, WEIGHTS, REMOTE_MODEL].contains(&key) {
            self.follow_source()?;
        }
        Ok(())
    }

    /// Custom weights are the source of geometry, the built-in network gets images of its training size and known camera
    /// poses, unless set otherwise; all other networks get the defaults.
    fn follow_source(&mut self) -> Result<(), Error> {
        let is = |key, wanted| lookup(&self.values, key).and_then(Value::as_str) == Some(wanted);
        let is_remote = lookup(&self.values, SOURCE)
            .and_then(Value::as_str)
            .is_some_and(|s| s.starts_with(geometry::REMOTE));
        let is_bundled = is(SOURCE, bundled::NAME) || (is_remote && is(REMOTE_MODEL, bundled::NAME));
        let has_weights = !is(WEIGHTS, "");
        let size = Value::Integer(bundled::PROCESS_SIZE_PX as i64);
        let (custom, conditioned) = [geometry::CUSTOM, "conditioned"].map(|s| Value::String(s.into())).into();
        let wishes = [
            (has_weights, SOURCE, custom, "model.dir names weights"),
            (is_bundled, PROCESS_SIZE, size, "the training size of da3-nano"),
            (is_bundled, POSE_MODE, conditioned, "cameras estimated by da3-nano are coarse"),
        ];
        for (wished, key, wish, why) in wishes {
            let (value, origin) = match (wished, self.origins.get(key)) {
                (true, Some(Origin::Default)) => (Some(wish), Origin::Derived(why)),
                (false, Some(Origin::Derived(_))) => {
                    (lookup(&Self::defaults()?.values, key).cloned(), Origin::Default)
                }
                _ => (None, Origin::Default),
            };
            let Some(value) = value else { continue };
            store(&mut self.values, key, value);
            self.origins.insert(key.to_owned(), origin);
        }
        Ok(())
    }

    /// Applies TOML that was read already.
    pub fn table(&mut self, text: &str, origin: &Origin) -> Result<(), Error> {
        let table: Table =
            text.parse().map_err(|e: toml::de::Error| Error::BadValue { reason: e.to_string() })?;
        let mut leaves = Vec::new();
        for_each_leaf(&table, "", &mut |key, value| leaves.push((key.to_owned(), value.clone())));
        leaves.into_iter().try_for_each(|(key, value)| self.value(&key, value, origin.clone()))
    }

    /// Builds and checks the configuration.
    pub fn build(&self) -> Result<Config, Error> {
        let mut values = self.values.clone();
        for key in &self.optional {
            if lookup(&values, key).is_some_and(|v| v.as_str() == Some(ABSENT)) {
                remove(&mut values, key);
            }
        }
        let config: Config =
            values.try_into().map_err(|e: toml::de::Error| Error::BadValue { reason: e.to_string() })?;
        config.validate()?;
        Ok(config)
    }

    /// Every key with its value as TOML and its origin, sorted.
    pub fn entries(&self) -> Vec<(String, String, Origin)> {
        let mut entries = Vec::new();
        for_each_leaf(&self.values, "", &mut |key, value| {
            let origin = self.origins.get(key).cloned().unwrap_or(Origin::Default);
            entries.push((key.to_owned(), value.to_string(), origin));
        });
        entries
    }

    /// The configuration as TOML, each line with its origin in a comment when `with_origin`.
    pub fn to_toml(&self, with_origin: bool) -> String {
        let mut text = String::new();
        let mut section = String::new();
        for (key, value, origin) in self.entries() {
            let (head, name) = key.rsplit_once('.').unwrap_or(("", &key));
            if head != section {
                let gap = if text.is_empty() { "" } else { "\n" };
                text.push_str(&format!("{gap}[{head}]\n"));
                head.clone_into(&mut section);
            }
            let line = format!("{name} = {value}");
            match with_origin {
                true => text.push_str(&format!("{line:<44} # {origin}\n")),
                false => text.push_str(&format!("{line}\n")),
            }
        }
        text
    }

    fn nearest(&self, key: &str) -> Option<String> {
        // A key without its section counts as close to the full one.
        let score = |candidate: &str| {
            let tail = candidate.rsplit('.').next().unwrap_or(candidate);
            strsim::jaro_winkler(key, candidate).max(strsim::jaro_winkler(key, tail))
        };
        self.origins
            .keys()
            .map(|k| (score(k), k))
            .filter(|(s, _)| *s > 0.7)
            .max_by(|a, b| a.0.total_cmp(&b.0))
            .map(|(_, k)| k.clone())
    }
}

/// A command-line value: TOML where it parses as such, else a plain string.
fn parse_value(text: &str) -> Value {
    format!("v = {text}")
        .parse::<Table>()
        .ok()
        .filter(|t| t.len() == 1)
        .and_then(|mut t| t.remove("v"))
        .unwrap_or_else(|| Value::String(text.to_owned()))
}

fn for_each_leaf(table: &Table, prefix: &str, visit: &mut dyn FnMut(&str, &Value)) {
    // Plain values first, so that a section's own keys are not printed under a subsection.
    for tables in [false, true] {
        for (name, value) in table.iter().filter(|(_, v)| v.is_table() == tables) {
            let key = if prefix.is_empty() { name.clone() } else { format!("{prefix}.{name}") };
            match value {
                Value::Table(inner) => for_each_leaf(inner, &key, visit),
                leaf => visit(&key, leaf),
            }
        }
    }
}

fn lookup<'a>(table: &'a Table, key: &str) -> Option<&'a Value> {
    let (head, rest) = key.split_once('.').map_or((key, None), |(h, r)| (h, Some(r)));
    match (table.get(head)?, rest) {
        (Value::Table(inner), Some(rest)) => lookup(inner, rest),
        (Value::Table(_), None) | (_, Some(_)) => None,
        (leaf, None) => Some(leaf),
    }
}

fn store(table: &mut Table, key: &str, value: Value) {
    match key.split_once('.') {
        Some((head, rest)) => {
            if let Some(Value::Table(inner)) = table.get_mut(head) {
                store(inner, rest, value);
            }
        }
        None => {
            table.insert(key.to_owned(), value);
        }
    }
}

fn remove(table: &mut Table, key: &str) {
    match key.split_once('.') {
        Some((head, rest)) => {
            if let Some(Value::Table(inner)) = table.get_mut(head) {
                remove(inner, rest);
            }
        }
        None => {
            table.remove(key);
        }
    }
}

/// All optional values are numbers; a whole number is kept as integer.
fn optional_value(value: Value) -> Value {
    if let Value::Integer(i) = value { Value::Float(i as f64) } else { value }
}

/// Converts `value` to the type of `current`; the error is (expected, found).
fn coerce(current: &Value, value: Value) -> Result<Value, (&'static str, String)> {
    match (current, value) {
        (Value::Float(_), Value::Integer(i)) => Ok(Value::Float(i as f64)),
        (Value::Array(_), Value::Array(items)) => Ok(Value::Array(
            items
                .into_iter()
                .map(|v| if let Value::Integer(i) = v { Value::Float(i as f64) } else { v })
                .collect(),
        )),
        (current, value) if current.same_type(&value) => Ok(value),
        (current, value) => Err((kind(current), value.to_string())),
    }
}

fn kind(value: &Value) -> &'static str {
    match value {
        Value::String(_) => "a string",
        Value::Integer(_) => "a whole number",
        Value::Float(_) => "a number",
        Value::Boolean(_) => "true or false",
        Value::Datetime(_) => "a date",
        Value::Array(_) => "a list",
        Value::Table(_) => "a section",
    }
}
