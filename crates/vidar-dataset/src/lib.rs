#![doc = include_str!("../README.md")]

mod ahead;
mod arriving;
mod assemble;
mod bag;
mod bag_camera;
mod bag_video;
mod calibration;
pub mod camera_flag;
mod checks;
pub mod convert;
pub mod decode;
mod draft;
mod error;
mod euroc;
mod events;
mod folder;
mod image_folder;
mod imu_log;
mod inertial;
mod isolated;
mod kitti;
mod kitti_raw;
mod location;
mod options;
pub mod parse;
mod phone;
mod posed_folder;
mod recording;
mod rendered;
mod rig_checks;
mod seven_scenes;
mod source;
mod spectacular;
mod stabilised;
mod stray_scanner;
mod topics;
mod trajectory_file;
mod transforms;
mod tum_rgbd;
mod video;
mod wrong_thing;

pub use ahead::ImagesAhead;
pub use arriving::{Arrival, Arrivals, Arrived, ArrivingRecording, OPENING};
pub use camera_flag::{CameraFlag, with_size};
pub use checks::{gain_error_at_rest, specific_force_at_rest};
pub use error::DatasetError;
pub use events::EventCursor;
pub use isolated::is_decoding;
pub use location::Location;
pub use options::{
    OpenOptions, PoseUse, RecordingKind, TimeUnit, TopicFlag, TrajectoryFormat, TrajectoryReadOptions,
    body_named, decoder_named,
};
pub use recording::{
    AccelSample, CalibrationSource, DEPTH_TOLERANCE, DepthEntry, DepthSensor, ExternalTrajectory, ImageEntry,
    Recording,
};

pub use trajectory_file::{read_times, read_trajectory, trajectory_from};
pub use vidar_video::{DECODER_THREAD, VideoDecoder};

use std::path::Path;

/// Opens the dataset at `path`, in the format that the user names or else in the one that is detected.
///
/// Layouts are tried from the most to the least specific; [`Recording::reason`] states why one was chosen.
pub fn open(path: &Path, options: &OpenOptions) -> Result<Recording, DatasetError> {
    options.validate()?;
    if !options.imu.is_empty() {
        return imu_log::open(path, imu_log::named(path, options)?, options)?.finish(options);
    }
    if !path.is_dir() {
        return open_file(path, options);
    }
    let kinds = options.format.map_or(RecordingKind::ALL.to_vec(), |kind| vec![kind]);
    for kind in kinds {
        if let Some(draft) = try_kind(kind, path, options)? {
            return draft.finish(options);
        }
    }
    let names = folder::names_in(path)?;
    if let Some(error) = wrong_thing::describe_folder(path, &names) {
        return Err(error);
    }
    let shown = names.iter().take(6).map(String::as_str).collect::<Vec<_>>().join(", ");
    let found =
        if names.is_empty() { "an empty folder".into() } else { format!("{} entries: {shown}", names.len()) };
    Err(unknown(path, found))
}

/// Opens a recording in one file, by its first bytes.
fn open_file(path: &Path, options: &OpenOptions) -> Result<Recording, DatasetError> {
    let head = wrong_thing::head_of(path)?;
    if let Some(format) = vidar_bag::BagFormat::of_bytes(&head) {
        let reason = format!("its first bytes are those of {}", format.name());
        return bag::open(path, reason, options)?.finish(options);
    }
    if video::is_one(&head, options) {
        let first_bytes = if video::is_movie(&head) { "mp4 and mov" } else { "a video of another kind" };
        let mut draft = video::open(path, format!("its first bytes are those of {first_bytes}"), options)?;
        if path.parent().is_some_and(is_recording_of_phone) {
            let message = format!(
                "it is part of a phone's recording, whose sensors are read with the folder {}",
                path.with_file_name("").display()
            );
            draft.warnings.push(vidar_core::Warning::new("folder-beside", message).at(path.display()));
        }
        return draft.finish(options);
    }
    Err(wrong_thing::describe(path, &head))
}

/// Whether a folder holds more than the video that was given.
fn is_recording_of_phone(folder: &Path) -> bool {
    let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    stray_scanner::detect(folder).is_some()
        || spectacular::detect(folder).is_some()
        || imu_log::detect(folder).is_some()
}

/// Reads `path` as one kind; `None` when the path does not have that layout.
fn try_kind(
    kind: RecordingKind,
    path: &Path,
    options: &OpenOptions,
) -> Result<Option<draft::Draft>, DatasetError> {
    let single = |draft: Result<draft::Draft, DatasetError>| {
        // Only EuRoC's layout has more than one camera to choose from.
        let found = "camera 0 only".to_string();
        if options.camera.0 == 0 {
            draft.map(Some)
        } else {
            Err(DatasetError::MissingCamera { path: path.to_path_buf(), camera: options.camera, found })
        }
    };
    match kind {
        RecordingKind::EurocAsl => {
            euroc::detect(path).map(|found| euroc::open(path, found, options)).transpose()
        }
        RecordingKind::TumRgbd => {
            tum_rgbd::detect(path).map_or(Ok(None), |reason| single(tum_rgbd::open(path, reason, options)))
        }
        RecordingKind::SevenScenes => seven_scenes::detect(path)
            .map_or(Ok(None), |(folder, reason)| single(seven_scenes::open(&folder, reason, options))),
        RecordingKind::PosedFolder => posed_folder::detect(path)
            .map_or(Ok(None), |reason| single(posed_folder::open(path, reason, options))),
        RecordingKind::Bag => bag::detect(path).map(|reason| bag::open(path, reason, options)).transpose(),
        RecordingKind::Video => {
            let found = video::only_one_in(path);
            found.map(|(file, reason)| video::open(&file, reason, options)).transpose()
        }
        RecordingKind::StrayScanner => stray_scanner::detect(path)
            .map_or(Ok(None), |reason| single(stray_scanner::open(path, reason, options))),
        RecordingKind::SpectacularAi => {
            spectacular::detect(path).map(|reason| spectacular::open(path, reason, options)).transpose()
        }
        RecordingKind::ImuLog => {
            imu_log::detect(path).map_or(Ok(None), |log| single(imu_log::open(path, log, options)))
        }
        RecordingKind::KittiRaw => {
            kitti_raw::detect(path).map(|reason| kitti_raw::open(path, reason, options)).transpose()
        }
        RecordingKind::KittiOdometry => {
            kitti::detect(path).map(|reason| kitti::open(path, reason, options)).transpose()
        }
        RecordingKind::Replica => rendered::detect_replica(path)
            .map_or(Ok(None), |reason| single(rendered::open_replica(path, reason, options))),
        RecordingKind::IclNuim => rendered::detect_icl(path)
            .map_or(Ok(None), |reason| single(rendered::open_icl(path, reason, options))),
        RecordingKind::ImageFolder => image_folder::detect(path)
            .map_or(Ok(None), |(folder, reason)| single(image_folder::open(path, &folder, reason, options))),
    }
}

fn unknown(path: &Path, found: String) -> DatasetError {
    let expected = "mav0/cam0/data.csv (EuRoC, TUM-VI), rgb.txt (TUM RGB-D, ETH3D), frame-*.color.* (7-Scenes), \
                    image_00/data or image_0 with times (KITTI), results/frame* (Replica), associations.txt (ICL-NUIM), \
                    images/ with poses.txt, a bag (.bag, .mcap, .db3, metadata.yaml), a phone's recording (odometry.csv \
                    with rgb.mp4, data.jsonl, or a table of an IMU beside a video), or a folder of PNG or JPEG images";
    DatasetError::UnknownLayout { path: path.to_path_buf(), found, expected: expected.to_string() }
}
