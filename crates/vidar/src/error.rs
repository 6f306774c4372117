//! Errors that stop a run, each with a stable code, a location, a hint and an exit status.

mod codes;
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
    #[error("{name} has no calibration, and the recording does not show it: {reason}")]
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

    /// Stable code for scripts and for `vidar explain CODE`.
    pub fn code(&self) -> &'static str {
        match self {
            Self::UnknownKey { .. } => "E0101",
            Self::BadValue { .. } => "E0102",
            Self::ConfigFile { .. } => "E0103",
            Self::UnknownPreset { .. } => "E0104",
            Self::Usage { .. } => "E0105",
            Self::OutputExists { .. } => "E0106",
            Self::OtherRun { .. } => "E0107",
            Self::Recording(vidar_dataset::DatasetError::BadOption { .. }) => "E0105",
            Self::Recording(_) => "E0201",
            Self::NoMetricTrajectory { .. } => "E0202",
            Self::NoOverlap { .. } => "E0203",
            Self::TooFewKeyframes { .. } => "E0204",
            Self::Camera(_) => "E0205",
            Self::Trajectory(_) => "E0206",
            Self::NotARun { .. } => "E0207",
            Self::NoCalibration { .. } | Self::ImagesAlone { .. } | Self::NotCalibrated { .. } => "E0208",
            Self::NoOdometry { .. } => "E0209",
            Self::NotARecording { .. } => "E0210",
            Self::NotAMap { .. } => "E0211",
            Self::NotABatch { .. } => "E0212",
            Self::Store(vidar_store::StoreError::BadAddress { .. }) => "E0105",
            Self::Store(_) if self.file_system().is_some_and(is_full) => "E0402",
            Self::Store(_) => "E0406",
            Self::TaskTooEarly { .. } => "E0407",
            Self::Geometry(vidar_core::ModelError::OutOfReach(_)) => "E0409",
            Self::Link(error) => link::code(error),
            Self::Geometry(_) | Self::Stereo(_) => "E0301",
            Self::Hub(error) | Self::WeightsMissing(error) => hub_code(error),
            Self::Da3(vidar_da3::Da3Error::Cancelled) => "E1301",
            Self::Da3(error) if error.device_advice().is_some() => "E0311",
            Self::Da3(_) => "E0309",
            Self::Odometry(_) => "E0310",
            Self::Align(_) => "E0302",
            Self::Fusion(_) => "E0303",
            Self::Eval(_) => "E0304",
            Self::Empty { .. } | Self::Untrained { .. } => "E0305",
            Self::Export(_) | Self::View(_) | Self::Synth(_) | Self::Io { .. } => match self.file_system() {
                Some(source) if is_full(source) => "E0402",
                Some(_) => "E0401",
                None if matches!(self, Self::Export(_)) => "E0306",
                None if matches!(self, Self::View(_)) => "E0307",
                None => "E0308",
            },
            Self::Threshold(_) => "E0501",
            Self::Interrupted { .. } => "E1301",
        }
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

    /// The next step, where one is known.
    pub fn hint(&self) -> Option<String> {
        let text = match self {
            Self::UnknownKey { nearest: Some(nearest), .. } => {
                return Some(format!(
                    "did you mean {nearest:?}? `vidar config explain {nearest}` explains it"
                ));
            }
            Self::Usage { hint, .. } => return Some(hint.clone()),
            Self::NoOverlap { slip: Some(slip), .. } => {
                return Some(format!("{slip}; --time-unit s|ms|us|ns sets the unit of image times"));
            }
            Self::UnknownKey { .. } => "`vidar config show` lists every key",
            Self::BadValue { .. } => "`vidar config explain KEY` shows meaning, unit and range",
            Self::ConfigFile { .. } => "the file is TOML; `vidar config show > my.toml` writes a valid one",
            Self::UnknownPreset { .. } => "`vidar config presets` describes them",
            Self::OutputExists { .. } => {
                "choose another name; --force renames an old folder that is given with -o"
            }
            Self::OtherRun { .. } => {
                "resume with the command in its manifest.json, choose another -o, or use --force instead of --resume to rename \
                 the old folder"
            }
            Self::NoMetricTrajectory { .. } => {
                "give the poses of your own odometry with --trajectory FILE (TUM, EuRoC csv or KITTI, metres)"
            }
            Self::NoOverlap { .. } => {
                "check the trajectory's clock and unit; --time-unit s|ms|us|ns sets the unit of image times"
            }
            Self::TooFewKeyframes { .. } => {
                "lower keyframes.min_translation_m, or give a longer part of the sequence"
            }
            Self::Untrained { .. } => {
                "`vidar model pull da3-small` fetches trained weights (131 MiB, Apache-2.0) for --geometry da3-small; --geometry \
                 stereo needs none; --mode pose-conditioned runs the pipeline without meaningful results"
            }
            Self::Empty { .. } => {
                "check the images in depth/ of the run folder; try --preset quality, or another depth range"
            }
            Self::Geometry(vidar_core::ModelError::OutOfReach(_)) => {
                "start a `vidar worker`, then run the same command with --resume: what is predicted is kept"
            }
            Self::Link(error) => link::hint(error),
            Self::NotABatch { .. } => {
                "`vidar plan RECORDINGS… --store FOLDER` writes a plan and prints its address"
            }
            Self::TaskTooEarly { .. } => {
                "run the stages of a plan in their order: track, predict, map, report"
            }
            other if other.file_system().is_some_and(is_full) => {
                "free space, or choose another disk with -o; finished files are kept"
            }
            other if other.file_system().is_some() => "check that the path exists and may be written",
            Self::NotCalibrated { .. } => {
                "turn the camera about all axes for some seconds while it sees texture, or give --calibration FILE (EuRoC \
                 sensor.yaml, Kalibr camchain)"
            }
            Self::NoCalibration { .. } => {
                "give --calibration FILE (EuRoC sensor.yaml, Kalibr camchain) or --camera-model pinhole:fx,fy,cx,cy"
            }
            Self::ImagesAlone { .. } => {
                "`vidar depth PATH` estimates depth; `vidar run PATH --mode pose-free --geometry da3-nano` makes a map of it in a unit \
                 of its own; a metric map needs --camera-model pinhole:fx,fy,cx,cy (or --calibration FILE) and the poses of another \
                 odometry with --trajectory FILE"
            }
            Self::NoOdometry { .. } => {
                "move sideways at the start; `vidar odometry PATH` writes the state at every image to odometry/health.csv"
            }
            Self::Store(vidar_store::StoreError::BadAddress { .. }) => {
                "--store takes a folder, and s3://bucket/prefix where the program was built with --features s3"
            }
            Self::Store(_) => {
                "check the address, the network and the rights of this worker; what is finished stays, and the same command goes on"
            }
            Self::Camera(_) => {
                "check fx, fy, cx, cy and the distortion in the calibration, or give --camera-model"
            }
            Self::Trajectory(_) => {
                "--trajectory-body imu|camera0 sets the body whose poses they are; --calibration gives the rig"
            }
            Self::Export(_) => "the message names the position in the file; write it again with its program",
            Self::Synth(_) => "`vidar synth --help` lists the options; --world-config takes all settings",
            Self::Odometry(_) => {
                "`vidar inspect PATH` prints camera, extrinsics and IMU as they were read; --calibration corrects them"
            }
            Self::Threshold(_) => "`vidar eval RUN` shows every score",
            Self::Eval(_) => "check that both are of the same recording, body and clock",
            Self::NotARecording { .. } => {
                "docs/guides/recorded-geometry.md describes the format; --stride, --start, geometry.chunk_keyframes and \
                 geometry.overlap_keyframes must be those of the recording"
            }
            Self::NotAMap { .. } => {
                "--map takes the folder that `vidar odometry` or `vidar run` left, of this version; it holds odometry/map.cbor"
            }
            Self::NotARun { .. } => "a run folder contains manifest.json; `vidar run PATH` creates one",
            Self::Recording(error) => return Some(dataset_hint(error).to_owned()),
            Self::Hub(error) => return error.hint(),
            // Every command that opens a network has --model.
            Self::WeightsMissing(error) => {
                return error
                    .hint()
                    .map(|hint| format!("{hint}; --model da3-nano is built in and needs no download"));
            }
            Self::Da3(error) if let Some(advice) = error.device_advice() => advice,
            Self::Da3(_) => {
                "`vidar model list` describes the networks; docs/guides/models.md states what each one needs"
            }
            _ => return None,
        };
        Some(text.to_owned())
    }
}

