//! Files that are either complete or absent.
//!
//! The bytes go to a temporary file next to the target, which is renamed to the target only after everything was
//! written. A crash, a full disk or an error of the caller leaves the old file (or none) in place; the temporary
//! file is removed on every failure that this process survives.

use crate::error::ExportError;
use std::ffi::OsString;
use std::fs::{self, File, OpenOptions};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};

/// Durability of the file when the call returns.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Durability {
    /// Handed to the system: survives a crash of this process, not a power cut within seconds.
    #[default]
    Process,
    /// Flushed to the device before the rename (`fsync`), at the price of waiting for it.
    Device,
}

/// Writes `path` through `f`, all or nothing, without waiting for the device.
///
/// The error names `path` and the system's reason, also when the writer failed inside `f`.
pub fn write_atomically<T, E: From<ExportError>>(
    path: &Path,
    f: impl FnOnce(&mut dyn Write) -> Result<T, E>,
) -> Result<T, E> {
    write_atomically_with(path, Durability::Process, f)
}

/// Writes `bytes` as the whole file `path`, or nothing.
pub fn write_file_atomically(path: &Path, bytes: &[u8]) -> Result<(), ExportError> {
    write_atomically(path, |w| w.write_all(bytes).map_err(|source| file_error("write", path, source)))
}

/// Writes `path` through `f`, all or nothing, with the given durability.
pub fn write_atomically_with<T, E: From<ExportError>>(
    path: &Path,
    durability: Durability,
    f: impl FnOnce(&mut dyn Write) -> Result<T, E>,
) -> Result<T, E> {
    let (temporary, file) = create_sibling(path)?;
    // From here on the temporary file is removed unless the rename took it away.
    let guard = RemoveOnDrop(Some(temporary.clone()));
    let value = write_through(file, path, durability, f)?;
    fs::rename(&temporary, path).map_err(|source| file_error("rename to", path, source))?;
    guard.keep();
    Ok(value)
}

fn write_through<T, E: From<ExportError>>(
    file: File,
    path: &Path,
    durability: Durability,
    f: impl FnOnce(&mut dyn Write) -> Result<T, E>,
) -> Result<T, E> {
    let mut writer = ErrorRecordingWriter { inner: BufWriter::new(file), failure: None };
    let outcome = f(&mut writer).and_then(|value| {
        writer.flush().map_err(|source| file_error("write", path, source))?;
        if durability == Durability::Device {
            writer.inner.get_ref().sync_all().map_err(|source| file_error("flush", path, source))?;
        }
        Ok(value)
    });
    let failure = writer.failure.take();
    // Dropping a BufWriter flushes its buffer; after a failure it must not do that.
    let (file, _unwritten) = writer.inner.into_parts();
    drop(file);
    match (outcome, failure) {
        (Err(_), Some(source)) => Err(file_error("write", path, source).into()),
        (outcome, _) => outcome,
    }
}

fn file_error(action: &'static str, path: &Path, source: io::Error) -> ExportError {
    ExportError::File { action, path: path.to_path_buf(), source }
}

/// Opens a new file in the folder of `path`, under an unused name.
fn create_sibling(path: &Path) -> Result<(PathBuf, File), ExportError> {
    static COUNTER: AtomicU64 = AtomicU64::new(0);
    let Some(name) = path.file_name() else {
        let source = io::Error::new(io::ErrorKind::InvalidInput, "the path has no file name");
        return Err(file_error("create", path, source));
    };
    let mut last = io::Error::from(io::ErrorKind::AlreadyExists);
    // A name can only be in use by a leftover of an ended process with the same id; a few tries skip these.
    for _ in 0..64 {
        let mut temporary_name = OsString::from(".");
        temporary_name.push(name);
        let count = COUNTER.fetch_add(1, Ordering::Relaxed);
        temporary_name.push(format!(".{}-{count}.tmp", std::process::id()));
        let temporary = path.with_file_name(temporary_name);
        match OpenOptions::new().write(true).create_new(true).open(&temporary) {
            Ok(file) => return Ok((temporary, file)),
            Err(source) if source.kind() == io::ErrorKind::AlreadyExists => last = source,
            Err(source) => return Err(file_error("create", path, source)),
        }
    }
    Err(file_error("create", path, last))
}

/// Removes a file on drop, unless it is kept.
struct RemoveOnDrop(Option<PathBuf>);

impl RemoveOnDrop {
    fn keep(mut self) {
        self.0 = None;
    }
}

impl Drop for RemoveOnDrop {
    fn drop(&mut self) {
        if let Some(path) = self.0.take() {
            // If the temporary file cannot be removed, it is left there.
            let _ = fs::remove_file(path);
        }
    }
}

/// A writer that stores its first failure, so that the error can name the path.
struct ErrorRecordingWriter<W> {
    inner: W,
    failure: Option<io::Error>,
}

