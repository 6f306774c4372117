//! The plan of a batch: what is to be done, for any scheduler.

use super::MAX_JSON_BYTES;
use super::record::{Problem, Stage};
use crate::config::{Layered, Origin};
use crate::error::Error;
use crate::events::{CancelToken, Event, Events};
use crate::input;
use crate::run_folder::pretty;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::io::Read;
use std::path::{Path, PathBuf};
use vidar_dataset::OpenOptions;
use vidar_store::Store;

/// Schema of a plan.
pub const PLAN_SCHEMA: &str = "vidar.batch/1";
/// Where plans lie in a store.
const PLANS: &str = "plans";
/// Of a file that no reader opens, so much is hashed, bytes.
const HASHED_BYTES: u64 = 1 << 20;
/// Most files of a folder that no reader opens that are hashed.
const HASHED_FILES: usize = 10_000;

/// What to plan.
#[derive(Clone, Debug)]
pub struct PlanRequest {
    /// The recordings; workers must find them at the same absolute paths.
    pub recordings: Vec<PathBuf>,
    /// How they are read.
    pub open: OpenOptions,
    /// The same as the caller writes it; handed back by [`read_plan`].
    pub input: Value,
    /// The configuration.
    pub layered: Layered,
    /// The address of the store.
    pub store: String,
    /// Into how many tasks the chunks of each recording are divided.
    pub parts: usize,
}

/// A plan. Task `i` of a stage is of recording `i / per_recording`; for `predict` it is part `i % per_recording`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BatchPlan {
    /// [`PLAN_SCHEMA`].
    pub schema: String,
    /// Version of the program; another version plans anew, because its maps may differ.
    pub version: String,
    /// Into how many tasks the chunks of each recording are divided.
    pub parts: usize,
    /// How recordings are read.
    pub input: Value,
    /// Every setting, as TOML.
    pub settings: String,
    /// The recordings, in the order given.
    pub recordings: Vec<PlannedRecording>,
    /// The stages, in order: each needs all of its recording's tasks of the one before.
    pub stages: Vec<PlannedStage>,
}

/// A recording of a batch.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlannedRecording {
    /// Name for tables and folders.
    pub name: String,
    /// Absolute path.
    pub path: PathBuf,
    /// SHA-256 of what it consists of.
    pub sha256: String,
    /// SHA-256 of that and of everything else that its map depends on.
    pub key: String,
    /// Images in it.
    pub images: Option<usize>,
    /// From its first to its last image, s.
    pub seconds: Option<f64>,
    /// Why it cannot be read; its tasks will say the same.
    pub problem: Option<Problem>,
}

/// A stage of a batch.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlannedStage {
    /// Which.
    pub stage: Stage,
    /// How many tasks, numbered from 0.
    pub tasks: usize,
    /// Tasks of one recording; 0 for a task over all of them.
    pub per_recording: usize,
}

/// A plan in its store.
#[derive(Clone, Debug)]
pub struct Planned {
    /// Its address, for `vidar work --plan`.
    pub uri: String,
    /// The plan.
    pub plan: BatchPlan,
}

/// Opens every recording, and writes the plan. A recording that cannot be read stays in the plan, with the reason.
///
/// # Errors
/// A path that does not exist, a recording given twice, settings that are refused, or a store that cannot be written.
pub fn plan(request: &PlanRequest, events: &Events, cancel: &CancelToken) -> Result<Planned, Error> {
    let usage = |what: String, hint: &str| Error::Usage { what, hint: hint.to_owned() };
    let parts = request.parts;
    if !(1..=4096).contains(&parts) {
        return Err(usage(
            format!("--parts {parts} is not within 1 and 4096"),
            "as many as workers that predict one recording",
        ));
    }
    if let Some(missing) = request.recordings.iter().find(|p| !p.exists()) {
        return Err(Error::io("read", missing, std::io::ErrorKind::NotFound.into()));
    }
    request.layered.build()?;
    let store = Store::create(&absolute(&request.store))?;
    let total = request.recordings.len();
    let recordings = events.stage("plan", total, || {
        let one = |(i, path): (usize, &PathBuf)| {
            if cancel.is_cancelled() {
                return Err(Error::Interrupted { path: path.clone() });
            }
            let recording = recording(path, request);
            events.emit(&Event::Progress { stage: "plan", done: i + 1, total });
            recording
        };
        request.recordings.iter().enumerate().map(one).collect::<Result<Vec<_>, Error>>()
    })?;
    for (i, recording) in recordings.iter().enumerate() {
        if let Some(first) = recordings[..i].iter().find(|r| r.key == recording.key) {
            let what =
                format!("{} and {} are the same recording", first.path.display(), recording.path.display());
            return Err(usage(what, "give each recording once"));
        }
    }
    let stage = |stage, per_recording: usize| PlannedStage {
        stage,
        tasks: if per_recording == 0 { 1 } else { per_recording * total },
        per_recording,
    };
    let plan = BatchPlan {
        schema: PLAN_SCHEMA.to_owned(),
        version: crate::VERSION.to_owned(),
        parts,
        input: request.input.clone(),
        settings: request.layered.to_toml(false),
        recordings,
        stages: vec![
            stage(Stage::Track, 1),
            stage(Stage::Predict, parts),
            stage(Stage::Map, 1),
            stage(Stage::Report, 0),
        ],
    };
    let bytes = pretty(&plan)?;
    let name = format!("{PLANS}/{}.json", vidar_hub::sha256_hex(&bytes));
    store.put(&name, bytes)?;
    Ok(Planned { uri: format!("{}/{name}", store.uri()), plan })
}

