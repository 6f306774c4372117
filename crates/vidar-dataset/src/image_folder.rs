//! Images in one folder, in natural order, with a file of times, or times as names, or neither.

use crate::draft::Draft;
use crate::error::{DatasetError, io_error};
use crate::folder::{
    MAX_NAME_STEP, first_file, images_in, names_in, numbers_of, stem, synthetic_time, synthetic_warning,
};
use crate::location::files;
use crate::options::{OpenOptions, RecordingKind};
use crate::parse::units::decide_unit;
use crate::parse::{self, PhotoExif, Source, UnitRule};
use crate::recording::CalibrationSource;
use crate::seven_scenes::checked_pinhole;
use std::collections::HashMap;
use std::io::Read;
use std::path::{Path, PathBuf};
use vidar_core::{CameraModel, Timestamp, Warning};

/// Folders in which images commonly lie, tried when the path itself has none.
const SUBFOLDERS: [&str; 5] = ["images", "rgb", "image_0", "color", "data"];

/// Looks for images at `path` and in the usual folders under it; returns the folder of images and the reason.
pub(crate) fn detect(path: &Path) -> Option<(PathBuf, String)> {
    let count = |folder: &Path| images_in(folder).map_or(0, |n| n.len());
    match count(path) {
        0 => SUBFOLDERS.iter().map(|s| path.join(s)).find_map(|folder| match count(&folder) {
            0 => None,
            n => Some((folder.clone(), format!("{n} images in {}", folder.display()))),
        }),
        n => Some((path.to_path_buf(), format!("{n} images and no known layout"))),
    }
}

/// Reads the layout; `path` is what the user gave, `folder` where the images are.
pub(crate) fn open(
    path: &Path,
    folder: &Path,
    reason: String,
    options: &OpenOptions,
) -> Result<Draft, DatasetError> {
    let mut draft = Draft::new(RecordingKind::ImageFolder, path, reason);
    draft.image_list = folder.to_path_buf();
    let names = images_in(folder)?;
    if names.is_empty() {
        let other = names_in(folder)?.len();
        return Err(DatasetError::NoImages {
            path: folder.to_path_buf(),
            found: format!("{other} other files"),
            expected: "(.png, .jpg, .jpeg in any case)".into(),
        });
    }
    let images = match find_times(path, options).or_else(|| find_times(folder, options)) {
        Some(list) => images_by_list(&mut draft, folder, &names, &list, options)?,
        None => images_by_name(&mut draft, folder, &names, options),
    };
    draft.images = files(images);
    read_intrinsics(&mut draft, folder)?;
    use_exif(&mut draft, folder)?;
    Ok(draft)
}

/// EXIF lies in the first segments of a file, of which none has more than 64 kB.
const EXIF_BYTES: u64 = 256 << 10;

fn exif_of(path: &Path) -> Result<PhotoExif, DatasetError> {
    let mut head = Vec::new();
    let file = std::fs::File::open(path).map_err(io_error(path))?;
    file.take(EXIF_BYTES).read_to_end(&mut head).map_err(io_error(path))?;
    Ok(parse::photo_exif(&head))
}

/// Photographs state the focal length and when they were taken; used where nothing else does.
fn use_exif(draft: &mut Draft, folder: &Path) -> Result<(), DatasetError> {
    let Some(first) = draft.images.first().and_then(|(_, l)| l.as_file()).map(Path::to_path_buf) else {
        return Ok(());
    };
    let stated = exif_of(&first)?;
    if draft.cameras[0].model.is_none()
        && stated.focal_35mm.is_some()
        && let Ok(size) = draft.media.size(&first.clone().into())
        && let Some(focal) = stated.focal_px(size)
    {
        let centre = [0.5 * size.0 as f64 - 0.5, 0.5 * size.1 as f64 - 0.5];
        let pinhole = checked_pinhole([focal, focal, centre[0], centre[1]], &first)?;
        let message = format!(
            "focal length {focal:.0} px by EXIF ({:.0} mm of 35 mm film), true within some percent: still a guess for metric results",
            stated.focal_35mm.unwrap_or_default()
        );
        let warning = Warning::new("intrinsics-guessed", message).at(first.display());
        draft.warnings.push(warning.hint("--calibration FILE, or --camera-model pinhole:fx,fy,cx,cy"));
        draft.cameras[0].model = Some(CameraModel::Pinhole(pinhole));
    }
    if !draft.times_are_invented || stated.time.is_none() {
        return Ok(());
    }
    let mut timed = Vec::with_capacity(draft.images.len());
    for (_, location) in &draft.images {
        let Some(time) = location.as_file().map(exif_of).transpose()?.and_then(|e| e.time) else {
            return Ok(());
        };
        timed.push((time, location.clone()));
    }
    // Seconds without fraction give bursts equal times; numbers of frames are better then.
    if timed.windows(2).all(|w| w[0].0 < w[1].0) {
        draft.images = timed;
        draft.times_are_invented = false;
        draft.warnings.retain(|w| w.kind != "times-synthesised");
        let message = "image times are those of EXIF, by the camera's clock and time zone";
        draft
            .warnings
            .push(Warning::new("times-exif", message).at(folder.display()).hint("--timestamps FILE"));
    }
    Ok(())
}

/// The user's file of times, or a file with a usual name in the folder.
pub(crate) fn find_times(folder: &Path, options: &OpenOptions) -> Option<PathBuf> {
    let usual = ["timestamps.txt", "times.txt", "timestamps.csv", "times.csv"];
    options.timestamps.clone().or_else(|| first_file(folder, &usual))
}

