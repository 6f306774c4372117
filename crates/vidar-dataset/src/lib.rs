//! Readers of EuRoC, TUM RGB-D, 7-Scenes and image folders into one time-ordered stream.
//!
//! [`open`] looks at a path, decides what it is, says why, and returns a [`Dataset`]: the rig, the lists of images
//! and depth images, the inertial readings, reference poses, and warnings about what is not quite right.
//!
//! The files may be anybody's: nothing here panics on them or allocates more than stated limits.

pub mod camera_flag;
mod dataset;
pub mod decode;
mod error;
mod events;
mod options;
mod source;

pub use camera_flag::{CameraFlag, with_size};
pub use dataset::{
    AccelSample, Anchor, CalibrationSource, DEPTH_TOLERANCE, Dataset, DepthEntry, DepthSensor, ImageEntry,
};
pub use error::DatasetError;
pub use options::{DatasetKind, OpenOptions, TimeUnit, TrajectoryFormat, TrajectoryReadOptions};

use std::path::Path;
use vidar_core::{Trajectory, Warning};

/// Opens the dataset at `path`.
pub fn open(path: &Path, options: &OpenOptions) -> Result<Dataset, DatasetError> {
    options.validate()?;
    Err(DatasetError::UnknownLayout {
        path: path.to_path_buf(),
        found: "nothing yet".into(),
        expected: "a reader".into(),
    })
}

/// Reads a trajectory file.
pub fn read_trajectory(
    path: &Path,
    _options: &TrajectoryReadOptions,
) -> Result<(Trajectory, Vec<Warning>), DatasetError> {
    Err(DatasetError::NoPoses { path: path.to_path_buf(), found: "nothing yet".into() })
}
