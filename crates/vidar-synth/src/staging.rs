//! Output that appears whole or not at all.

use crate::error::SynthError;
use crate::simulation::{CONFIG_FILE, FLIGHT_FILE};
use crate::truth::TRUTH_FILE;
use std::path::{Path, PathBuf};

pub(crate) fn make_folder(path: &Path) -> Result<(), SynthError> {
    std::fs::create_dir_all(path).map_err(SynthError::write(path))
}

/// A hidden folder inside the output; removed when dropped.
pub(crate) struct Staging {
    out: PathBuf,
    pub(crate) folder: PathBuf,
    /// The topmost folder that had to be made for `out`.
    made: Option<PathBuf>,
}

impl Staging {
    pub(crate) fn new(out: &Path) -> Result<Self, SynthError> {
        let goal = out.join("mav0");
        if goal.symlink_metadata().is_ok() {
            return Err(SynthError::OutputExists { path: goal });
        }
        let made = out.ancestors().take_while(|a| !a.as_os_str().is_empty() && !a.exists()).last();
        let folder = out.join(format!(".synth-partial-{}", std::process::id()));
        let staging = Self { out: out.to_path_buf(), made: made.map(Path::to_path_buf), folder };
        make_folder(&staging.folder)?;
        Ok(staging)
    }

    /// Moves what was written to its place; `mav0` last, so that where it stands everything stands.
    pub(crate) fn publish(mut self) -> Result<(), SynthError> {
        for name in [FLIGHT_FILE, TRUTH_FILE, CONFIG_FILE, "mav0"] {
            let (made, goal) = (self.folder.join(name), self.out.join(name));
            if name != FLIGHT_FILE || made.exists() {
                std::fs::rename(made, &goal).map_err(SynthError::write(&goal))?;
            }
        }
        self.made = None;
        Ok(())
    }
}

impl Drop for Staging {
    fn drop(&mut self) {
        // Best effort: what cannot be removed cannot be reported from here either.
        let _ = std::fs::remove_dir_all(&self.folder);
        // Only folders that are empty again go, so that nobody else's file can.
        if let Some(made) = &self.made {
            for folder in self.out.ancestors().take_while(|a| a.starts_with(made)) {
                let _ = std::fs::remove_dir(folder);
            }
        }
    }
}
