//! Writing a recording in another layout: MCAP with messages of ROS 2, or a folder in EuRoC's layout.
//!
//! What is written is what a [`Recording`] holds: the images of its chosen camera with their calibration, the IMU, depth and poses; times,
//! pixels and numbers stay as they are. What a layout has no place for is named in [`Converted::warnings`].

mod euroc;
pub(crate) mod facts;
mod mcap;

use crate::error::{DatasetError, io_error};
use crate::recording::{CalibrationSource, Recording};
use std::fmt;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use vidar_core::Warning;

/// Layouts that are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ConvertFormat {
    /// One MCAP file with messages of ROS 2.
    Mcap,
    /// A folder in EuRoC's layout.
    Euroc,
}

impl ConvertFormat {
    /// Every layout.
    pub const ALL: [Self; 2] = [Self::Mcap, Self::Euroc];

    /// The name used on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Mcap => "mcap",
            Self::Euroc => "euroc",
        }
    }

    /// The layout that a path's ending asks for: `.mcap`, else a folder.
    pub fn of_path(path: &Path) -> Self {
        let is_mcap = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("mcap"));
        if is_mcap { Self::Mcap } else { Self::Euroc }
    }
}

impl fmt::Display for ConvertFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for ConvertFormat {
    type Err = DatasetError;
    fn from_str(text: &str) -> Result<Self, DatasetError> {
        let found = Self::ALL.into_iter().find(|f| f.name().eq_ignore_ascii_case(text.trim()));
        found.ok_or_else(|| DatasetError::BadOption {
            option: "output layout",
            found: format!("{text:?}"),
            expected: "mcap or euroc".into(),
        })
    }
}

/// What was written.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Converted {
    /// Images of the chosen camera.
    pub images: usize,
    /// IMU samples.
    pub imu_samples: usize,
    /// Depth images.
    pub depths: usize,
    /// Reference poses.
    pub truth_poses: usize,
    /// Poses of the recording's own trajectory.
    pub trajectory_poses: usize,
    /// What the layout has no place for.
    pub warnings: Vec<Warning>,
}

/// Told after every image: how many are done, of how many. False ends the conversion.
pub type Progress<'a> = dyn Fn(usize, usize) -> bool + 'a;

/// Writes `dataset` to `out`, which must not exist. Nothing is left there when it fails.
pub fn convert(
    dataset: &Recording,
    out: &Path,
    format: ConvertFormat,
    progress: &Progress<'_>,
) -> Result<Converted, DatasetError> {
    if out.symlink_metadata().is_ok() {
        let source =
            std::io::Error::new(std::io::ErrorKind::AlreadyExists, "it exists; nothing is overwritten");
        return Err(io_error(out)(source));
    }
    let mut name = out.file_name().unwrap_or_default().to_os_string();
    name.push(".part");
    let part = out.with_file_name(name);
    let written = match format {
        ConvertFormat::Mcap => mcap::write(dataset, &part, progress),
        ConvertFormat::Euroc => euroc::write(dataset, &part, progress),
    };
    let finished = written.and_then(|done| {
        std::fs::rename(&part, out).map_err(io_error(out))?;
        Ok(done)
    });
    let mut converted = finished.inspect_err(|_| remove(&part))?;
    converted.warnings.extend(left_out(dataset, out));
    Ok(converted)
}

/// Removes what a failed conversion wrote; a second failure adds nothing to the first.
fn remove(part: &PathBuf) {
    let _ = if part.is_dir() { std::fs::remove_dir_all(part) } else { std::fs::remove_file(part) };
}

/// What neither layout carries.
fn left_out(dataset: &Recording, out: &Path) -> Vec<Warning> {
    let note = |kind: &str, message: String| Warning::new(kind, message).at(out.display());
    let mut notes = Vec::new();
    if dataset.rig.cameras.len() > 1 {
        let message = format!(
            "camera {} of {} is written; --camera chooses",
            dataset.camera,
            dataset.rig.cameras.len()
        );
        notes.push(note("convert-camera", message));
    }
    if dataset.calibration == CalibrationSource::Guessed {
        notes.push(note("convert-calibration", "the camera's model is a guess and is not written".into()));
    }
    if dataset.times_are_invented || dataset.warnings.iter().any(|w| w.kind == "times-synthesised") {
        let message = "image times are invented (30 Hz) and are written as if they were measured".to_string();
        notes.push(Warning::degraded("convert-times", message).at(out.display()));
    }
    if !dataset.accelerometer.is_empty() {
        notes.push(note("convert-accelerometer", "an accelerometer without gyroscope is not written".into()));
    }
    notes
}

/// The error of a conversion that was asked to end.
fn interrupted(out: &Path) -> DatasetError {
    io_error(out)(std::io::Error::new(std::io::ErrorKind::Interrupted, "interrupted"))
}
