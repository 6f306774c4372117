//! Spectacular AI and AaltoML: `data.jsonl` beside `data.mp4` (and `data2.mp4`) or `frames1/`, and `calibration.json`.

use crate::draft::{Draft, DraftCamera};
use crate::error::DatasetError;
use crate::folder::{images_in, names_in};
use crate::inertial::{median_rate_hz, to_specific_force};
use crate::options::{OpenOptions, RecordingKind};
use crate::parse::{self, JsonPose, JsonRecording, Source};
use crate::phone;
use crate::recording::CalibrationSource;
use crate::source::for_each_block;
use crate::stray_scanner::recorded_poses;
use crate::video::take_frames;
use crate::wrong_thing;
use std::path::{Path, PathBuf};
use vidar_core::{BodyFrame, LieGroup, StampedPose, Timestamp, Trajectory, Warning, merge_imu};
use vidar_video::{Video, VideoDecoder};

/// Looks for the layout at `path`.
pub(crate) fn detect(path: &Path) -> Option<String> {
    let list = path.join("data.jsonl");
    let head = wrong_thing::head_of(&list).ok()?;
    let is_json = head.trim_ascii_start().starts_with(b"{");
    (is_json && (0..2).any(|camera| pictures_of(path, camera).is_some()))
        .then(|| "data.jsonl beside its pictures".into())
}

/// Where the pictures of a camera are: the video `data.*` (`data2.*`), else the folder `frames1` (`frames2`).
enum Pictures {
    Video(PathBuf),
    Folder(PathBuf),
}

fn pictures_of(path: &Path, camera: u32) -> Option<Pictures> {
    let stem = if camera == 0 { "data".to_string() } else { format!("data{}", camera + 1) };
    let is_video = |name: &&String| {
        let (found, ending) = name.rsplit_once('.').unwrap_or((name, ""));
        found == stem
            && ["mp4", "mov", "m4v", "mkv", "avi", "webm"].contains(&ending.to_ascii_lowercase().as_str())
    };
    let names = names_in(path).ok()?;
    if let Some(name) = names.iter().find(is_video) {
        return Some(Pictures::Video(path.join(name)));
    }
    let folder = path.join(format!("frames{}", camera + 1));
    folder.is_dir().then_some(Pictures::Folder(folder))
}

/// Reads the layout.
pub(crate) fn open(path: &Path, reason: String, options: &OpenOptions) -> Result<Draft, DatasetError> {
    let number = options.camera.0;
    let Some(pictures) = pictures_of(path, number) else {
        let found = (0..4u32).filter(|&n| pictures_of(path, n).is_some()).map(|n| format!("camera {n}"));
        let found = found.collect::<Vec<_>>().join(", ");
        return Err(DatasetError::MissingCamera { path: path.to_path_buf(), camera: options.camera, found });
    };
    let mut draft = Draft::new(RecordingKind::SpectacularAi, path, reason);
    let list = path.join("data.jsonl");
    let mut recording = JsonRecording::default();
    for_each_block(&list, |block, lines_before| recording.add(block, lines_before, number))?;
    draft.text_files.push(list.clone());
    draft.image_list = list.clone();
    if let Some((count, line)) = recording.unread {
        let message = format!("{count} lines are no records; skipped");
        draft
            .warnings
            .push(Warning::degraded("record-unreadable", message).at(format!("{}:{line}", list.display())));
    }
    draft.cameras = vec![DraftCamera::unknown(number)];
    let quarter_turns = take_pictures(&mut draft, &recording, &pictures, &list, options)?;
    take_imu(&mut draft, &mut recording, &list);
    take_calibration(&mut draft, &recording, number, quarter_turns)?;
    let place = list.display().to_string();
    draft.ground_truth =
        trajectory(&mut draft.warnings, &recording.truth, "groundTruth", &place)?.map(|t| (t, list.clone()));
    if let Some((tracker, poses)) = &recording.tracked
        && let Some(found) = trajectory(&mut draft.warnings, poses, tracker, &place)?
    {
        draft.warnings.push(recorded_poses(tracker, &list));
        draft.trajectory = Some((found, list.clone()));
    }
    Ok(draft)
}

