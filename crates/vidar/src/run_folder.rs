//! The run folder: everything about one run, in files that stand alone.
//!
//! Written atomically, appended as computed; nothing is deleted that this run did not write.

mod earlier;
mod log;

pub use earlier::Earlier;
pub use log::event_line;

use crate::error::Error;
use crate::events::Event;
use log::{EventLog, LOG};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::fs::File;
use std::path::{Path, PathBuf};
use vidar_core::Warning;

/// Schema of `manifest.json`.
pub const MANIFEST_SCHEMA: &str = "vidar.run/1";
/// Schema of `views.json`.
pub const VIEWS_SCHEMA: &str = "vidar.views/1";

/// Where a run writes.
#[derive(Debug)]
pub struct RunFolder {
    root: PathBuf,
    log: EventLog,
}

/// Where a new run folder goes.
#[derive(Clone, Debug)]
pub enum OutputLocation {
    /// Exactly here.
    Exact {
        /// The folder.
        path: PathBuf,
        /// Move an existing folder aside instead of refusing.
        force: bool,
    },
    /// In a folder that an earlier attempt at the same run left, or a new one; files are replaced one by one, whole.
    Resumed {
        /// The folder.
        path: PathBuf,
    },
    /// As `Resumed`; where the folder holds another run, that run's own files go first.
    Replaced {
        /// The folder.
        path: PathBuf,
    },
    /// `runs/<dataset>/<time>/` under this folder, with a `latest` link beside it.
    Dated {
        /// Usually the current folder.
        base: PathBuf,
        /// Name of the recording.
        name: String,
    },
}

impl OutputLocation {
    /// What an earlier attempt left there, if the run may go on from it.
    ///
    /// # Errors
    /// [`Error::OtherRun`] where `Resumed` names a folder of another recording or configuration; [`Error::NotARun`] where its
    /// files are of no run.
    pub fn earlier(&self, manifest: &Manifest, config: &str) -> Result<Option<Earlier>, Error> {
        let (Self::Resumed { path } | Self::Replaced { path }) = self else { return Ok(None) };
        let Some(earlier) = Earlier::read(path)? else { return Ok(None) };
        match (earlier.difference(manifest, config), self) {
            (None, _) => Ok(Some(earlier)),
            (Some(difference), Self::Resumed { .. }) => {
                Err(Error::OtherRun { path: path.clone(), difference })
            }
            (Some(_), _) => {
                earlier.remove_all_but(path, &BTreeSet::new());
                Ok(None)
            }
        }
    }

    /// The folder of an earlier attempt that the run may go on from.
    pub fn resumed(&self) -> Option<&Path> {
        match self {
            Self::Resumed { path } | Self::Replaced { path } => Some(path),
            Self::Exact { .. } | Self::Dated { .. } => None,
        }
    }

    /// Makes an empty folder there and returns its path.
    pub fn reserve(&self) -> Result<PathBuf, Error> {
        match self {
            Self::Exact { path, force } => {
                make_way(path, *force)?;
                create_dir(path)?;
                Ok(path.clone())
            }
            Self::Resumed { path } | Self::Replaced { path } => {
                create_dir(path)?;
                Ok(path.clone())
            }
            Self::Dated { base, name } => {
                let parent = base.join("runs").join(safe_name(name));
                let root = free_name(&parent, &now_for_paths());
                create_dir(&root)?;
                link_latest(&parent, &root);
                Ok(root)
            }
        }
    }
}

/// Record of a run.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Manifest {
    /// [`MANIFEST_SCHEMA`].
    pub schema: String,
    /// Version of the program.
    pub version: String,
    /// The command as typed.
    pub command: Vec<String>,
    /// When it began, RFC 3339, UTC.
    pub started: String,
    /// What the input is.
    pub dataset: serde_json::Value,
    /// SHA-256 over the input's names, sizes and text files.
    pub dataset_sha256: String,
    /// SHA-256 of the resolved configuration.
    pub config_sha256: String,
    /// The geometry model.
    pub model: serde_json::Value,
    /// Where metric poses came from.
    pub poses: serde_json::Value,
    /// Machine and threads.
    pub hardware: serde_json::Value,
    /// Wall time per stage, s.
    pub seconds: serde_json::Map<String, serde_json::Value>,
    /// Largest resident memory, bytes, where the system tells.
    pub peak_memory_bytes: Option<u64>,
    /// Counts and scores.
    pub result: serde_json::Value,
    /// Warnings, each kind with its count.
    pub warnings: serde_json::Value,
    /// Every file of the run, relative to the run folder, sorted. Files in the folder that are not listed are not of the run.
    pub artifacts: Vec<String>,
    /// Exit status as a number; null while the run goes on, and of a run that was killed.
    pub exit: Option<i32>,
}

