//! `vidar view`: a run, or an MCAP file that `--mcap` wrote, served to Foxglove on this computer.

use crate::error::Error;
use crate::export::{ExportOptions, ExportTarget, export_run};
use std::path::{Path, PathBuf};
use vidar_export::scene::{SceneServer, ServerError};

/// Something that is being served.
pub struct Viewer {
    /// The file that is played.
    pub file: PathBuf,
    server: SceneServer,
}

impl Viewer {
    /// Listens on `port` of this computer, for a run folder or a file; 0 takes any port that is free. Of a folder,
    /// `export/mcap/run.mcap` is made first.
    ///
    /// # Errors
    /// The path is neither, or cannot be read; the port is taken.
    pub fn open(path: &Path, port: u16) -> Result<Self, Error> {
        if !path.exists() {
            let reason = "there is no such file or folder".to_owned();
            return Err(Error::NotARun { path: path.to_owned(), reason });
        }
        let file = match path.is_dir() {
            true => {
                let out = path.join("export").join("mcap");
                let made = export_run(path, ExportTarget::Mcap, ExportOptions::default(), &out)?;
                made.into_iter().next().unwrap_or(out)
            }
            false => path.to_owned(),
        };
        let server = SceneServer::start(&file, port).map_err(|error| match error {
            ServerError::File(error) => Error::Export(error),
            ServerError::Port { .. } => Error::Usage {
                what: error.to_string(),
                hint: "choose another with --port; --port 0 takes any that is free".into(),
            },
        })?;
        Ok(Self { file, server })
    }

    /// The address that a viewer connects to.
    pub fn address(&self) -> String {
        self.server.address()
    }

    /// A link that opens Foxglove's page with this address.
    pub fn app_url(&self) -> String {
        self.server.app_url()
    }

    /// Plays until `stopped`.
    ///
    /// # Errors
    /// The file cannot be read any more.
    pub fn play(self, stopped: impl Fn() -> bool) -> Result<(), Error> {
        Ok(self.server.play(stopped)?)
    }
}