/// Pictures at the times of the log; returns the quarter turns of a video.
fn take_pictures(
    draft: &mut Draft,
    recording: &JsonRecording,
    pictures: &Pictures,
    list: &Path,
    options: &OpenOptions,
) -> Result<u8, DatasetError> {
    match pictures {
        Pictures::Video(file) => {
            let head = wrong_thing::head_of(file)?;
            if !vidar_video::is_video(&head) && options.decoder == VideoDecoder::BuiltIn {
                return Err(wrong_thing::describe(file, &head));
            }
            let video = Video::open_with(file, options.decoder)?;
            let turns = video.quarter_turns();
            let times: Vec<Timestamp> = recording.frames.iter().map(|f| f.0).collect();
            take_frames(draft, file, video, Some((&times, list)));
            Ok(turns)
        }
        Pictures::Folder(folder) => {
            // `%08d.png`; what the log does not number is taken in order.
            let names = images_in(folder)?;
            let by_number = |n: u64| names.iter().find(|name| crate::folder::frame_number(name) == Some(n));
            for (index, (time, number)) in recording.frames.iter().enumerate() {
                if let Some(name) = number.map_or_else(|| names.get(index), by_number) {
                    draft.images.push((*time, folder.join(name).into()));
                }
            }
            Ok(0)
        }
    }
}

fn take_imu(draft: &mut Draft, recording: &mut JsonRecording, list: &Path) {
    let (gyro, accel) = (&mut recording.gyro, &mut recording.accel);
    for (samples, what) in [(&mut *gyro, "gyroscope samples"), (&mut *accel, "accelerometer samples")] {
        crate::checks::put_in_order(samples, |s| s.0, what, list, &mut draft.warnings);
    }
    if gyro.is_empty() || !to_specific_force(accel, None, list, &mut draft.warnings) {
        return;
    }
    draft.imu = merge_imu(gyro, accel);
    let rate_hz = median_rate_hz(&draft.imu).unwrap_or(vidar_core::ImuNoise::EUROC.rate_hz);
    draft.assume_imu_noise("data.jsonl", rate_hz, &list.display().to_string());
}

/// `calibration.json`, else what the first frame states.
fn take_calibration(
    draft: &mut Draft,
    recording: &JsonRecording,
    number: u32,
    quarter_turns: u8,
) -> Result<(), DatasetError> {
    let file = draft.root.join("calibration.json");
    let (path, bytes) = match file.is_file() {
        true => (file.clone(), draft.read(&file)?),
        false => (draft.root.join("data.jsonl"), Vec::new()),
    };
    let source = Source { path: &path, bytes: &bytes };
    let listed = if file.is_file() { parse::json_calibration(&source)? } else { Vec::new() };
    let Some(stated) = listed.get(number as usize).or(recording.calibration.as_ref()) else {
        phone::assume_mount(draft, quarter_turns);
        return Ok(());
    };
    let (model, camera_from_imu) = (stated.model(&source)?, stated.camera_from_imu(&source)?);
    if quarter_turns != 0 {
        let message = "the video is turned, and its calibration may be that of the picture before the turn";
        draft.warnings.push(Warning::degraded("video-turned", message).at(path.display()));
    }
    let camera = &mut draft.cameras[0];
    camera.model = Some(model);
    camera.source = CalibrationSource::File(path.clone());
    match camera_from_imu {
        Some(motion) => camera.body_from_camera = motion.inverse(),
        None => phone::assume_mount(draft, quarter_turns),
    }
    Ok(())
}

/// Poses of the device, which the format relates to the IMU.
fn trajectory(
    notes: &mut Vec<Warning>,
    poses: &[JsonPose],
    what: &str,
    place: &str,
) -> Result<Option<Trajectory>, DatasetError> {
    let mut stamped: Vec<StampedPose> =
        poses.iter().filter_map(|&(time, pose)| Some(StampedPose { time, world_from_body: pose? })).collect();
    if stamped.len() < poses.len() {
        let message = format!(
            "{} poses of {what} are not finite or have no orientation; skipped",
            poses.len() - stamped.len()
        );
        notes.push(Warning::new("pose-not-finite", message).at(place));
    }
    if stamped.is_empty() {
        return Ok(None);
    }
    crate::checks::put_in_order(&mut stamped, |p| p.time, "poses", Path::new(place), notes);
    let message = format!("poses of {what} are those of \"the device\"; assumed: its IMU");
    notes.push(Warning::new("trajectory-body", message).at(place));
    Trajectory::new(BodyFrame::Imu, stamped)
        .map(Some)
        .map_err(|e| DatasetError::NoPoses { path: PathBuf::from(place), found: e.to_string() })
}