/// The camera as a run used it.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct StoredCamera {
    /// As the flag `--camera-model` takes it.
    pub model: String,
    /// Columns of its images.
    pub width: usize,
    /// Rows.
    pub height: usize,
}

/// One keyframe as the run folder keeps it.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct StoredView {
    /// Frame number in the sequence.
    pub frame: u32,
    /// Time, ns.
    pub time_ns: i64,
    /// The image as it was read, where it is a file.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub source: Option<PathBuf>,
    /// Undistorted image, relative to the run folder, if written.
    pub image: Option<String>,
    /// Depth PNG, relative to the run folder, if written.
    pub depth: Option<String>,
    /// Where each pixel's depth comes from, as a PNG of the numbers of `vidar_core::DepthSource`, if there are several sources.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub depth_source: Option<String>,
    /// Standard deviation of ln(depth), as a PNG in steps of 0.002, if there are several sources.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub depth_std: Option<String>,
    /// Undistorted intrinsics; pixel (0, 0) is the centre of the top-left pixel.
    pub intrinsics: vidar_core::Pinhole,
    /// Row-major 3×4 `world_from_camera`, metres.
    pub world_from_camera: [[f64; 4]; 3],
}

impl RunFolder {
    /// Makes the folder, refusing one that is in use.
    pub fn create(place: &OutputLocation) -> Result<Self, Error> {
        let root = place.reserve()?;
        let path = root.join(LOG);
        let mut options = File::options();
        let log = match place {
            OutputLocation::Resumed { .. } | OutputLocation::Replaced { .. } => {
                options.create(true).append(true)
            }
            OutputLocation::Exact { .. } | OutputLocation::Dated { .. } => {
                options.create(true).write(true).truncate(true)
            }
        };
        let log = log.open(&path).map_err(|e| Error::io("create", &path, e))?;
        Ok(Self { root, log: EventLog::new(log) })
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        &self.root
    }

    /// A path inside, its parent folder made.
    pub fn file(&self, relative: &str) -> Result<PathBuf, Error> {
        let path = self.root.join(relative);
        if let Some(parent) = path.parent() {
            create_dir(parent)?;
        }
        Ok(path)
    }

    /// Writes a whole file or nothing.
    pub fn write(&self, relative: &str, bytes: &[u8]) -> Result<u64, Error> {
        let path = self.file(relative)?;
        vidar_export::atomic::write_file_atomically(&path, bytes)?;
        Ok(bytes.len() as u64)
    }

    /// Appends an event to `log.jsonl`. A log that cannot be written must not end a run: it ends there, with one warning.
    #[must_use = "the warning says that the log is incomplete"]
    pub fn log(&self, event: &Event) -> Option<Warning> {
        self.log.append(event)
    }

    /// Writes the manifest.
    pub fn write_manifest(&self, manifest: &Manifest) -> Result<(), Error> {
        self.write("manifest.json", &pretty(manifest)?).map(|_| ())
    }
}

/// Reads a JSON file of the run in the folder `run`.
///
/// # Errors
/// [`Error::NotARun`]: it is missing, too large or no JSON of that kind.
pub fn read_json<T: serde::de::DeserializeOwned>(run: &Path, relative: &str) -> Result<T, Error> {
    let not_a_run =
        |reason: String| Error::NotARun { path: run.to_owned(), reason: format!("{relative}: {reason}") };
    let bytes = crate::system::read_up_to(&run.join(relative), crate::system::MAX_JSON_BYTES)
        .map_err(|e| not_a_run(e.to_string()))?;
    serde_json::from_slice(&bytes).map_err(|e| not_a_run(e.to_string()))
}

/// Indented JSON with a final newline.
///
/// # Errors
/// JSON cannot hold the value.
pub fn pretty(value: &impl Serialize) -> Result<Vec<u8>, Error> {
    let text = serde_json::to_string_pretty(value).map_err(|e| vidar_export::ExportError::Unwritable {
        format: "JSON",
        what: std::any::type_name_of_val(value).into(),
        reason: e.to_string(),
    })?;
    let mut bytes = vidar_core::printable_json(&text).into_owned().into_bytes();
    bytes.push(b'\n');
    Ok(bytes)
}

