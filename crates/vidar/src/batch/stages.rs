//! The stages of a batch that work on one recording, each in a run folder of its own that is moved through the store.

use super::plan::Planned;
use super::record::{Problem, Stage, Status, StoredFile, TaskRecord};
use super::task::Task;
use crate::error::{Error, ExitStatus};
use crate::run::parts::{self, PartOutcome};
use crate::run::{self, RunOutcome, RunRequest};
use crate::run_folder::OutputLocation;
use serde_json::json;
use std::path::{Component, Path, PathBuf};
use tempfile::TempDir;
use vidar_core::{ChunkId, Severity, Warning};
use vidar_hub::TransferCallbacks;

/// What a stage made.
pub(super) struct Made {
    pub status: Status,
    pub problem: Option<Problem>,
    pub warnings: Vec<Warning>,
    pub files: Vec<StoredFile>,
    pub result: serde_json::Value,
}

impl Default for Made {
    fn default() -> Self {
        let (warnings, files, result) = (Vec::new(), Vec::new(), serde_json::Value::Null);
        Self { status: Status::Done, problem: None, warnings, files, result }
    }
}

impl Made {
    /// A recording that does not allow it.
    pub fn failed(problem: Problem) -> Self {
        Self { status: Status::Failed, problem: Some(problem), ..Self::default() }
    }
}

/// The file by which maps are compared.
const MESH: &str = "map/mesh.ply";

/// Calibration and poses.
pub(super) fn track(task: &Task<'_>) -> Result<Made, Error> {
    let (_scratch, folder) = task.scratch()?;
    let place = OutputLocation::Exact { path: folder.clone(), force: false };
    let outcome = parts::track(&task.run_request(place)?, task.events, task.cancel)?;
    task.require_planned(&outcome)?;
    let files = files_under(&folder)?;
    task.of_part(outcome, files, &folder, Stage::Track)
}

/// Depth of a part of the chunks. Each goes to the store as soon as it is whole, and those that an attempt before left there are
/// not predicted again.
pub(super) fn predict(task: &Task<'_>) -> Result<Made, Error> {
    let tracked = task.needs(Stage::Track, 0)?;
    if let Some(problem) = tracked.problem.clone().filter(|_| tracked.is_failed()) {
        return Ok(Made::failed(problem));
    }
    let (_scratch, folder) = task.scratch()?;
    task.restore(&tracked, &folder)?;
    let store = &task.request.store;
    let there = task.folder(Stage::Predict);
    for name in store.list(&there)? {
        let relative = name.strip_prefix(&there).unwrap_or(&name).trim_start_matches('/');
        if number(relative).is_some_and(|n| task.part.has(n)) {
            let target = inside(&folder, relative).ok_or_else(|| leads_outside(&name))?;
            make_parent(&target)?;
            store.get_file(&name, &target)?;
        }
    }
    let send = |_, files: &[PathBuf]| {
        for file in files {
            store.put_file(&format!("{there}/{}", relative(&folder, file)), file)?;
        }
        Ok(())
    };
    let place = OutputLocation::Resumed { path: folder.clone() };
    let outcome = parts::predict(&task.run_request(place)?, task.part, &send, task.events, task.cancel)?;
    task.require_planned(&outcome)?;
    let mut files = files_under(&folder)?;
    files.retain(|f| number(&relative(&folder, f)).is_some());
    let mut made = task.of_part(outcome, Vec::new(), &folder, Stage::Predict)?;
    made.files = files.iter().map(|f| stored(&folder, f)).collect::<Result<_, _>>()?;
    Ok(made)
}

/// Alignment, fusion, evaluation and files: what `vidar run --resume` does in a folder with the results of the stages before.
pub(super) fn map(task: &Task<'_>) -> Result<Made, Error> {
    let parts = (0..task.part.of).map(|part| task.needs(Stage::Predict, part));
    let before: Vec<TaskRecord> =
        std::iter::once(task.needs(Stage::Track, 0)).chain(parts).collect::<Result<_, _>>()?;
    if let Some(failed) = before.iter().find(|r| r.is_failed()) {
        return Ok(Made { status: Status::Failed, problem: failed.problem.clone(), ..Made::default() });
    }
    let (_scratch, folder) = task.scratch()?;
    before.iter().try_for_each(|record| task.restore(record, &folder))?;
    let request = task.run_request(OutputLocation::Resumed { path: folder.clone() })?;
    let outcome = run::run(&request, task.events, task.cancel)?;
    if outcome.status == ExitStatus::Interrupted {
        return Err(Error::Interrupted { path: folder });
    }
    let files = task.send(&files_under(&folder)?, &folder, Stage::Map)?;
    let result = result(&outcome, &files);
    Ok(Made { status: status(&outcome.warnings), warnings: outcome.warnings, files, result, problem: None })
}

/// What the table shows of a map.
fn result(outcome: &RunOutcome, files: &[StoredFile]) -> serde_json::Value {
    json!({
        "map_sha256": files.iter().find(|f| f.path == MESH).map(|f| &f.sha256),
        "keyframes": outcome.map.keyframes.len(),
        "keyframes_with_depth": outcome.map.views.len(),
        "mesh_triangles": outcome.map.surface.mesh.triangles.len(),
        "is_metric": outcome.is_metric(),
        "metric_poses": outcome.map.poses_json(),
        "verdict": outcome.verdict,
        "scale": outcome.scale,
        "scores": crate::evaluate::scores(&outcome.evaluation),
    })
}

fn status(warnings: &[Warning]) -> Status {
    match warnings.iter().any(|w| w.severity == Severity::Degraded) {
        true => Status::Degraded,
        false => Status::Done,
    }
}

