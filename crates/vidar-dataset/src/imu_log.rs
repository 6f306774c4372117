//! Loggers of phones: tables of gyroscope and accelerometer beside a video or a folder of frames.
//!
//! Known by what the tables hold, not by their names: MARS Logger (`gyro_accel.csv`, `movie.mp4`, `frame_timestamps.txt`,
//! `movie_metadata.csv`), OpenCamera Sensors (`VIDEO_gyro.csv`, `VIDEO_accel.csv`, `VIDEO_timestamps.csv`, in a folder beside the
//! video), Sensor Logger, and others whose header names its columns. Frames get the times of the log where there is one, because a
//! video's own begin at zero.

use crate::draft::Draft;
use crate::error::DatasetError;
use crate::folder::{images_in, names_in};
use crate::image_folder;
use crate::inertial::{ImuFile, imu_file_at, read_imu};
use crate::location::files;
use crate::options::{OpenOptions, RecordingKind};
use crate::parse::{self, Source, UnitRule};
use crate::phone;
use crate::recording::CalibrationSource;
use crate::video::{self, names_of_videos, take_frames};
use crate::wrong_thing;
use std::path::{Path, PathBuf};
use vidar_core::{CameraModel, Pinhole, Timestamp, Warning};
use vidar_video::Video;

/// Most tables of a folder that are looked at, and most folders beside the pictures.
const MAX_TABLES: usize = 64;
const MAX_FOLDERS: usize = 16;
/// Folders in which frames commonly lie.
const FRAMES: [&str; 6] = ["frames", "images", "rgb", "cam0", "color", "data"];

/// What was found of a logger's recording.
pub(crate) struct Log {
    tables: Vec<ImuFile>,
    /// The folder of the tables.
    folder: PathBuf,
    pictures: Pictures,
    reason: String,
}

enum Pictures {
    Video(PathBuf),
    Folder(PathBuf),
}

/// Looks for tables of an IMU beside pictures.
pub(crate) fn detect(path: &Path) -> Option<Log> {
    let pictures = pictures_in(path)?;
    let (folder, tables) = imu_tables(path)?;
    let mut names: Vec<String> = tables
        .iter()
        .map(|t| t.path.file_name().unwrap_or_default().to_string_lossy().into_owned())
        .collect();
    names.sort();
    let beside = match &pictures {
        Pictures::Video(file) => file.file_name().unwrap_or_default().to_string_lossy().into_owned(),
        Pictures::Folder(folder) => format!("images in {}", folder.display()),
    };
    let reason = format!("{} of gyroscope and accelerometer beside {beside}", names.join(" and "));
    Some(Log { tables, folder, pictures, reason })
}

/// The recording whose tables the user names: pictures at `path`, a video or a folder of either kind.
pub(crate) fn named(path: &Path, options: &OpenOptions) -> Result<Log, DatasetError> {
    let refuse = |path: &Path, found: &str, expected: &str| DatasetError::UnknownLayout {
        path: path.to_path_buf(),
        found: found.into(),
        expected: expected.into(),
    };
    let pictures = match path.is_dir() {
        true => pictures_in(path),
        false => {
            let is_video = video::is_one(&wrong_thing::head_of(path)?, options);
            is_video.then(|| Pictures::Video(path.to_path_buf()))
        }
    };
    let expected = "a video or a folder of images, where the IMU is in files of its own (--imu)";
    let pictures = pictures.ok_or_else(|| refuse(path, "another kind of recording", expected))?;
    let mut tables = Vec::new();
    for file in &options.imu {
        let expected = "a table with columns of a gyroscope, an accelerometer or both, with times";
        let table = imu_file_at(file)?;
        tables.push(table.ok_or_else(|| refuse(file, "no column of an IMU", expected))?);
    }
    let with = |has: &dyn Fn(&ImuFile) -> bool| tables.iter().filter(|t| has(t)).count();
    let (gyros, accels) = (with(&|t| t.columns.has_gyroscope()), with(&|t| t.columns.has_accelerometer()));
    if (gyros, accels) != (1, 1) {
        let found = format!("{gyros} tables of a gyroscope and {accels} of an accelerometer");
        return Err(refuse(
            &options.imu[0],
            &found,
            "one of each, in one file or in two (--imu FILE, twice)",
        ));
    }
    let folder = options.imu[0].parent().filter(|f| !f.as_os_str().is_empty()).unwrap_or(Path::new("."));
    Ok(Log {
        tables,
        folder: folder.to_path_buf(),
        pictures,
        reason: "the IMU's tables are named (--imu)".into(),
    })
}

fn pictures_in(path: &Path) -> Option<Pictures> {
    if let [only] = names_of_videos(path).as_slice() {
        return Some(Pictures::Video(path.join(only)));
    }
    let has_images = |folder: &PathBuf| images_in(folder).is_ok_and(|names| !names.is_empty());
    let folders = std::iter::once(path.to_path_buf()).chain(FRAMES.iter().map(|n| path.join(n)));
    folders.into_iter().find(has_images).map(Pictures::Folder)
}