fn create_dir(path: &Path) -> Result<(), Error> {
    std::fs::create_dir_all(path).map_err(|e| Error::io("create", path, e))
}

fn make_way(path: &Path, force: bool) -> Result<(), Error> {
    let occupied = match std::fs::read_dir(path) {
        Ok(mut entries) => entries.next().is_some(),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => false,
        Err(e) => return Err(Error::io("open", path, e)),
    };
    if !occupied {
        return Ok(());
    }
    if !force {
        return Err(Error::OutputExists { path: path.to_owned() });
    }
    let parent = path.parent().map_or_else(PathBuf::new, Path::to_owned);
    let name = path.file_name().map_or_else(|| "run".into(), |n| n.to_string_lossy().into_owned());
    let aside = free_name(&parent, &format!("{name}.before-{}", now_for_paths()));
    std::fs::rename(path, &aside).map_err(|e| Error::io("move aside", path, e))
}

/// `parent/name`, or `parent/name-2`, … whichever does not exist yet.
fn free_name(parent: &Path, name: &str) -> PathBuf {
    let first = parent.join(name);
    if !first.exists() {
        return first;
    }
    (2..10_000).map(|i| parent.join(format!("{name}-{i}"))).find(|p| !p.exists()).unwrap_or(first)
}

/// Keeps letters of any script, digits, `.`, `_` and `-`; everything else becomes `_`.
fn safe_name(name: &str) -> String {
    let safe: String =
        name.chars().map(|c| if c.is_alphanumeric() || "._-".contains(c) { c } else { '_' }).collect();
    let trimmed = safe.trim_matches('.').to_owned();
    if trimmed.is_empty() { "run".to_owned() } else { trimmed }
}

/// Now, ns since 1970: the stamp of a message that is sent or received.
pub(crate) fn now_ns() -> u64 {
    let since = now().duration_since(std::time::UNIX_EPOCH).unwrap_or_default();
    u64::try_from(since.as_nanos()).unwrap_or(u64::MAX)
}

#[allow(clippy::disallowed_methods)] // the run folder, its manifest and messages to others are where the clock is wanted
fn now() -> std::time::SystemTime {
    std::time::SystemTime::now()
}

/// Now, RFC 3339 in UTC.
pub fn now_rfc3339() -> String {
    humantime::format_rfc3339_seconds(now()).to_string()
}

fn now_for_paths() -> String {
    now_rfc3339().replace(':', "-").trim_end_matches('Z').to_owned()
}

fn link_latest(parent: &Path, root: &Path) {
    // The link is a convenience; systems without links go without it.
    #[cfg(unix)]
    if let Some(name) = root.file_name() {
        let link = parent.join("latest");
        if link.symlink_metadata().is_ok_and(|m| m.file_type().is_symlink()) {
            let _ = std::fs::remove_file(&link);
        }
        let _ = std::os::unix::fs::symlink(name, link);
    }
    #[cfg(not(unix))]
    let _ = (parent, root);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_occupied_folder_is_refused_and_force_moves_it_aside() {
        let base = tempfile::tempdir().unwrap();
        let path = base.path().join("out ä");
        let place = |force| OutputLocation::Exact { path: path.clone(), force };
        RunFolder::create(&place(false)).unwrap().write("a/b.txt", b"one").unwrap();
        assert!(matches!(RunFolder::create(&place(false)), Err(Error::OutputExists { .. })));
        RunFolder::create(&place(true)).unwrap();
        assert!(!path.join("a/b.txt").exists());
        let aside = std::fs::read_dir(base.path()).unwrap().flatten().find(|e| e.path() != path).unwrap();
        assert_eq!(std::fs::read(aside.path().join("a/b.txt")).unwrap(), b"one");
    }

    #[test]
    fn dated_folders_never_collide_and_latest_names_the_newest() {
        let base = tempfile::tempdir().unwrap();
        let place = OutputLocation::Dated { base: base.path().to_owned(), name: "../my room".into() };
        let first = RunFolder::create(&place).unwrap();
        let second = RunFolder::create(&place).unwrap();
        assert_ne!(first.path(), second.path());
        assert!(first.path().starts_with(base.path().join("runs/_my_room")));
        #[cfg(unix)]
        assert_eq!(
            base.path().join("runs/_my_room/latest").canonicalize().unwrap(),
            second.path().canonicalize().unwrap()
        );
    }
}