/// The code of a checkpoint error.
fn hub_code(error: &vidar_hub::HubError) -> &'static str {
    use vidar_hub::HubError as H;
    match error {
        H::UnknownModel { .. } | H::WrongLicence { .. } | H::BadSetting { .. } => "E0105",
        H::LicenceNotAccepted { .. } => "E0404",
        H::WrongSize { .. } | H::WrongHash { .. } | H::BadRecord { .. } | H::NotACheckpoint { .. } => "E0405",
        H::Io { source, .. } if is_full(source) => "E0402",
        H::Io { .. } => "E0401",
        H::NoSpace { .. } => "E0402",
        H::Cancelled => "E1301",
        _ => "E0403",
    }
}

/// The hint for an error in a recording.
fn dataset_hint(error: &vidar_dataset::DatasetError) -> &'static str {
    use vidar_dataset::DatasetError as D;
    match error {
        D::Io { .. } => "check the path and its read permission",
        D::UnknownLayout { .. } => "--format sets the layout; docs/getting-started.md describes each one",
        D::Malformed { .. } => "repair or remove that line; the file may be truncated or in another format",
        D::MissingCamera { .. } => "choose an available camera with --camera N",
        D::NoImages { .. } => "check --start, --end and --stride, and that the listed images exist",
        D::NoPoses { .. } => "--trajectory-format tum|euroc|kitti sets the format",
        D::BadCamera { .. } | D::UnsupportedCamera { .. } => {
            "correct the calibration, or replace it with --camera-model or --calibration FILE"
        }
        D::NotRigid { .. } => "the matrix maps sensor to body coordinates; its rotation must be orthonormal",
        D::BadImage { .. } => "the image may be truncated; copy the recording again",
        D::WrongImageSize { .. } => {
            "the calibration is for another resolution; give the one for these images"
        }
        D::Topics { .. } => "--topic NAME names a topic of images, depth or IMU; repeatable",
        D::WrongThing { .. } | D::Bag(_) | D::Video(_) => {
            "docs/recordings describes what is read, one page for each source"
        }
        D::TimesMismatch { .. } => "give one time per pose with --timestamps, or the trajectory as TUM",
        D::BadOption { .. } => "`vidar run --help` lists the values of each option",
        _ => "`vidar inspect PATH` shows what was found",
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