/// Gives every image its time from a list: by name where the list names files, else line by line.
pub(crate) fn images_by_list(
    draft: &mut Draft,
    folder: &Path,
    names: &[String],
    list: &Path,
    options: &OpenOptions,
) -> Result<Vec<(Timestamp, PathBuf)>, DatasetError> {
    let bytes = draft.read(list)?;
    let rule = options.time_unit.map_or(UnitRule::Guess, UnitRule::Given);
    let (times, notes) = parse::time_list(&Source { path: list, bytes: &bytes }, rule)?;
    draft.warnings.extend(notes);
    if times.iter().all(|t| t.name.is_none()) {
        if times.len() != names.len() {
            return Err(DatasetError::TimesMismatch {
                path: list.to_path_buf(),
                poses: names.len(),
                times: times.len(),
            });
        }
        return Ok(times.iter().zip(names).map(|(t, name)| (t.time, folder.join(name))).collect());
    }
    let file_name = |n: &str| n.rsplit(['/', '\\']).next().unwrap_or(n).to_string();
    let by_name: HashMap<String, Timestamp> =
        times.iter().filter_map(|t| Some((file_name(t.name.as_deref()?), t.time))).collect();
    let timed: Vec<_> =
        names.iter().filter_map(|n| Some((*by_name.get(n.as_str())?, folder.join(n)))).collect();
    if timed.len() < names.len() {
        let message = format!("{} images have no time in the list; skipped", names.len() - timed.len());
        draft.warnings.push(Warning::new("time-missing", message).at(list.display()));
    }
    if timed.len() < by_name.len() {
        let message = format!("{} files of the list do not exist", by_name.len() - timed.len());
        draft.warnings.push(Warning::degraded("image-missing", message).at(list.display()));
    }
    Ok(timed)
}

/// Times from names that are numbers of seconds, ms, µs or ns, else frame numbers at 30 Hz.
pub(crate) fn images_by_name(
    draft: &mut Draft,
    folder: &Path,
    names: &[String],
    options: &OpenOptions,
) -> Vec<(Timestamp, PathBuf)> {
    let stems: Vec<&str> = names.iter().map(|n| stem(n)).collect();
    if let Some(times) = times_from_stems(draft, folder, &stems, options) {
        return times.into_iter().zip(names).map(|(t, n)| (t, folder.join(n))).collect();
    }
    draft.warnings.push(synthetic_warning(folder));
    draft.times_are_invented = true;
    numbers_of(names).into_iter().zip(names).map(|(i, n)| (synthetic_time(i), folder.join(n))).collect()
}

fn times_from_stems(
    draft: &mut Draft,
    folder: &Path,
    stems: &[&str],
    options: &OpenOptions,
) -> Option<Vec<Timestamp>> {
    let is_number = |s: &&str| {
        s.bytes().all(|b| b.is_ascii_digit() || b == b'.') && Timestamp::parse_secs(s).is_ok()
            || s.bytes().all(|b| b.is_ascii_digit()) && Timestamp::parse_unit(s, 9).is_ok()
    };
    if stems.is_empty() || !stems.iter().all(is_number) {
        return None;
    }
    // Whole numbers that begin low are frame numbers, not times, unless the user gives a unit.
    let has_fraction = stems.iter().any(|s| s.contains('.'));
    let largest = stems.iter().filter_map(|s| s.parse::<f64>().ok()).fold(0.0, f64::max);
    if options.time_unit.is_none() && !has_fraction && largest < 1e9 {
        return None;
    }
    let mut notes = Vec::new();
    let rule = options.time_unit.map_or(UnitRule::Guess, UnitRule::Given);
    let place = folder.display().to_string();
    let unit = decide_unit(rule, stems.iter().copied(), &place, &mut notes);
    let times: Option<Vec<Timestamp>> =
        stems.iter().map(|s| Timestamp::parse_unit(s, unit.digits()).ok()).collect();
    let times = times?;
    let steps_are_small = times.windows(2).all(|w| (w[1] - w[0]).abs() <= MAX_NAME_STEP);
    if !steps_are_small && options.time_unit.is_none() && !has_fraction {
        return None;
    }
    draft.warnings.append(&mut notes);
    Some(times)
}

/// A matrix of intrinsics or an EuRoC or Kalibr file next to the images.
pub(crate) fn read_intrinsics(draft: &mut Draft, folder: &Path) -> Result<(), DatasetError> {
    let matrices = ["K.txt", "intrinsics.txt", "camera-intrinsics.txt"];
    let root = draft.root.clone();
    if let Some(path) = first_file(&root, &matrices).or_else(|| first_file(folder, &matrices)) {
        let bytes = draft.read(&path)?;
        let intrinsics = parse::intrinsics_matrix(&Source { path: &path, bytes: &bytes })?;
        draft.cameras[0].model = Some(CameraModel::Pinhole(checked_pinhole(intrinsics, &path)?));
        draft.cameras[0].source = CalibrationSource::File(path);
        return Ok(());
    }
    let calibrations = ["sensor.yaml", "camchain.yaml", "calibration.yaml"];
    match first_file(&root, &calibrations).or_else(|| first_file(folder, &calibrations)) {
        Some(path) => draft.apply_calibration(&path),
        None => Ok(()),
    }
}