impl<W> ErrorRecordingWriter<W> {
    fn record_error<T>(&mut self, result: io::Result<T>) -> io::Result<T> {
        if let Err(error) = &result
            && self.failure.is_none()
            && error.kind() != io::ErrorKind::Interrupted
        {
            self.failure = Some(match error.raw_os_error() {
                Some(code) => io::Error::from_raw_os_error(code),
                None => io::Error::new(error.kind(), error.to_string()),
            });
        }
        result
    }
}

impl<W: Write> Write for ErrorRecordingWriter<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let result = self.inner.write(bytes);
        self.record_error(result)
    }

    fn flush(&mut self) -> io::Result<()> {
        let result = self.inner.flush();
        self.record_error(result)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(dir: &Path) -> Vec<String> {
        let mut names: Vec<_> = fs::read_dir(dir)
            .unwrap()
            .map(|e| e.unwrap().file_name().to_string_lossy().into_owned())
            .collect();
        names.sort();
        names
    }

    #[test]
    fn a_written_file_is_complete_and_alone_in_a_folder_with_a_strange_name() {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("Räume und Träume 部屋");
        fs::create_dir(&folder).unwrap();
        let path = folder.join("karte ä.txt");
        for (durability, text) in [(Durability::Process, "one"), (Durability::Device, "two")] {
            write_atomically_with(&path, durability, |w| {
                w.write_all(text.as_bytes()).map_err(crate::error::write_error("text"))
            })
            .unwrap();
            assert_eq!(fs::read_to_string(&path).unwrap(), text);
        }
        assert_eq!(names(&folder), ["karte ä.txt"]);
    }

    #[test]
    fn a_target_that_is_a_folder_is_not_changed() {
        let dir = tempfile::tempdir().unwrap();
        let target = dir.path().join("is-a-folder");
        fs::create_dir_all(target.join("x")).unwrap();
        let error = write_file_atomically(&target, b"bytes").unwrap_err();
        assert!(error.to_string().contains("is-a-folder"), "{error}");
        assert_eq!(names(dir.path()), ["is-a-folder"]);
    }

    #[test]
    fn a_failing_caller_leaves_the_old_file_and_no_temporary_one() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("map.ply");
        fs::write(&path, "old").unwrap();
        let result: Result<(), ExportError> = write_atomically(&path, |w| {
            w.write_all(b"half").map_err(crate::error::write_error("ply"))?;
            Err(ExportError::unwritable("ply", "vertex 3", "not finite"))
        });
        assert!(matches!(result, Err(ExportError::Unwritable { .. })));
        assert_eq!(fs::read_to_string(&path).unwrap(), "old");
        assert_eq!(names(dir.path()), ["map.ply"]);
    }

    #[test]
    fn a_panicking_caller_leaves_no_temporary_file() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("map.ply");
        let outcome = std::panic::catch_unwind(|| {
            write_atomically::<(), ExportError>(&path, |_| panic!("a bug in the caller"))
        });
        assert!(outcome.is_err());
        assert!(names(dir.path()).is_empty());
    }

    #[test]
    fn an_unwritable_path_is_reported_with_the_reason() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("file");
        fs::write(&file, "x").unwrap();
        let below_a_file = file.join("map.ply");
        let missing_folder = dir.path().join("missing").join("map.ply");
        let is_a_folder = dir.path().join("folder");
        fs::create_dir(&is_a_folder).unwrap();
        fs::write(is_a_folder.join("content"), "x").unwrap();
        for path in [below_a_file, missing_folder, is_a_folder, dir.path().join("..")] {
            let error = write_atomically::<(), ExportError>(&path, |_| Ok(())).unwrap_err();
            let text = error.to_string();
            assert!(matches!(error, ExportError::File { .. }), "{text}");
            assert!(text.contains(&path.display().to_string()), "{text}");
        }
        assert_eq!(names(dir.path()), ["file", "folder"]);
    }

    #[cfg(target_os = "linux")]
    #[test]
    fn a_full_device_is_reported_even_if_the_caller_returns_another_error() {
        let path = Path::new("/somewhere/map.ply");
        for durability in [Durability::Process, Durability::Device] {
            let full = OpenOptions::new().write(true).open("/dev/full").unwrap();
            // More than the buffer: the failure appears inside the caller's closure.
            let error = write_through::<(), ExportError>(full, path, durability, |w| {
                w.write_all(&[0; 1 << 20]).map_err(crate::error::write_error("ply"))
            })
            .unwrap_err();
            assert_full(&error);
            // Less than the buffer: it appears at the flush.
            let full = OpenOptions::new().write(true).open("/dev/full").unwrap();
            let error = write_through::<(), ExportError>(full, path, durability, |w| {
                w.write_all(b"few").map_err(crate::error::write_error("ply"))
            })
            .unwrap_err();
            assert_full(&error);
        }
    }

    #[cfg(target_os = "linux")]
    fn assert_full(error: &ExportError) {
        let ExportError::File { path, source, .. } = error else { panic!("{error}") };
        assert_eq!(path, Path::new("/somewhere/map.ply"));
        assert_eq!(source.kind(), io::ErrorKind::StorageFull);
    }
}