impl Task<'_> {
    /// A new folder that goes with the task, and the run folder in it.
    fn scratch(&self) -> Result<(TempDir, PathBuf), Error> {
        let base = self.request.scratch.clone().unwrap_or_else(std::env::temp_dir);
        let made = tempfile::Builder::new().prefix("vidar-work-").tempdir_in(&base);
        let made = made.map_err(|e| Error::io("write", &base, e))?;
        let folder = made.path().join("run");
        Ok((made, folder))
    }

    fn run_request(&self, place: OutputLocation) -> Result<RunRequest, Error> {
        let Planned { uri, plan } = &self.request.planned;
        Ok(RunRequest {
            path: self.recording.path.clone(),
            open: self.request.open.clone(),
            layered: plan.layered(uri)?,
            reference: None,
            place,
            mcap: None,
            command: self.request.command.clone(),
        })
    }

    fn require_planned(&self, outcome: &PartOutcome) -> Result<(), Error> {
        if outcome.fingerprint == self.recording.sha256 {
            return Ok(());
        }
        let name = self.recording.path.display().to_string();
        Err(Error::NotABatch { name, reason: "the recording changed after it was planned: plan anew".into() })
    }

    fn of_part(
        &self,
        outcome: PartOutcome,
        files: Vec<PathBuf>,
        folder: &Path,
        stage: Stage,
    ) -> Result<Made, Error> {
        let files = self.send(&files, folder, stage)?;
        let result = json!({
            "images": outcome.images, "seconds": outcome.length.as_secs_f64(), "chunks": outcome.chunks,
        });
        Ok(Made {
            status: status(&outcome.warnings),
            warnings: outcome.warnings,
            files,
            result,
            problem: None,
        })
    }

    /// Copies files of the run folder to the store.
    fn send(&self, files: &[PathBuf], folder: &Path, stage: Stage) -> Result<Vec<StoredFile>, Error> {
        let to = self.folder(stage);
        let send = |file: &PathBuf| {
            let described = stored(folder, file)?;
            self.request.store.put_file(&format!("{to}/{}", described.path), file)?;
            Ok(described)
        };
        files.iter().map(send).collect()
    }

    /// Copies the results of a task into the run folder. A file that is not what its record says is refused.
    fn restore(&self, record: &TaskRecord, folder: &Path) -> Result<(), Error> {
        for file in &record.files {
            let name = format!("{}/{}", record.folder, file.path);
            let target = inside(folder, &file.path).ok_or_else(|| leads_outside(&name))?;
            make_parent(&target)?;
            self.request.store.get_file(&name, &target)?;
            if stored(folder, &target)? != *file {
                return Err(Error::NotABatch {
                    name,
                    reason: "it is not what its record says: it is damaged".into(),
                });
            }
        }
        Ok(())
    }
}

/// A path of a record or a store within the run folder; none where it leads out of it.
fn inside(folder: &Path, path: &str) -> Option<PathBuf> {
    let relative = Path::new(path);
    let is_plain =
        relative.components().count() > 0 && relative.components().all(|c| matches!(c, Component::Normal(_)));
    is_plain.then(|| folder.join(relative))
}

fn make_parent(file: &Path) -> Result<(), Error> {
    let parent = file.parent().unwrap_or(file);
    std::fs::create_dir_all(parent).map_err(|e| Error::io("create", parent, e))
}

fn leads_outside(name: &str) -> Error {
    Error::NotABatch { name: name.to_owned(), reason: "it leads out of the run folder".into() }
}

/// The chunk of `chunks/000004.npz`; none of other files, and of predictions of loops.
fn number(path: &str) -> Option<ChunkId> {
    let (stem, extension) = path.strip_prefix("chunks/")?.rsplit_once('.')?;
    ["npz", "json"].contains(&extension).then(|| stem.parse().ok().map(ChunkId)).flatten()
}

fn stored(folder: &Path, file: &Path) -> Result<StoredFile, Error> {
    let nobody = TransferCallbacks { progress: &|_| {}, cancel: &|| false };
    let (bytes, sha256) = vidar_hub::sha256_of(file, &nobody)?;
    Ok(StoredFile { path: relative(folder, file), bytes, sha256 })
}

/// With `/` on every system.
fn relative(folder: &Path, file: &Path) -> String {
    file.strip_prefix(folder).unwrap_or(file).to_string_lossy().replace('\\', "/")
}

/// Every file of the run folder, sorted.
fn files_under(folder: &Path) -> Result<Vec<PathBuf>, Error> {
    let unreadable = |e| Error::io("read", folder, e);
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(unreadable)? {
        let path = entry.map_err(unreadable)?.path();
        match path.is_dir() {
            true => found.extend(files_under(&path)?),
            false => found.push(path),
        }
    }
    found.sort();
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_path_of_a_record_leads_out_of_the_run_folder() {
        let folder = Path::new("/scratch/run");
        assert_eq!(inside(folder, "odometry/tracked.cbor").unwrap(), folder.join("odometry/tracked.cbor"));
        for path in ["../x", "/etc/passwd", "a/../../x", "", "./.."] {
            assert!(inside(folder, path).is_none(), "{path}");
        }
    }

    #[test]
    fn chunks_are_told_by_their_names() {
        assert_eq!(number("chunks/000012.npz"), Some(ChunkId(12)));
        for path in ["chunks/loop-000003-000001.npz", "chunks/000012.tmp", "000012.npz", "chunks/.json"] {
            assert_eq!(number(path), None, "{path}");
        }
    }
}
