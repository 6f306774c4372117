//! Lists with a time in every line: files, and times only.

use super::units::{UnitRule, decide_unit, read_time};
use crate::error::DatasetError;
use crate::source::{Lines, Row, Source, quoted};
use std::path::Path;
use vidar_core::{Timestamp, Warning};

/// Most images of a list: nine hours at 30 Hz.
const MAX_IMAGES: usize = 1_000_000;

/// A file named in a list.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ListedFile {
    /// Line of the list, from 1.
    pub line: usize,
    /// When it was taken.
    pub time: Timestamp,
    /// Its name as written, relative to the list's data folder.
    pub name: String,
}

/// A time in a file of times, with the image it belongs to where the line names one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ListedTime {
    /// Line of the list, from 1.
    pub line: usize,
    /// The time.
    pub time: Timestamp,
    /// The image's file name, if named.
    pub name: Option<String>,
}

/// Reads `time, file` or `time file` lines: EuRoC's `cam0/data.csv`, TUM's `rgb.txt` and `depth.txt`.
///
/// A line that is only a time means the file `<time>.png`, as EuRoC names them.
pub fn file_list(
    source: &Source<'_>,
    rule: UnitRule,
) -> Result<(Vec<ListedFile>, Vec<Warning>), DatasetError> {
    let mut notes = Vec::new();
    let lines = images_at_most(source, source.lines(&mut notes)?)?;
    let place = source.path.display().to_string();
    let split: Vec<(Row<'_>, &str, &str)> = lines
        .rows
        .into_iter()
        .map(|row| {
            let (time, name) = row.text.split_once([',', ';', ' ', '\t']).unwrap_or((row.text, ""));
            (row, time.trim(), unquoted(name))
        })
        .collect();
    let unit = decide_unit(rule, split.iter().map(|s| s.1), &place, &mut notes);
    let mut files = Vec::with_capacity(split.len());
    for (row, time, name) in &split {
        let stamp = read_time(source, row, time, unit)?;
        let name = if name.is_empty() { format!("{time}.png") } else { (*name).to_string() };
        check_stays_inside(source, row, &name)?;
        files.push(ListedFile { line: row.line, time: stamp, name });
    }
    Ok((files, notes))
}

fn images_at_most<'a>(source: &Source<'_>, lines: Lines<'a>) -> Result<Lines<'a>, DatasetError> {
    match lines.rows.get(MAX_IMAGES) {
        Some(row) => Err(source.too_many_rows(row.line, MAX_IMAGES)),
        None => Ok(lines),
    }
}

/// A list may only name files under its own folder.
fn check_stays_inside(source: &Source<'_>, row: &Row<'_>, name: &str) -> Result<(), DatasetError> {
    use std::path::Component;
    let inside = Path::new(name).components().all(|c| matches!(c, Component::Normal(_) | Component::CurDir));
    if inside && !name.contains('\0') {
        Ok(())
    } else {
        Err(source.malformed(row.line, quoted(name), "a file name inside the dataset"))
    }
}

fn unquoted(name: &str) -> &str {
    let name = name.trim().trim_end_matches([',', ';']).trim();
    name.strip_prefix('"').and_then(|n| n.strip_suffix('"')).unwrap_or(name)
}

/// Reads a file of image times: one per line, or `name time`, or `time name`, blanks or commas between.
pub fn time_list(
    source: &Source<'_>,
    rule: UnitRule,
) -> Result<(Vec<ListedTime>, Vec<Warning>), DatasetError> {
    let mut notes = Vec::new();
    let lines = images_at_most(source, source.lines(&mut notes)?)?;
    let mut split: Vec<(Row<'_>, &str, Option<&str>)> = Vec::with_capacity(lines.rows.len());
    for row in lines.rows {
        let mut fields = row.fields();
        let (first, second, third) = (fields.next().unwrap_or(""), fields.next(), fields.next());
        let (time, name) = match (second.map(unquoted), third) {
            (None, _) => (first, None),
            (Some(second), None) if is_image_name(unquoted(first)) => (second, Some(unquoted(first))),
            (Some(second), None) if is_image_name(second) => (first, Some(second)),
            _ => {
                let expected = "a time, or the file name of an image and a time";
                return Err(source.malformed(row.line, quoted(row.text), expected));
            }
        };
        split.push((row, time, name));
    }
    let place = source.path.display().to_string();
    let unit = decide_unit(rule, split.iter().map(|s| s.1), &place, &mut notes);
    let times = split
        .iter()
        .map(|(row, time, name)| {
            let time = read_time(source, row, time, unit)?;
            Ok(ListedTime { line: row.line, time, name: name.map(str::to_string) })
        })
        .collect::<Result<_, DatasetError>>()?;
    Ok((times, notes))
}

/// Reads the times in the first column of a table, whatever follows: one time a frame.
pub fn first_column_times(
    source: &Source<'_>,
    rule: UnitRule,
) -> Result<(Vec<Timestamp>, Vec<Warning>), DatasetError> {
    let mut notes = Vec::new();
    let lines = images_at_most(source, source.lines(&mut notes)?)?;
    let first = |row: &Row<'_>| row.text.split([',', ';', ' ', '\t']).next().unwrap_or("").trim().to_string();
    let columns: Vec<String> = lines.rows.iter().map(first).collect();
    let place = source.path.display().to_string();
    let unit = decide_unit(rule, columns.iter().map(String::as_str), &place, &mut notes);
    let times = lines.rows.iter().zip(&columns).map(|(row, time)| read_time(source, row, time, unit));
    Ok((times.collect::<Result<_, _>>()?, notes))
}

/// A pair of images of ICL-NUIM's `associations.txt`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Association {
    /// Number of the depth image.
    pub depth_frame: u64,
    /// Its file, inside the dataset.
    pub depth: String,
    /// Number of the colour image.
    pub color_frame: u64,
    /// Its file, inside the dataset.
    pub color: String,
}

/// Reads `n depth/n.png n rgb/n.png` rows; which is which is told by the folders' names.
pub fn associations(source: &Source<'_>) -> Result<Vec<Association>, DatasetError> {
    let lines = images_at_most(source, source.lines(&mut Vec::new())?)?;
    let mut pairs = Vec::with_capacity(lines.rows.len());
    for row in &lines.rows {
        let fields: Vec<&str> = row.fields().take(5).collect();
        let expected = "number, depth image, number, colour image";
        let &[first, one, second, other] = fields.as_slice() else {
            return Err(source.malformed(row.line, quoted(row.text), expected));
        };
        let number = |text: &str| {
            text.parse::<u64>().map_err(|_| source.malformed(row.line, quoted(text), "the number of a frame"))
        };
        check_stays_inside(source, row, one)?;
        check_stays_inside(source, row, other)?;
        let (one, other) = ((number(first)?, one.to_string()), (number(second)?, other.to_string()));
        let ((depth_frame, depth), (color_frame, color)) = match other.1.contains("depth") {
            true => (other, one),
            false => (one, other),
        };
        pairs.push(Association { depth_frame, depth, color_frame, color });
    }
    Ok(pairs)
}

/// A camera as a logger states it for every frame, pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrameIntrinsics {
    /// fx and fy.
    pub focal: [f64; 2],
    /// cx and cy, where they are stated.
    pub centre: Option<[f64; 2]>,
}

