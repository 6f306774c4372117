//! Why a synthetic sequence cannot be made.

use std::path::{Path, PathBuf};
use thiserror::Error;
use vidar_core::{CameraError, TrajectoryError};

/// Why a synthetic sequence cannot be made.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum SynthError {
    /// A key of the configuration is outside its domain.
    #[error("synth.{key} must be {expected}, found {found}")]
    BadConfig {
        /// The key, as written in the configuration.
        key: &'static str,
        /// What it must be.
        expected: &'static str,
        /// The value found.
        found: String,
    },
    /// The given trajectory cannot be flown.
    #[error("the trajectory cannot be flown: {reason}")]
    BadTrajectory {
        /// What is wrong with it, with numbers.
        reason: String,
    },
    /// The given trajectory cannot be converted to the body (IMU) frame.
    #[error("the trajectory cannot be moved to the body frame: {0}")]
    Frame(#[from] TrajectoryError),
    /// The camera of this size cannot be made.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// The output folder already holds a sequence.
    #[error("{path} exists already; choose another folder or remove it first")]
    OutputExists {
        /// What is in the way.
        path: PathBuf,
    },
    /// A file or folder cannot be written (no permission, no space, …).
    #[error("cannot write {path}: {source}")]
    Write {
        /// Which file or folder.
        path: PathBuf,
        /// The system's message.
        source: std::io::Error,
    },
    /// A file of a written sequence cannot be read.
    #[error("cannot read {path}: {source}")]
    Read {
        /// Which file.
        path: PathBuf,
        /// The system's message.
        source: std::io::Error,
    },
    /// A file is not one that a sequence was written with.
    #[error("{path}: {reason}")]
    BadSequence {
        /// Which file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The configuration cannot be written as TOML.
    #[error("cannot write the configuration as TOML: {0}")]
    Toml(#[from] toml::ser::Error),
    /// The caller asked to stop; nothing was left behind.
    #[error("cancelled")]
    Cancelled,
}

impl SynthError {
    /// A `Write` error at `path`.
    pub(crate) fn write(path: &Path) -> impl FnOnce(std::io::Error) -> Self + '_ {
        move |source| Self::Write { path: path.to_path_buf(), source }
    }
}
