//! Errors that stop a run, each with a stable code, a location, a hint and an exit status.

mod codes;
mod hints;
mod link;

pub use codes::CODES;

use std::path::{Path, PathBuf};
use thiserror::Error;

/// Exit status of the program; the numbers are part of its interface.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ExitStatus {
    /// Success.
    Done = 0,
    /// The input or the data cannot be used.
    BadInput = 1,
    /// The command line or the configuration is wrong.
    Usage = 2,
    /// Finished, but part of the result is missing or uncertain.
    Degraded = 3,
    /// Weights, memory, disk or a device are missing.
    ResourceMissing = 4,
    /// A threshold given with `--fail-above` or `--fail-below` was missed.
    ThresholdFailed = 5,
    /// A bug in VIDAR.
    Bug = 70,
    /// Interrupted; what was finished is on disk.
    Interrupted = 130,
}

impl ExitStatus {
    /// Of a run that came to its end, or to an interruption with what was finished.
    pub(crate) fn of_run(is_interrupted: bool, is_degraded: bool) -> Self {
        match (is_interrupted, is_degraded) {
            (true, _) => Self::Interrupted,
            (false, true) => Self::Degraded,
            (false, false) => Self::Done,
        }
    }
}

/// Why a run stopped.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum Error {
    /// A configuration key does not exist.
    #[error("unknown configuration key {key:?} in {origin}")]
    UnknownKey {
        /// The key as given.
        key: String,
        /// The nearest existing key.
        nearest: Option<String>,
        /// Where it was given.
        origin: String,
    },
    /// A configuration value is of the wrong kind or out of range.
    #[error("configuration: {reason}")]
    BadValue {
        /// What was found and what is expected.
        reason: String,
    },
    /// A configuration file cannot be read.
    #[error("cannot read configuration {path}: {reason}", path = path.display())]
    ConfigFile {
        /// Which file.
        path: PathBuf,
        /// Why.
        reason: String,
    },
    /// No such preset.
    #[error("unknown preset {name:?}; presets are {known}")]
    UnknownPreset {
        /// The name as given.
        name: String,
        /// All names.
        known: String,
    },
    /// A command got an invalid argument.
    #[error("{what}")]
    Usage {
        /// What is wrong.
        what: String,
        /// What to do.
        hint: String,
    },
    /// The output folder exists and is not empty.
    #[error("output folder {path} exists", path = path.display())]
    OutputExists {
        /// Which folder.
        path: PathBuf,
    },
    /// A folder to resume in holds another run.
    #[error("cannot resume in {path}: {difference}", path = path.display())]
    OtherRun {
        /// Which folder.
        path: PathBuf,
        /// What differs.
        difference: String,
    },
    /// The input cannot be read.
    #[error(transparent)]
    Recording(#[from] vidar_dataset::DatasetError),
    /// No metric poses.
    #[error("{name} has no metric trajectory: no IMU, no --trajectory and no ground truth")]
    NoMetricTrajectory {
        /// Name of the recording.
        name: String,
    },
    /// The camera model is only guessed, which gives no metric map.
    #[error("{name} has no calibration: the camera model is only guessed from the image size")]
    NoCalibration {
        /// Name of the recording.
        name: String,
    },
    /// Images alone: neither a calibration nor what would show it.
    #[error(
        "{name} has neither a calibration nor an IMU that would show it: images alone give depth without scale"
    )]
    ImagesAlone {
        /// Name of the recording.
        name: String,
    },
    /// The recording does not show its calibration.
    #[error("the calibration of {name} cannot be found from the recording: {reason}")]
    NotCalibrated {
        /// Name of the recording.
        name: String,
        /// What is missing.
        reason: String,
    },
    /// Camera and IMU gave no metric poses.
    #[error("the odometry of {name} never initialised: {reason}")]
    NoOdometry {
        /// Name of the recording.
        name: String,
        /// What was missing.
        reason: String,
    },
    /// Images and trajectory do not overlap in time.
    #[error("no image has a pose: images span {images}, the trajectory spans {poses}")]
    NoOverlap {
        /// Time range of the images, s.
        images: String,
        /// Time range of the poses, s.
        poses: String,
        /// The likely cause, if the ratio of both is that of two units of time.
        slip: Option<&'static str>,
    },
    /// Too few keyframes for depth.
    #[error("{found} keyframes with poses, at least {needed} are needed")]
    TooFewKeyframes {
        /// Keyframes found.
        found: usize,
        /// Keyframes needed.
        needed: usize,
    },
    /// The geometry model failed.
    #[error("geometry: {0}")]
    Geometry(#[from] vidar_core::ModelError),
    /// A checkpoint is missing, invalid, or could not be fetched.
    #[error("model: {0}")]
    Hub(#[from] vidar_hub::HubError),
    /// The weights of the chosen network are not installed.
    #[error("model: {0}")]
    WeightsMissing(vidar_hub::HubError),
    /// The network rejected its weights or its input.
    #[error("network: {0}")]
    Da3(#[from] vidar_da3::Da3Error),
    /// The stereo model rejected its configuration.
    #[error("stereo: {0}")]
    Stereo(#[from] vidar_stereo::StereoError),
    /// The odometry rejected its rig, its configuration or an image.
    #[error("odometry: {0}")]
    Odometry(#[from] vidar_odometry::OdometryError),
    /// A chunk could not be placed.
    #[error("align: {0}")]
    Align(#[from] vidar_align::AlignError),
    /// Fusion failed.
    #[error("fusion: {0}")]
    Fusion(#[from] vidar_fusion::FusionError),
    /// Evaluation failed.
    #[error("evaluation: {0}")]
    Eval(#[from] vidar_eval::EvalError),
    /// A file format could not be written or read.
    #[error("{0}")]
    Export(#[from] vidar_export::ExportError),
    /// A picture could not be made.
    #[error("picture: {0}")]
    View(#[from] vidar_view::ViewError),
    /// A synthetic world could not be made.
    #[error("synthetic world: {0}")]
    Synth(#[from] vidar_synth::SynthError),
    /// Nothing was reconstructed.
    #[error("nothing was reconstructed from {keyframes} keyframes: {reason}")]
    Empty {
        /// Keyframes tried.
        keyframes: usize,
        /// The reason of the last chunk.
        reason: String,
    },
    /// Nothing was reconstructed, as expected with synthetic weights.
    #[error(
        "nothing was reconstructed from {keyframes} keyframes: {model} has synthetic weights, so its depth and cameras are \
         noise, and no chunk could be aligned to the metric poses"
    )]
    Untrained {
        /// Keyframes tried.
        keyframes: usize,
        /// The network.
        model: String,
    },
    /// A camera or view cannot be made.
    #[error("camera: {0}")]
    Camera(#[from] vidar_core::CameraError),
    /// A trajectory cannot be converted to the required frame.
    #[error("trajectory: {0}")]
    Trajectory(#[from] vidar_core::TrajectoryError),
    /// The file system reported an error.
    #[error("cannot {action} {path}: {source}", path = path.display())]
    Io {
        /// The action that failed.
        action: &'static str,
        /// Path of the file.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// A folder is not a run folder of this program.
    #[error("{path} is not a run folder: {reason}", path = path.display())]
    NotARun {
        /// Which folder.
        path: PathBuf,
        /// What is missing.
        reason: String,
    },
    /// A recorded prediction cannot be used.
    #[error("{path}: {reason}", path = path.display())]
    NotARecording {
        /// Which file or folder.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The map of an earlier recording cannot be used.
    #[error("cannot use the map {path}: {reason}", path = path.display())]
    NotAMap {
        /// Which file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
    /// The store of a batch cannot be used.
    #[error("{0}")]
    Store(#[from] vidar_store::StoreError),
    /// Other machines cannot be reached, or are not what was asked for.
    #[error("{0}")]
    Link(#[from] vidar_link::LinkError),
    /// The plan of a batch, or a record of one of its tasks, cannot be used.
    #[error("{name}: {reason}")]
    NotABatch {
        /// The plan or the record.
        name: String,
        /// What is wrong with it.
        reason: String,
    },
    /// A task of a batch needs results that are not there.
    #[error("{task} cannot start: {missing}")]
    TaskTooEarly {
        /// The task.
        task: String,
        /// What is missing.
        missing: String,
    },
    /// A threshold was missed.
    #[error("{0}")]
    Threshold(String),
    /// The user asked to stop.
    #[error("interrupted; what was finished is in {path}", path = path.display())]
    Interrupted {
        /// The run folder, or the current folder.
        path: PathBuf,
    },
}

impl Error {
    /// An I/O error with its path and action.
    pub fn io(action: &'static str, path: &Path, source: std::io::Error) -> Self {
        Self::Io { action, path: path.to_owned(), source }
    }

    /// The file system's error, from any stage.
    fn file_system(&self) -> Option<&std::io::Error> {
        use vidar_export::ExportError as Export;
        match self {
            Self::Io { source, .. }
            | Self::Hub(vidar_hub::HubError::Io { source, .. })
            | Self::Export(Export::Write { source, .. } | Export::File { source, .. })
            | Self::Synth(vidar_synth::SynthError::Write { source, .. }) => Some(source),
            Self::Store(error) => error.io(),
            _ => None,
        }
    }

    /// What the error is about: a file or folder, with its line where one is known; or a configuration's origin.
    pub fn place(&self) -> Option<String> {
        use vidar_dataset::DatasetError;
        use vidar_export::ExportError as Export;
        let path = match self {
            Self::UnknownKey { origin, .. } => return Some(origin.clone()),
            Self::Recording(DatasetError::Malformed { path, line, .. }) => {
                return Some(format!("{}:{line}", path.display()));
            }
            Self::Recording(error) => error.path()?,
            Self::ConfigFile { path, .. }
            | Self::OutputExists { path }
            | Self::OtherRun { path, .. }
            | Self::Io { path, .. }
            | Self::NotARun { path, .. }
            | Self::NotARecording { path, .. }
            | Self::NotAMap { path, .. }
            | Self::Interrupted { path }
            | Self::Export(Export::File { path, .. }) => path,
            _ => return None,
        };
        Some(path.display().to_string())
    }

    /// The exit status for this error.
    pub fn exit_status(&self) -> ExitStatus {
        match self.code().as_bytes() {
            [b'E', b'0', b'1', ..] => ExitStatus::Usage,
            [b'E', b'0', b'4', ..] | b"E0311" => ExitStatus::ResourceMissing,
            [b'E', b'0', b'5', ..] => ExitStatus::ThresholdFailed,
            [b'E', b'1', ..] => ExitStatus::Interrupted,
            _ => ExitStatus::BadInput,
        }
    }
}

/// Whether the system reports that no space is left: a full disk, a quota, or a limit on the size of files.
pub fn is_full(error: &std::io::Error) -> bool {
    use std::io::ErrorKind::{FileTooLarge, QuotaExceeded, StorageFull};
    matches!(error.kind(), StorageFull | QuotaExceeded | FileTooLarge)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::ErrorKind::{FileTooLarge, NotFound, StorageFull};

    #[test]
    fn a_full_disk_is_the_same_error_in_every_stage() {
        let full = || std::io::Error::from(StorageFull);
        let path = || PathBuf::from("map/mesh.ply");
        let all = [
            Error::io("write", &path(), full()),
            Error::Export(vidar_export::ExportError::Write { format: "PLY", source: full() }),
            Error::Export(vidar_export::ExportError::File { action: "write", path: path(), source: full() }),
            Error::Synth(vidar_synth::SynthError::Write { path: path(), source: FileTooLarge.into() }),
        ];
        for error in all {
            assert_eq!((error.code(), error.exit_status() as i32), ("E0402", 4), "{error}");
            assert!(error.hint().is_some_and(|h| h.contains("finished files are kept")));
        }
        let other = Error::io("read", &path(), NotFound.into());
        assert_eq!((other.code(), other.exit_status() as i32), ("E0401", 4));
        assert_eq!(other.place().as_deref(), Some("map/mesh.ply"));
    }

    #[test]
    fn codes_are_listed_once() {
        let mut codes: Vec<&str> = CODES.iter().map(|(code, _)| *code).collect();
        codes.sort_unstable();
        let count = codes.len();
        codes.dedup();
        assert_eq!(codes.len(), count);
    }
}
