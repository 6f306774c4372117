//! The codes of errors, and what each means, as `vidar explain` tells it.

use super::{Error, is_full, link};

/// Every error code with what it means, for `vidar explain` and the reference page.
pub const CODES: &[(&str, &str)] = &[
    (
        "E0101",
        "A configuration key does not exist. Keys are refused rather than ignored, because an ignored key would silently give a wrong result.",
    ),
    ("E0102", "A configuration value has the wrong type or lies outside its range."),
    ("E0103", "A configuration file is missing or is not valid TOML."),
    ("E0104", "The preset is not one of those that `vidar config presets` lists."),
    ("E0105", "The command line has an invalid option, argument or combination of them."),
    ("E0106", "The output exists. VIDAR never overwrites; --force renames an old folder."),
    ("E0107", "The folder given with --resume holds another run: its recording or its settings differ."),
    (
        "E0201",
        "The input path, a file in it, or its calibration cannot be used. The message names file, line, what was found and what was expected.",
    ),
    (
        "E0202",
        "There is no source of metric poses. One camera alone has no scale: give a trajectory in metres, or ground truth.",
    ),
    (
        "E0203",
        "Image times and pose times do not overlap: another clock, another unit, or another recording.",
    ),
    ("E0204", "Too few frames have a pose, or there is too little motion between them for depth."),
    ("E0205", "Camera parameters are invalid, or no undistorted view fits into the image."),
    ("E0206", "Poses belong to a body whose extrinsics are unknown."),
    ("E0207", "The folder lacks files of a run folder (manifest.json, views.json)."),
    (
        "E0208",
        "The images carry no calibration, and the recording does not show it: that takes a gyroscope and some seconds of turning. A camera guessed from the size of the images bends every surface, so no metric map is made with it.",
    ),
    (
        "E0209",
        "Camera and IMU gave no metric poses: the odometry never initialised; the message states the reason.",
    ),
    ("E0210", "A recorded prediction is missing, damaged, or belongs to other images."),
    (
        "E0211",
        "The map of an earlier recording (--map) cannot be read, is damaged, or is of another version.",
    ),
    (
        "E0212",
        "The plan of a batch, or the record of one of its tasks, cannot be read, is damaged, is of another version, or the recording changed after it was planned.",
    ),
    ("E0301", "The geometry model could not predict depth for any chunk."),
    ("E0302", "Predicted geometry could not be placed in the metric world."),
    ("E0303", "Fusion rejected its configuration or a view, or reached its memory limit."),
    ("E0304", "There is nothing to compare, or the inputs do not match (body, time, empty cloud)."),
    (
        "E0305",
        "Depth was computed but nothing passed confidence and consistency, or no chunk could be aligned to the metric poses. This is expected with synthetic weights (`…-untrained`), whose depth and cameras are noise.",
    ),
    ("E0306", "A file of an interchange format could not be written or read."),
    ("E0307", "A picture could not be drawn or encoded."),
    ("E0308", "The description of the synthetic world is not usable, or its files could not be written."),
    (
        "E0309",
        "A network cannot be opened or run: the checkpoint is not the one its config.json describes (each wrong key is listed), or the images or cameras are not suitable for it.",
    ),
    ("E0310", "The odometry rejected its settings, the camera-IMU extrinsics, or an image of another size."),
    (
        "E0311",
        "The requested graphics processor cannot be used: the program was built without GPU support, there is none with that number, it lacks a feature or memory, or it failed. --device cpu needs none.",
    ),
    ("E0401", "A file or folder could not be read or written."),
    ("E0402", "The disk is full. Finished files are kept; unfinished ones are removed."),
    (
        "E0403",
        "A checkpoint is not on this machine, and could not be fetched: no network, no access, no such file, or a server that does not respond. Partial downloads are kept and continued.",
    ),
    (
        "E0404",
        "The weights may not be used commercially, and the licence has not been accepted: --accept-licence records an acceptance.",
    ),
    ("E0405", "A checkpoint or its record is damaged, or is not the official one."),
    (
        "E0406",
        "The store of a batch could not be read or written. Nothing is half written; the same task may be tried again.",
    ),
    (
        "E0407",
        "A task of a batch was started before the tasks whose results it needs. It may be tried again when they are done.",
    ),
    (
        "E0408",
        "A link to other machines could not be opened or used: the program was built without it, or an endpoint cannot be listened at.",
    ),
    (
        "E0409",
        "No geometry worker answers, or none answers any more. Chunks that were predicted are kept; the same command with --resume goes on once a worker is there.",
    ),
    (
        "E0410",
        "The geometry workers are not what was asked for: another model, other weights, another licence than that of these weights, or workers that differ from each other.",
    ),
    ("E0501", "A threshold given with --fail-above or --fail-below was missed."),
    ("E7001", "A bug in VIDAR. Please report it; finished files are on disk."),
    ("E1301", "Interrupted by Ctrl-C or a signal. Files that were being written are finished or removed."),
];

impl Error {
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
