//! Why a dataset cannot be read.

use std::path::{Path, PathBuf};
use thiserror::Error;
use vidar_core::{CameraError, CameraId};

/// Why a dataset cannot be read: which file and line, what was found there, what was expected.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum DatasetError {
    /// The operating system refused.
    #[error("cannot read {}: {source}", path.display())]
    Io {
        /// Which file or folder.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The path holds no known layout.
    #[error("{} is not a known dataset layout: found {found}; expected {expected}", path.display())]
    UnknownLayout {
        /// The path that was searched.
        path: PathBuf,
        /// What was found there.
        found: String,
        /// What was expected.
        expected: String,
    },
    /// A text file does not follow its format.
    #[error("{}:{line}: found {found}, expected {expected}", path.display())]
    Malformed {
        /// Which file.
        path: PathBuf,
        /// Line, counted from 1; 0 when the whole file is meant.
        line: usize,
        /// What is there.
        found: String,
        /// What should be there.
        expected: String,
    },
    /// The camera asked for is not in the dataset.
    #[error("{} has no camera {camera}; available: {found}", path.display())]
    MissingCamera {
        /// The dataset.
        path: PathBuf,
        /// The camera asked for.
        camera: CameraId,
        /// The cameras that are there.
        found: String,
    },
    /// No image is left.
    #[error("{}: no image {expected}: {found}", path.display())]
    NoImages {
        /// Where images were looked for.
        path: PathBuf,
        /// What was found instead.
        found: String,
        /// What was expected.
        expected: String,
    },
    /// No valid pose is left.
    #[error("{}: no valid pose: {found}", path.display())]
    NoPoses {
        /// Which file.
        path: PathBuf,
        /// What was found instead.
        found: String,
    },
    /// Camera parameters are singular or outside their domain.
    #[error("{}: {key}: {source}", path.display())]
    BadCamera {
        /// The calibration file, or `--camera-model`.
        path: PathBuf,
        /// Which entry.
        key: String,
        /// What is wrong.
        source: CameraError,
    },
    /// The calibration names a model that VIDAR does not support.
    #[error("{}: {key}: camera model {found} is not supported; expected {expected}", path.display())]
    UnsupportedCamera {
        /// The calibration file.
        path: PathBuf,
        /// Which entry.
        key: String,
        /// The model named.
        found: String,
        /// The models that can be read.
        expected: &'static str,
    },
    /// A matrix that must be a rigid motion is not.
    #[error(
        "{}: {key} is not a rigid motion: {found}; expected an orthonormal 3x3 block of determinant +1 and a last row 0 0 0 1",
        path.display()
    )]
    NotRigid {
        /// Which file.
        path: PathBuf,
        /// Which entry.
        key: String,
        /// How it deviates.
        found: String,
    },
    /// An image cannot be decoded.
    #[error("{}: cannot decode the image: {reason}", path.display())]
    BadImage {
        /// Which file.
        path: PathBuf,
        /// Why.
        reason: String,
    },
    /// An image has another size than its camera.
    #[error("{}: image is {found_width}x{found_height}, its camera is {expected_width}x{expected_height}", path.display())]
    WrongImageSize {
        /// Which file.
        path: PathBuf,
        /// Columns of the image.
        found_width: usize,
        /// Rows of the image.
        found_height: usize,
        /// Columns of the camera.
        expected_width: usize,
        /// Rows of the camera.
        expected_height: usize,
    },
    /// A file is larger than a reader loads into memory.
    #[error("{}: {found} bytes; the limit for such a file is {limit} bytes", path.display())]
    TooLarge {
        /// Which file.
        path: PathBuf,
        /// Its size.
        found: u64,
        /// The limit.
        limit: u64,
    },
    /// Poses without times (KITTI) need one time each.
    #[error("{}: {poses} poses without times, but {times} times are known; KITTI files need exactly one time per pose", path.display())]
    TimesMismatch {
        /// The pose file.
        path: PathBuf,
        /// Poses in it.
        poses: usize,
        /// Times known.
        times: usize,
    },
    /// A recording holds several topics of one kind, or not the one that was named.
    #[error("{}: {problem}; its topics:\n{topics}", path.display())]
    Topics {
        /// The recording.
        path: PathBuf,
        /// What is not clear, or missing.
        problem: String,
        /// Every topic with its type and count, a line each.
        topics: String,
    },
    /// The path is something that is known and is not a recording.
    #[error("{}: {found}; {way}", path.display())]
    WrongThing {
        /// What was given.
        path: PathBuf,
        /// What it is.
        found: String,
        /// The nearest way to a map.
        way: String,
    },
    /// A bag cannot be read.
    #[error(transparent)]
    Bag(#[from] vidar_bag::BagError),
    /// A video cannot be read.
    #[error(transparent)]
    Video(#[from] vidar_video::VideoError),
    /// An option has an invalid value.
    #[error("{option}: found {found}, expected {expected}")]
    BadOption {
        /// Which option.
        option: &'static str,
        /// The value.
        found: String,
        /// The valid values.
        expected: String,
    },
}

impl DatasetError {
    /// The file or folder that the error is about, where it is about one.
    pub fn path(&self) -> Option<&Path> {
        match self {
            Self::Io { path, .. }
            | Self::UnknownLayout { path, .. }
            | Self::Malformed { path, .. }
            | Self::MissingCamera { path, .. }
            | Self::NoImages { path, .. }
            | Self::NoPoses { path, .. }
            | Self::BadCamera { path, .. }
            | Self::UnsupportedCamera { path, .. }
            | Self::NotRigid { path, .. }
            | Self::BadImage { path, .. }
            | Self::WrongImageSize { path, .. }
            | Self::TooLarge { path, .. }
            | Self::TimesMismatch { path, .. }
            | Self::Topics { path, .. }
            | Self::WrongThing { path, .. } => Some(path),
            Self::Bag(_) | Self::Video(_) | Self::BadOption { .. } => None,
        }
    }
}

/// Makes an i/o error of `path`.
pub(crate) fn io_error(path: &Path) -> impl FnOnce(std::io::Error) -> DatasetError + '_ {
    move |source| DatasetError::Io { path: path.to_path_buf(), source }
}