/// Medians of the columns `fx[px]`, `fy[px]`, `cx[px]` and `cy[px]` of a table of frames (MARS Logger's `movie_metadata.csv`); `None`
/// without focal lengths. A value of 1 pixel or less stands for one that the phone does not state.
pub fn frame_intrinsics(source: &Source<'_>) -> Result<Option<FrameIntrinsics>, DatasetError> {
    let text = source.text(&mut Vec::new())?;
    let names: Vec<&str> = text.lines().next().unwrap_or("").split(',').map(str::trim).collect();
    let column = |name: &str| names.iter().position(|n| n.to_ascii_lowercase().starts_with(name));
    let lines = images_at_most(source, source.lines(&mut Vec::new())?)?;
    let median = |name: &str| {
        let column = column(name)?;
        let number = |row: &Row<'_>| row.fields().nth(column)?.parse::<f64>().ok();
        let mut values: Vec<f64> = lines.rows.iter().filter_map(number).collect();
        values.sort_unstable_by(f64::total_cmp);
        values.get(values.len() / 2).copied().filter(|v| v.is_finite() && *v > 1.0)
    };
    let pair = |x: &str, y: &str| Some([median(x)?, median(y)?]);
    Ok(pair("fx", "fy").map(|focal| FrameIntrinsics { focal, centre: pair("cx", "cy") }))
}

/// Whether a file name has the extension of a supported image format.
pub(crate) fn is_image_name(name: &str) -> bool {
    name.rsplit_once('.')
        .is_some_and(|(_, ext)| ["png", "jpg", "jpeg"].iter().any(|known| ext.eq_ignore_ascii_case(known)))
}