/// A plan and its store.
///
/// # Errors
/// There is no plan at that address, it is damaged, or it is of another version.
pub fn read_plan(uri: &str) -> Result<(Planned, Store), Error> {
    let bad = |reason: String| Error::NotABatch { name: uri.to_owned(), reason };
    let parts = uri
        .rsplit_once('/')
        .and_then(|(folder, file)| Some((folder.strip_suffix(&format!("/{PLANS}"))?, file)));
    let (root, file) =
        parts.ok_or_else(|| bad(format!("the address of a plan ends with /{PLANS}/HASH.json")))?;
    let store = Store::open(&absolute(root))?;
    let bytes = store.get(&format!("{PLANS}/{file}"), MAX_JSON_BYTES)?;
    let bytes = bytes.ok_or_else(|| bad("there is no such plan".into()))?;
    if file.strip_suffix(".json") != Some(&vidar_hub::sha256_hex(&bytes)) {
        return Err(bad("its content is not what its name says: it is damaged".into()));
    }
    let plan: BatchPlan = serde_json::from_slice(&bytes).map_err(|e| bad(e.to_string()))?;
    if (plan.schema.as_str(), plan.version.as_str()) != (PLAN_SCHEMA, crate::VERSION) {
        let found = format!("{} of version {}", plan.schema, plan.version);
        return Err(bad(format!("it is {found}, this program is of version {}: plan anew", crate::VERSION)));
    }
    Ok((Planned { uri: uri.to_owned(), plan }, store))
}

impl BatchPlan {
    /// The configuration of every recording.
    pub(super) fn layered(&self, uri: &str) -> Result<Layered, Error> {
        let mut layered = Layered::defaults()?;
        layered.table(&self.settings, &Origin::File(uri.into()))?;
        Ok(layered)
    }
}

fn recording(path: &Path, request: &PlanRequest) -> Result<PlannedRecording, Error> {
    let path = std::path::absolute(path).map_err(|e| Error::io("read", path, e))?;
    let config = request.layered.build()?;
    let opened = input::open_every_image(&path, &request.open, &config);
    let opened = opened.and_then(|dataset| Ok((input::fingerprint(&dataset)?, dataset)));
    let (sha256, images, seconds, problem) = match opened {
        Ok((sha256, dataset)) => {
            let ends = dataset.images.first().zip(dataset.images.last());
            let seconds = ends.map(|(first, last)| (last.time - first.time).as_secs_f64());
            (sha256, Some(dataset.images.len()), seconds, None)
        }
        Err(error) => (hash_of_files(&path)?, None, None, Some(Problem::of(&error))),
    };
    let key = json!({
        "schema": PLAN_SCHEMA, "version": crate::VERSION, "recording": sha256, "input": request.input,
        "settings": request.layered.to_toml(false),
    });
    let key = vidar_hub::sha256_hex(key.to_string().as_bytes());
    Ok(PlannedRecording { name: name_of(&path, &key), path, sha256, key, images, seconds, problem })
}

/// Letters, digits, `.`, `_` and `-` of its name, as every store takes them, and the head of its key.
fn name_of(path: &Path, key: &str) -> String {
    let safe = |c: char| if c.is_ascii_alphanumeric() || "._-".contains(c) { c } else { '_' };
    let name: String = input::name_of(path).chars().take(80).map(safe).collect();
    let name = name.trim_matches('.');
    format!("{}-{}", if name.is_empty() { "recording" } else { name }, &key[..12])
}

/// Names, sizes and the beginnings of the files of what no reader opens: enough to see that it was replaced.
fn hash_of_files(path: &Path) -> Result<String, Error> {
    use sha2::{Digest, Sha256};
    let mut files = Vec::new();
    list_files(path, &mut files);
    files.sort();
    let mut hash = Sha256::new();
    for file in files {
        let unreadable = |e| Error::io("read", &file, e);
        let open = std::fs::File::open(&file).map_err(unreadable)?;
        let size = open.metadata().map_err(unreadable)?.len();
        let relative = file.strip_prefix(path).unwrap_or(&file).display();
        hash.update(format!("{relative} {size}\n"));
        let mut head = Vec::new();
        open.take(HASHED_BYTES).read_to_end(&mut head).map_err(unreadable)?;
        hash.update(&head);
    }
    Ok(vidar_hub::hex(&hash.finalize()))
}

fn list_files(path: &Path, found: &mut Vec<PathBuf>) {
    if found.len() >= HASHED_FILES {
        return;
    }
    match std::fs::read_dir(path) {
        // A link may lead in a circle.
        Ok(entries) => entries
            .flatten()
            .filter(|e| e.file_type().is_ok_and(|t| !t.is_symlink()))
            .for_each(|e| list_files(&e.path(), found)),
        Err(_) => found.extend(path.is_file().then(|| path.to_owned())),
    }
}

/// A folder's address as an absolute path, because workers start elsewhere; other addresses as they are.
fn absolute(uri: &str) -> String {
    match uri.contains("://") || uri.is_empty() {
        true => uri.to_owned(),
        false => std::path::absolute(uri).map_or_else(|_| uri.to_owned(), |p| p.display().to_string()),
    }
}
