//! A recording from standard input, written as `-`: copied to a temporary file, because readers go back and forth in it.

use std::fs::File;
use std::io::{IsTerminal, Read, Stdin};
use std::path::{Path, PathBuf};
use tempfile::TempDir;
use vidar::Error;

/// Most bytes that are taken from standard input: ten hours of a camera at 1.8 MB/s. A temporary folder seldom holds more.
const MAX_BYTES: u64 = 64 << 30;

/// Where a recording lies; a copy of standard input is removed with it.
pub struct Spooled {
    pub path: PathBuf,
    _copy: Option<TempDir>,
}

/// The recording at a path, or on standard input for `-`.
pub fn recording(path: &Path) -> Result<Spooled, Error> {
    if !is_standard_input(path) {
        return Ok(Spooled { path: path.to_owned(), _copy: None });
    }
    copy(standard_input()?.lock(), MAX_BYTES)
}

/// Whether a path stands for standard input.
pub fn is_standard_input(path: &Path) -> bool {
    path == Path::new("-")
}

/// Standard input, where something is sent into it.
pub fn standard_input() -> Result<Stdin, Error> {
    let input = std::io::stdin();
    if input.is_terminal() {
        let what = "`-` reads a recording from standard input, which is a terminal here".to_owned();
        return Err(Error::Usage {
            what,
            hint: "send a bag into it: cat drive.mcap | vidar inspect -".into(),
        });
    }
    Ok(input)
}

/// Refuses standard input where a recording is read again after the command: a run is resumed, evaluated and exported from it.
pub fn refuse(path: &Path) -> Result<(), Error> {
    if !is_standard_input(path) {
        return Ok(());
    }
    let what = "a run needs its recording again, and standard input is read only once".to_owned();
    Err(Error::Usage {
        what,
        hint:
            "write it to a file first, such as `vidar convert - drive.mcap`; `vidar live -` keeps what comes"
                .into(),
    })
}

fn copy(input: impl Read, limit: u64) -> Result<Spooled, Error> {
    let temporary = std::env::temp_dir();
    let folder =
        tempfile::Builder::new().prefix("vidar-").tempdir().map_err(|e| Error::io("write", &temporary, e))?;
    let path = folder.path().join("stdin");
    let mut file = File::create(&path).map_err(|e| Error::io("write", &path, e))?;
    let count =
        std::io::copy(&mut input.take(limit + 1), &mut file).map_err(|e| Error::io("write", &path, e))?;
    if count > limit {
        let what = format!("standard input holds more than {limit} bytes");
        return Err(Error::Usage { what, hint: "write it to a file and give that".into() });
    }
    Ok(Spooled { path, _copy: Some(folder) })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_copy_is_whole_bounded_and_removed() {
        let kept = copy(&b"seven b"[..], 7).unwrap();
        assert_eq!(std::fs::read(&kept.path).unwrap(), b"seven b");
        let path = kept.path.clone();
        drop(kept);
        assert!(!path.exists() && !path.parent().unwrap().exists());
        assert!(copy(&b"seven bytes"[..], 7).is_err());
        assert_eq!(recording(Path::new("a.bag")).unwrap().path, Path::new("a.bag"));
    }
}