/// The tables of one gyroscope and one accelerometer, in `path` or in the one folder under it that has them.
fn imu_tables(path: &Path) -> Option<(PathBuf, Vec<ImuFile>)> {
    if let Some(found) = tables_of(path) {
        return Some((path.to_path_buf(), found));
    }
    let inner =
        names_in(path).ok()?.into_iter().map(|n| path.join(n)).filter(|p| p.is_dir()).take(MAX_FOLDERS);
    let mut found = inner.filter_map(|folder| Some((tables_of(&folder)?, folder)));
    match (found.next(), found.next()) {
        (Some((tables, folder)), None) => Some((folder, tables)),
        _ => None,
    }
}

/// One table of both sensors, else one of each; `None` where a sensor is missing or it is not clear which table is meant.
fn tables_of(folder: &Path) -> Option<Vec<ImuFile>> {
    let is_table = |n: &String| {
        let lower = n.to_ascii_lowercase();
        !lower.starts_with('.') && (lower.ends_with(".csv") || lower.ends_with(".txt"))
    };
    let names = names_in(folder).ok()?.into_iter().filter(is_table).take(MAX_TABLES);
    let mut tables: Vec<ImuFile> =
        names.filter_map(|name| imu_file_at(&folder.join(name)).ok().flatten()).collect();
    // Raw copies and sensors without calibration or gravity are beside the same sensor's table.
    let is_side = |t: &ImuFile| {
        let name = t.path.file_name().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
        ["uncalibrated", "linear", "raw", "user", "magn"].iter().any(|word| name.contains(word))
    };
    if tables.iter().any(|t| !is_side(t)) {
        tables.retain(|t| !is_side(t));
    }
    let both = |t: &ImuFile| t.columns.has_gyroscope() && t.columns.has_accelerometer();
    if let Some(at) = tables.iter().position(both) {
        return Some(vec![tables.swap_remove(at)]);
    }
    let only = |has: &dyn Fn(&ImuFile) -> bool| {
        let mut found = tables.iter().filter(|t| has(t));
        found.next().filter(|_| found.next().is_none()).cloned()
    };
    let gyro = only(&|t| t.columns.has_gyroscope())?;
    let accel = only(&|t| t.columns.has_accelerometer())?;
    Some(vec![gyro, accel])
}

/// Reads the recording.
pub(crate) fn open(path: &Path, log: Log, options: &OpenOptions) -> Result<Draft, DatasetError> {
    let mut draft = Draft::new(RecordingKind::ImuLog, path, log.reason.clone());
    let tables: Vec<PathBuf> = log.tables.iter().map(|t| t.path.clone()).collect();
    let logged = logged_times(&mut draft, &log.folder, &tables, options)?;
    let mut quarter_turns = 0;
    match &log.pictures {
        Pictures::Video(file) => {
            let video = Video::open_with(file, options.decoder)?;
            quarter_turns = video.quarter_turns();
            match &logged {
                Some((times, list)) => take_frames(&mut draft, file, video, Some((times, list))),
                None => {
                    take_frames(&mut draft, file, video, None);
                    let message = "no log of frame times is known: the video's own begin at zero and need not be in the clock of the IMU";
                    let warning = Warning::degraded("frame-clock", message).at(file.display());
                    draft.warnings.push(warning.hint("--timestamps FILE gives the time of every frame"));
                }
            }
            draft.image_list = file.clone();
        }
        Pictures::Folder(folder) => read_folder(&mut draft, folder, logged.as_ref(), options)?,
    }
    read_imu(&mut draft, &log.tables, options, "a phone's logger")?;
    phone::assume_mount(&mut draft, quarter_turns);
    read_intrinsics_of_frames(&mut draft, &log.folder, quarter_turns)?;
    image_folder::read_intrinsics(&mut draft, path)?;
    Ok(draft)
}

/// Frames in a folder: times of the log where it has one for each, else those in their names.
fn read_folder(
    draft: &mut Draft,
    folder: &Path,
    logged: Option<&(Vec<Timestamp>, PathBuf)>,
    options: &OpenOptions,
) -> Result<(), DatasetError> {
    let names = images_in(folder)?;
    draft.image_list = folder.to_path_buf();
    if let Some((times, list)) = logged {
        if times.len() == names.len() {
            let timed = times.iter().copied().zip(&names).map(|(t, n)| (t, folder.join(n))).collect();
            draft.images = files(timed);
            return Ok(());
        }
        let message =
            format!("{} times for {} images; the names of the images are used", times.len(), names.len());
        draft.warnings.push(Warning::degraded("frame-times", message).at(list.display()));
    }
    let by_name = image_folder::images_by_name(draft, folder, &names, options);
    draft.images = files(by_name);
    Ok(())
}

