//! Small steps of completing a dataset: its name, existing files, a guessed camera, the selected part.

use crate::draft::image_range;
use crate::error::{DatasetError, io_error};
use crate::location::{Location, Media};
use crate::options::OpenOptions;
use crate::recording::{CalibrationSource, DEPTH_TOLERANCE, ImageEntry, Recording};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use vidar_core::{CameraModel, Duration, Pinhole, Timestamp, Warning};

/// The last meaningful part of the root's path: not `mav0`, and `seq-01` only together with its parent folder.
pub(crate) fn name_of(root: &Path) -> String {
    let absolute = root.canonicalize().unwrap_or_else(|_| root.to_path_buf());
    // A recording in one file is called as the file is, without its ending.
    let absolute = if absolute.is_file() { absolute.with_extension("") } else { absolute };
    let parts = absolute.components().rev().filter_map(|c| match c {
        std::path::Component::Normal(part) => Some(part.to_string_lossy().into_owned()),
        _ => None,
    });
    let mut parts = parts.filter(|p| p != "mav0");
    let last = parts.next().unwrap_or_else(|| "dataset".into());
    match parts.next() {
        Some(parent) if last.starts_with("seq") => format!("{parent}-{last}"),
        _ => last,
    }
}

/// Skips missing and empty files, with a warning.
pub(crate) fn keep_existing(
    files: &mut Vec<(Timestamp, Location)>,
    what: &str,
    place: &Path,
    notes: &mut Vec<Warning>,
) -> Result<(), DatasetError> {
    let (mut missing, mut empty) = (Vec::new(), Vec::new());
    let mut kept = Vec::with_capacity(files.len());
    for (time, location) in files.drain(..) {
        // The messages of an open recording exist.
        let Location::File(path) = location else {
            kept.push((time, location));
            continue;
        };
        match std::fs::metadata(&path) {
            Ok(found) if !found.is_file() => missing.push(path),
            Ok(found) if found.len() == 0 => empty.push(path),
            Ok(_) => kept.push((time, Location::File(path))),
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => missing.push(path),
            Err(e) => return Err(io_error(&path)(e)),
        }
    }
    for (kind, fault, paths) in [
        ("image-missing", "are listed but do not exist", missing),
        ("image-empty", "are empty (0 bytes)", empty),
    ] {
        if let Some(first) = paths.first() {
            let name = first.display();
            let message = format!("{} {what} {fault}; skipped, the first is {name}", paths.len());
            notes.push(Warning::degraded(kind, message).at(place.display()));
        }
    }
    *files = kept;
    Ok(())
}

/// The size that most images have; those of another are left out, with a warning. Images whose header cannot be read stay:
/// they are reported when they are loaded.
pub(crate) fn keep_one_size(
    images: &mut Vec<ImageEntry>,
    media: &Media,
    place: &Path,
    notes: &mut Vec<Warning>,
) -> Result<(usize, usize), DatasetError> {
    // One stream of a recording has one size; to look at each image would read the whole recording. An image that
    // differs is reported when it is loaded.
    if let Some(entry) = images.first().filter(|e| e.location.as_file().is_none()) {
        return media.size(&entry.location);
    }
    let mut first_error = None;
    let mut sizes = Vec::with_capacity(images.len());
    for (number, entry) in images.iter().enumerate() {
        match media.size(&entry.location) {
            Ok(size) => sizes.push(Some(size)),
            Err(e) => {
                sizes.push(None);
                first_error = first_error.or(Some(e));
            }
        }
        // After ten unreadable images in a row at the beginning the search stops.
        if number >= 9 && sizes.iter().all(Option::is_none) {
            break;
        }
    }
    sizes.resize(images.len(), None);
    let mut counts = BTreeMap::<(usize, usize), (usize, usize)>::new();
    for (number, size) in sizes.iter().enumerate() {
        if let Some(size) = size {
            counts.entry(*size).or_insert((0, number)).0 += 1;
        }
    }
    // Of equally frequent sizes that of the earliest image.
    let most = counts.iter().max_by_key(|(_, (count, first))| (*count, std::cmp::Reverse(*first)));
    let Some((&kept, &(count, _))) = most else {
        return Err(first_error.unwrap_or_else(|| DatasetError::NoImages {
            path: PathBuf::new(),
            found: "an empty list".into(),
            expected: "to read".into(),
        }));
    };
    let is_other = |size: &Option<(usize, usize)>| size.is_some_and(|s| s != kept);
    if let Some(first) = sizes.iter().position(is_other) {
        let others = sizes.iter().filter(|s| is_other(s)).count();
        let (width, height) = sizes[first].unwrap_or_default();
        let message = format!(
            "{count} images are {}x{}, {others} are not and are left out; the first is {width}x{height}",
            kept.0, kept.1
        );
        let location = &images[first].location;
        notes.push(
            Warning::degraded("image-size", message)
                .at(location)
                .hint(format!("images of one recording have one size; {} lists them", place.display())),
        );
        let mut sizes = sizes.iter();
        images.retain(|_| sizes.next().is_none_or(|s| !is_other(s)));
    }
    Ok(kept)
}

/// Opening angle across the longer side assumed for an uncalibrated camera, as of a phone: f = 0.8·w.
const GUESSED_FOCAL_RATIO: f64 = 0.8;

pub(crate) fn guessed_model(
    (width, height): (usize, usize),
    place: &Path,
) -> Result<(CameraModel, CalibrationSource, Warning), DatasetError> {
    let focal = GUESSED_FOCAL_RATIO * width.max(height) as f64;
    let (cx, cy) = (0.5 * width as f64 - 0.5, 0.5 * height as f64 - 0.5);
    let pinhole = Pinhole::new(focal, focal, cx, cy, width, height).map_err(|source| {
        DatasetError::BadCamera { path: place.to_path_buf(), key: "image size".into(), source }
    })?;
    let warning = Warning::new(
        "intrinsics-guessed",
        format!(
            "no calibration; a pinhole with focal length {focal:.0} px is guessed, so results are not metric"
        ),
    )
    .hint("--calibration FILE, or --camera-model pinhole:fx,fy,cx,cy");
    Ok((CameraModel::Pinhole(pinhole), CalibrationSource::Guessed, warning))
}

/// IMU samples and poses kept before and after the selected part, for a static initialisation and for interpolation.
const LEAD_IN: Duration = Duration::from_millis(3000);

/// Applies start, end and stride.
pub(crate) fn cut(dataset: &mut Recording, options: &OpenOptions) -> Result<(), DatasetError> {
    let Some((first, last)) = image_range(&dataset.images) else { return Ok(()) };
    let from = options.start.map_or(first, |s| first + s);
    let to = options.end.map_or(last, |e| first + e);
    dataset.images.retain(|i| (from..=to).contains(&i.time));
    let stride = options.stride.max(1);
    dataset.images = std::mem::take(&mut dataset.images).into_iter().step_by(stride).collect();
    if dataset.images.is_empty() {
        return Err(DatasetError::NoImages {
            path: dataset.root.clone(),
            found: format!("images from 0 to {} after the first", last - first),
            expected: format!("between {} and {}", from - first, to - first),
        });
    }
    dataset.media.expect(dataset.images.iter().map(|i| &i.location));
    if options.start.is_some() || options.end.is_some() {
        let wide = from - LEAD_IN..=to + LEAD_IN;
        dataset.imu.retain(|s| wide.contains(&s.time));
        dataset.accelerometer.retain(|s| wide.contains(&s.time));
        dataset.depths.retain(|d| (from - DEPTH_TOLERANCE..=to + DEPTH_TOLERANCE).contains(&d.time));
    }
    Ok(())
}
