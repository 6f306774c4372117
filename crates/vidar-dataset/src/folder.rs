//! Contents of folders: names in natural order, numbers in names, synthesised times.

use crate::error::{DatasetError, io_error};
use std::cmp::Ordering;
use std::path::{Path, PathBuf};
use vidar_core::{Duration, Timestamp, Warning};

/// Names in a folder, in natural order (`2.png` before `10.png`). Names that are not UTF-8 are kept lossily.
pub(crate) fn names_in(folder: &Path) -> Result<Vec<String>, DatasetError> {
    let mut names = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(io_error(folder))? {
        names.push(entry.map_err(io_error(folder))?.file_name().to_string_lossy().into_owned());
    }
    names.sort_by(|a, b| natural_order(a, b));
    Ok(names)
}

/// Names of PNG and JPEG files in a folder, in natural order; hidden files (`._x.png` of other systems) left out.
pub(crate) fn images_in(folder: &Path) -> Result<Vec<String>, DatasetError> {
    let mut names = names_in(folder)?;
    names.retain(|n| !n.starts_with('.') && crate::parse::is_image_name(n));
    Ok(names)
}

/// Compares runs of digits by value and everything else by character; equal names are compared as plain text.
pub(crate) fn natural_order(a: &str, b: &str) -> Ordering {
    let (mut x, mut y) = (a.as_bytes(), b.as_bytes());
    while let (Some(&p), Some(&q)) = (x.first(), y.first()) {
        let order = if p.is_ascii_digit() && q.is_ascii_digit() {
            let (run_x, rest_x) = split_digits(x);
            let (run_y, rest_y) = split_digits(y);
            (x, y) = (rest_x, rest_y);
            run_x.len().cmp(&run_y.len()).then_with(|| run_x.cmp(run_y))
        } else {
            (x, y) = (&x[1..], &y[1..]);
            p.to_ascii_lowercase().cmp(&q.to_ascii_lowercase())
        };
        if order != Ordering::Equal {
            return order;
        }
    }
    x.len().cmp(&y.len()).then_with(|| a.cmp(b))
}

/// The digits at the front without leading zeros, and what follows.
fn split_digits(text: &[u8]) -> (&[u8], &[u8]) {
    let end = text.iter().position(|b| !b.is_ascii_digit()).unwrap_or(text.len());
    let (run, rest) = text.split_at(end);
    let zeros = run.iter().position(|&b| b != b'0').unwrap_or(run.len());
    (&run[zeros..], rest)
}

/// The name without folder and extension.
pub(crate) fn stem(name: &str) -> &str {
    let file = name.rsplit('/').next().unwrap_or(name);
    file.rsplit_once('.').map_or(file, |(stem, _)| stem)
}

/// The last run of digits in a stem, as a number of a frame.
pub(crate) fn frame_number(name: &str) -> Option<u64> {
    let stem = stem(name);
    let end = stem.rfind(|c: char| c.is_ascii_digit())? + 1;
    let start = stem[..end].rfind(|c: char| !c.is_ascii_digit()).map_or(0, |i| i + 1);
    // `rfind` gives the start of a character that may be longer than one byte.
    stem.get(start..end).or_else(|| stem[..end].rsplit(|c: char| !c.is_ascii_digit()).next())?.parse().ok()
}

/// The rate assumed for frames without times, Hz.
pub(crate) const SYNTHETIC_RATE_HZ: i64 = 30;

/// Time of frame number `n` at 30 Hz.
pub(crate) fn synthetic_time(n: u64) -> Timestamp {
    let nanos = i128::from(n) * 1_000_000_000 / i128::from(SYNTHETIC_RATE_HZ);
    Timestamp::from_nanos(i64::try_from(nanos).unwrap_or(i64::MAX))
}

/// The warning about synthesised times.
pub(crate) fn synthetic_warning(place: &Path) -> Warning {
    Warning::new(
        "times-synthesised",
        format!(
            "no image times; they are made from frame numbers at {SYNTHETIC_RATE_HZ} Hz, so speeds and IMU data are meaningless"
        ),
    )
    .at(place.display())
    .hint("--timestamps FILE")
}

/// Frame numbers of `names`, when every one has its own, else their positions.
pub(crate) fn numbers_of(names: &[String]) -> Vec<u64> {
    let numbers: Option<Vec<u64>> = names.iter().map(|n| frame_number(n)).collect();
    match numbers {
        Some(numbers) if numbers.windows(2).all(|w| w[0] < w[1]) && numbers.last() < Some(&(1 << 40)) => {
            numbers
        }
        _ => (0..names.len() as u64).collect(),
    }
}

/// The first of `names` that is a file in `folder`.
pub(crate) fn first_file(folder: &Path, names: &[&str]) -> Option<PathBuf> {
    names.iter().map(|n| folder.join(n)).find(|p| p.is_file())
}

/// Longest step between neighbours for which a frame number may be a time in seconds.
pub(crate) const MAX_NAME_STEP: Duration = Duration::from_millis(10_000);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_in_natural_order() {
        let mut names = vec!["img10.png", "img9.png", "img010.png", "Img1.PNG", "a", "img9a.png", ""];
        names.sort_by(|a, b| natural_order(a, b));
        assert_eq!(names, ["", "a", "Img1.PNG", "img9.png", "img9a.png", "img010.png", "img10.png"]);
    }

    #[test]
    fn frame_numbers_are_the_last_digits_of_the_name() {
        assert_eq!(frame_number("frame-000123.color.png"), Some(123));
        assert_eq!(frame_number("0007.jpg"), Some(7));
        assert_eq!(frame_number("é12.png"), Some(12));
        assert_eq!(frame_number("left.png"), None);
        assert_eq!(frame_number("99999999999999999999999.png"), None);
    }
}