/// The times of the frames and their file: the user's, else the log that lies beside the tables.
fn logged_times(
    draft: &mut Draft,
    folder: &Path,
    tables: &[PathBuf],
    options: &OpenOptions,
) -> Result<Option<(Vec<Timestamp>, PathBuf)>, DatasetError> {
    if let Some(list) = &options.timestamps {
        return frame_times(draft, list, options).map(|times| Some((times, list.clone())));
    }
    let Some(list) = frame_times_file(folder, &draft.root, tables) else { return Ok(None) };
    match frame_times(draft, &list, options) {
        Ok(times) => Ok(Some((times, list))),
        // A file that only looks like a log of times is none.
        Err(e) => {
            let message = format!("it looks like the times of the frames and is not used: {e}");
            draft.warnings.push(Warning::degraded("frame-times", message).at(list.display()));
            Ok(None)
        }
    }
}

/// The log of frame times: a text file whose name says so and that is none of the IMU's tables.
fn frame_times_file(folder: &Path, path: &Path, tables: &[PathBuf]) -> Option<PathBuf> {
    let is_text = |n: &str| n.ends_with(".csv") || n.ends_with(".txt");
    for words in [["frame_timestamp", "frametime"], ["timestamp", "times."], ["movie_metadata", "frames."]] {
        for place in [folder, path] {
            let named = |n: &String| {
                let lower = n.to_ascii_lowercase();
                is_text(&lower) && words.iter().any(|w| lower.contains(w))
            };
            let mut found = names_in(place).ok()?.into_iter().filter(named).map(|n| place.join(n));
            if let Some(file) = found.find(|f| !tables.contains(f)) {
                return Some(file);
            }
        }
    }
    None
}

/// The first column of the log; its unit is that of the header where it has one.
fn frame_times(
    draft: &mut Draft,
    list: &Path,
    options: &OpenOptions,
) -> Result<Vec<Timestamp>, DatasetError> {
    let bytes = draft.read(list)?;
    let source = Source { path: list, bytes: &bytes };
    let rule = options.time_unit.map_or(UnitRule::Guess, UnitRule::Given);
    let (times, notes) = parse::first_column_times(&source, rule)?;
    draft.warnings.extend(notes);
    Ok(times)
}

/// Focal length over the longer side of a phone's picture, from wide to tele.
const FOCAL_RATIO: std::ops::RangeInclusive<f64> = 0.3..=4.0;

/// MARS Logger states the camera of every frame. On iOS with its centre, for the recorded picture; on Android the focal length only, which
/// is that of the recorded picture or, where the driver states a calibration, of the sensor's whole array: then it is a guess.
fn read_intrinsics_of_frames(
    draft: &mut Draft,
    folder: &Path,
    quarter_turns: u8,
) -> Result<(), DatasetError> {
    let metadata = folder.join("movie_metadata.csv");
    if !metadata.is_file() {
        return Ok(());
    }
    // It may be the log of times, too, which is then listed already.
    draft.text_files.retain(|file| *file != metadata);
    let bytes = draft.read(&metadata)?;
    let Some(stated) = parse::frame_intrinsics(&Source { path: &metadata, bytes: &bytes })? else {
        return Ok(());
    };
    let Some((_, first)) = draft.images.first() else { return Ok(()) };
    let (width, height) = draft.media.size(first)?;
    let [fx, fy] = stated.focal;
    let native = if quarter_turns % 2 == 1 { (height, width) } else { (width, height) };
    let [cx, cy] = stated.centre.unwrap_or([0.5 * native.0 as f64 - 0.5, 0.5 * native.1 as f64 - 0.5]);
    let [fx, fy, cx, cy] = phone::turned([fx, fy, cx, cy], quarter_turns, (width, height));
    let is_plausible = FOCAL_RATIO.contains(&(fx / width.max(height) as f64));
    let pinhole = Pinhole::new(fx, fy, cx, cy, width, height).ok().filter(|_| is_plausible);
    let (message, hint) = match (pinhole, stated.centre) {
        (None, _) => (
            format!(
                "the logger's focal length, {fx:.1} px, is not that of a {width}x{height} picture; not used"
            ),
            "",
        ),
        (Some(_), Some(_)) => (
            format!("camera by the logger: f {fx:.1}, {fy:.1}, c {cx:.1}, {cy:.1} px, without distortion"),
            "",
        ),
        (Some(_), None) => (
            format!(
                "focal length {fx:.1} px by the logger, which may be of the sensor's array and not of the picture: a guess"
            ),
            "--calibration FILE, or `vidar calibrate`",
        ),
    };
    let warning = Warning::new("intrinsics-driver", message).at(metadata.display());
    draft.warnings.push(if hint.is_empty() { warning } else { warning.hint(hint) });
    if let Some(pinhole) = pinhole {
        draft.cameras[0].model = Some(CameraModel::Pinhole(pinhole));
        draft.cameras[0].source =
            stated.centre.map_or(CalibrationSource::Guessed, |_| CalibrationSource::File(metadata));
    }
    Ok(())
}
