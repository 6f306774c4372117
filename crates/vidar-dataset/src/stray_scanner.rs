//! Stray Scanner (iPhone and iPad with LiDAR): `rgb.mp4`, `odometry.csv`, `camera_matrix.csv`, `imu.csv`, `depth/`,
//! `confidence/`.
//!
//! After the recorder's documentation and source (strayrobots/scanner, docs/format.md). `odometry.csv` has a row for every frame of the
//! video: its time in the clock of the IMU, and ARKit's `world_from_camera` in the axes of computer vision; the world's y is up. Depth
//! is in millimetres, registered to the camera, in smaller pixels; where `confidence/` says "low" (0) it is none. The documentation says that the accelerometer is in m/s²; the
//! recorder writes Core Motion's values, which are in g and of the opposite sign, so gravity decides.

use crate::draft::{Draft, DraftDepth};
use crate::error::DatasetError;
use crate::folder::{first_file, frame_number, images_in};
use crate::inertial;
use crate::options::{OpenOptions, RecordingKind, TimeUnit};
use crate::parse::{self, NumberedPose, Source, UnitRule};
use crate::phone;
use crate::recording::CalibrationSource;
use crate::seven_scenes::checked_pinhole;
use crate::video::take_frames;
use nalgebra::Vector3;
use std::collections::HashMap;
use std::path::Path;
use vidar_core::{BodyFrame, CameraId, CameraModel, StampedPose, Timestamp, Trajectory, Warning};
use vidar_video::Video;

const VIDEOS: [&str; 2] = ["rgb.mp4", "rgb.mov"];

/// Looks for the layout at `path`.
pub(crate) fn detect(path: &Path) -> Option<String> {
    let has = |name: &str| path.join(name).is_file();
    let video = first_file(path, &VIDEOS)?;
    let name = video.file_name()?.to_string_lossy().into_owned();
    (has("odometry.csv") && has("camera_matrix.csv"))
        .then(|| format!("odometry.csv and camera_matrix.csv beside {name}"))
}

/// Reads the layout.
pub(crate) fn open(path: &Path, reason: String, options: &OpenOptions) -> Result<Draft, DatasetError> {
    let mut draft = Draft::new(RecordingKind::StrayScanner, path, reason);
    let list = path.join("odometry.csv");
    let bytes = draft.read(&list)?;
    let rule = UnitRule::given_or(options.time_unit, TimeUnit::Seconds);
    let (rows, notes) = parse::numbered_poses(&Source { path: &list, bytes: &bytes }, rule)?;
    draft.warnings.extend(notes);
    draft.image_list = list.clone();
    let times: Vec<Timestamp> = rows.iter().map(|r| r.time).collect();
    let file = first_file(path, &VIDEOS).unwrap_or_else(|| path.join(VIDEOS[0]));
    let video = Video::open_with(&file, options.decoder)?;
    let quarter_turns = video.quarter_turns();
    take_frames(&mut draft, &file, video, Some((&times, &list)));
    read_intrinsics(&mut draft, quarter_turns)?;
    let imu = path.join("imu.csv");
    if imu.is_file() {
        match inertial::imu_file_at(&imu)? {
            Some(table) => inertial::read_imu(&mut draft, &[table], options, "Stray Scanner")?,
            None => {
                let message = "its columns are not those of an IMU; it is not used";
                draft.warnings.push(Warning::degraded("imu-columns", message).at(imu.display()));
            }
        }
        phone::assume_mount(&mut draft, quarter_turns);
    }
    take_poses(&mut draft, &rows, &list)?;
    phone::check_vertical(&mut draft, Vector3::y());
    read_depth(&mut draft, &rows)?;
    Ok(draft)
}

fn read_intrinsics(draft: &mut Draft, quarter_turns: u8) -> Result<(), DatasetError> {
    let path = draft.root.join("camera_matrix.csv");
    let bytes = draft.read(&path)?;
    let intrinsics = parse::intrinsics_matrix(&Source { path: &path, bytes: &bytes })?;
    if quarter_turns != 0 {
        let message = "the video is turned, and its camera matrix may be that of the picture before the turn";
        draft.warnings.push(Warning::degraded("video-turned", message).at(path.display()));
    }
    let camera = &mut draft.cameras[0];
    camera.model = Some(CameraModel::Pinhole(checked_pinhole(intrinsics, &path)?));
    camera.source = CalibrationSource::File(path);
    Ok(())
}

/// ARKit's poses are the poses of the recording.
fn take_poses(draft: &mut Draft, rows: &[NumberedPose], list: &Path) -> Result<(), DatasetError> {
    let mut poses: Vec<StampedPose> = rows
        .iter()
        .filter_map(|r| Some(StampedPose { time: r.time, world_from_body: r.world_from_camera? }))
        .collect();
    let invalid = rows.len() - poses.len();
    if invalid > 0 {
        let message = format!("{invalid} poses are no rigid motions (tracking lost); skipped");
        draft.warnings.push(Warning::new("pose-not-finite", message).at(list.display()));
    }
    if poses.is_empty() {
        return Ok(());
    }
    crate::checks::put_in_order(&mut poses, |p| p.time, "poses", list, &mut draft.warnings);
    let trajectory = Trajectory::new(BodyFrame::Camera(CameraId(0)), poses)
        .map_err(|e| DatasetError::NoPoses { path: list.to_path_buf(), found: e.to_string() })?;
    draft.warnings.push(recorded_poses("ARKit", list));
    draft.trajectory = Some((trajectory, list.to_path_buf()));
    Ok(())
}

/// Says that the recorder's own poses are used.
pub(crate) fn recorded_poses(tracker: &str, place: &Path) -> Warning {
    let message =
        format!("the recording holds poses of {tracker}; a map uses them instead of VIDAR's own odometry");
    Warning::new("poses-recorded", message).at(place.display()).hint("--set input.poses=odometry tracks anew")
}

/// A depth image belongs to the row with its number.
fn read_depth(draft: &mut Draft, rows: &[NumberedPose]) -> Result<(), DatasetError> {
    let folder = draft.root.join("depth");
    if !folder.is_dir() {
        return Ok(());
    }
    let times: HashMap<u64, Timestamp> = rows.iter().map(|r| (r.frame, r.time)).collect();
    for name in images_in(&folder)? {
        if let Some(time) = frame_number(&name).and_then(|n| times.get(&n)) {
            draft.depths.push((*time, folder.join(name).into()));
        }
    }
    draft.media.depth_confidence = Some(draft.root.join("confidence")).filter(|folder| folder.is_dir());
    draft.depth = Some(DraftDepth {
        distorted: None,
        intrinsics: None,
        units_per_metre: Some(1000.0),
        default_units: 1000.0,
        body_from_depth: None,
        invalid: vec![0],
        is_registered: true,
    });
    Ok(())
}
