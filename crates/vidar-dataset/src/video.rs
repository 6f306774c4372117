//! Videos: frames with their times, and an action camera's gyroscope and accelerometer.

use crate::draft::Draft;
use crate::error::DatasetError;
use crate::folder::{images_in, names_in};
use crate::location::Location;
use crate::options::{OpenOptions, RecordingKind};
use crate::stabilised;
use crate::wrong_thing;
use nalgebra::Matrix3;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use vidar_core::{So3, Timestamp, Warning};
use vidar_video::{Telemetry, Video, VideoDecoder};

/// The video of a folder that holds one and no images.
pub(crate) fn only_one_in(folder: &Path) -> Option<(PathBuf, String)> {
    let mut videos = names_of_videos(folder);
    if videos.len() != 1 || !images_in(folder).ok()?.is_empty() {
        return None;
    }
    let name = videos.remove(0);
    Some((folder.join(&name), format!("its only video {name}")))
}

/// Whether a file with these first bytes is taken for a video: one that the built-in decoders may know, or whatever the
/// user's own program is to decode.
pub(crate) fn is_one(head: &[u8], options: &OpenOptions) -> bool {
    let is_for_program = options.decoder == VideoDecoder::Ffmpeg && wrong_thing::may_be_video(head);
    is_movie(head) || is_for_program
}

/// Whether it is an mp4 or mov.
pub(crate) fn is_movie(head: &[u8]) -> bool {
    vidar_video::is_video(head) && !wrong_thing::is_picture(head)
}

/// Names of videos in a folder, hidden files left out.
pub(crate) fn names_of_videos(folder: &Path) -> Vec<String> {
    let is_video = |name: &String| {
        let lower = name.to_ascii_lowercase();
        !name.starts_with('.') && [".mp4", ".mov", ".m4v"].iter().any(|ending| lower.ends_with(ending))
    };
    names_in(folder).unwrap_or_default().into_iter().filter(is_video).collect()
}

/// Reads the tables of a video and its telemetry; pictures stay in it.
pub(crate) fn open(path: &Path, reason: String, options: &OpenOptions) -> Result<Draft, DatasetError> {
    if options.camera.0 != 0 {
        let found = "camera 0 only".to_string();
        return Err(DatasetError::MissingCamera { path: path.to_path_buf(), camera: options.camera, found });
    }
    let video = Video::open_with(path, options.decoder)?;
    let mut draft = Draft::new(RecordingKind::Video, path, format!("{reason}; {}", video.codec_name()));
    if let Some(telemetry) = video.telemetry()? {
        take_telemetry(&mut draft, &video, telemetry);
    }
    take_frames(&mut draft, path, video, None);
    Ok(draft)
}

/// The frames of a video as the images of a recording: at the times of a log, in order, else at the video's own.
pub(crate) fn take_frames(
    draft: &mut Draft,
    path: &Path,
    video: Video,
    logged: Option<(&[Timestamp], &Path)>,
) {
    draft.warnings.extend(video.warnings().iter().cloned());
    let name: Arc<Path> = path.into();
    let frame = |(number, time)| (time, Location::Frame { video: Arc::clone(&name), number: number as u32 });
    draft.images = match logged {
        Some((times, log)) => {
            if times.len() != video.frame_count() {
                let message = format!(
                    "{} times for the {} frames of {}; they are matched in order, and the rest is left out",
                    times.len(),
                    video.frame_count(),
                    path.file_name().unwrap_or_default().to_string_lossy()
                );
                draft.warnings.push(Warning::degraded("frame-times", message).at(log.display()));
            }
            times.iter().copied().take(video.frame_count()).enumerate().map(frame).collect()
        }
        None => video.times().enumerate().map(frame).collect(),
    };
    draft.media.video = Some(Arc::new(video));
}

fn take_telemetry(draft: &mut Draft, video: &Video, telemetry: Telemetry) {
    if telemetry.imu.is_empty() {
        return;
    }
    let place = draft.root.display().to_string();
    let Telemetry { device, gyro_rate_hz, accel_rate_hz, .. } = &telemetry;
    let message = format!(
        "gyroscope at {gyro_rate_hz:.0} Hz and accelerometer at {accel_rate_hz:.0} Hz of {device:?}; camera and IMU have no \
         calibration, and their clocks differ by some tens of milliseconds"
    );
    let warning = Warning::new("telemetry", message).at(&place);
    draft.warnings.push(warning.hint("`vidar calibrate` finds camera, rotation and clock"));
    if telemetry.units != ["rad/s", "m/s\u{b2}"] {
        let message = format!("the telemetry's units are {:?}; rad/s and m/s² are assumed", telemetry.units);
        draft.warnings.push(Warning::degraded("telemetry-units", message).at(&place));
    }
    if !telemetry.axes_are_stated {
        let message =
            "the telemetry does not state its axes; those published for the first cameras (Z, X, Y) are used";
        draft.warnings.push(Warning::new("telemetry-axes", message).at(&place));
    }
    draft.imu = telemetry.imu;
    let frames: Vec<Timestamp> = video.times().collect();
    match stabilised::with_the_picture(&draft.imu, &frames, &telemetry.turns) {
        None => {}
        Some(Ok(turned)) => {
            let message = format!(
                "the picture is stabilised: the camera turned it by up to {:.1}° against itself and states how; gyroscope and accelerometer are \
                 turned with it",
                turned.largest_rad.to_degrees()
            );
            draft.warnings.push(Warning::new("video-stabilised", message).at(&place));
            draft.imu = turned.imu;
        }
        Some(Err(reason)) => {
            let message = format!(
                "the camera turned the picture against itself, and what it states of it is not used ({reason}): with electronic \
                 stabilisation the gyroscope does not describe the motion of the picture"
            );
            let warning = Warning::degraded("video-stabilised", message).at(&place);
            draft.warnings.push(warning.hint("switch stabilisation off to record for a map"));
        }
    }
    assume_mount(draft);
    draft.assume_imu_noise("a video", telemetry.gyro_rate_hz, &place);
}

/// Uses the mount of GoPro cameras on the axes that their telemetry names: image right is −X, down −Z, ahead −Y. It is that of a GoPro MAX
/// (from images and gyroscope); a HERO5 has gravity along Z, too. Which side the camera looks to is not stated.
fn assume_mount(draft: &mut Draft) {
    let axes = Matrix3::new(-1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, -1.0, 0.0);
    let Some(rotation) = So3::from_matrix(&axes) else { return };
    let message = "the telemetry states no pose of the camera on the IMU; that of a GoPro MAX is assumed, at the IMU's position";
    draft.assume_mount(rotation, message);
}
