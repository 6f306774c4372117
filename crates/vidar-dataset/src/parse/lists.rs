//! Lists with a time in every line: files, IMU samples, times only.

use super::units::{UnitRule, decide_unit, read_time};
use crate::dataset::AccelSample;
use crate::error::DatasetError;
use crate::source::{Row, Source, quoted};
use nalgebra::Vector3;
use vidar_core::{AngularRate, ImuSample, SpecificForce, Timestamp, Warning};

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
    let lines = source.lines(&mut notes)?;
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

/// A list may only name files under its own folder.
fn check_stays_inside(source: &Source<'_>, row: &Row<'_>, name: &str) -> Result<(), DatasetError> {
    use std::path::Component;
    let inside = std::path::Path::new(name)
        .components()
        .all(|c| matches!(c, Component::Normal(_) | Component::CurDir));
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
    let lines = source.lines(&mut notes)?;
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

/// Whether a file name has the extension of a supported image format.
pub(crate) fn is_image_name(name: &str) -> bool {
    name.rsplit_once('.')
        .is_some_and(|(_, ext)| ["png", "jpg", "jpeg"].iter().any(|known| ext.eq_ignore_ascii_case(known)))
}

type TimedRow<const N: usize> = (Timestamp, [f64; N]);

/// Rows of a time and `N` numbers. Rows with a number that is not finite are skipped and counted.
fn timed_numbers<const N: usize>(
    source: &Source<'_>,
    rule: UnitRule,
    columns: &str,
) -> Result<(Vec<TimedRow<N>>, Vec<Warning>), DatasetError> {
    let mut notes = Vec::new();
    let lines = source.lines(&mut notes)?;
    let place = source.path.display().to_string();
    let unit =
        decide_unit(rule, lines.rows.iter().map(|r| r.fields().next().unwrap_or("")), &place, &mut notes);
    let mut out = Vec::with_capacity(lines.rows.len());
    let mut not_finite = (0usize, 0usize);
    for row in &lines.rows {
        let mut fields = row.fields();
        let time = read_time(source, row, fields.next().unwrap_or(""), unit)?;
        let mut numbers = [0.0; N];
        for (i, number) in numbers.iter_mut().enumerate() {
            let field = fields.next().ok_or_else(|| {
                source.malformed(
                    row.line,
                    format!("{} columns", i + 1),
                    format!("{} columns: {columns}", N + 1),
                )
            })?;
            *number = source.number(row, field, columns)?;
        }
        if numbers.iter().all(|v| v.is_finite()) {
            out.push((time, numbers));
        } else {
            not_finite = (not_finite.0 + 1, if not_finite.0 == 0 { row.line } else { not_finite.1 });
        }
    }
    if not_finite.0 > 0 {
        notes.push(
            Warning::new(
                "sample-not-finite",
                format!("{} samples contain NaN or infinity; skipped", not_finite.0),
            )
            .at(format!("{place}:{}", not_finite.1)),
        );
    }
    Ok((out, notes))
}

/// Reads EuRoC's `imu0/data.csv`: time, gyroscope (rad/s), accelerometer (m/s²).
pub fn imu_csv(source: &Source<'_>, rule: UnitRule) -> Result<(Vec<ImuSample>, Vec<Warning>), DatasetError> {
    let (rows, notes) = timed_numbers::<6>(source, rule, "time, gyro x y z, accel x y z")?;
    let samples = rows
        .into_iter()
        .map(|(time, [gx, gy, gz, ax, ay, az])| ImuSample {
            time,
            gyro: AngularRate(Vector3::new(gx, gy, gz)),
            accel: SpecificForce(Vector3::new(ax, ay, az)),
        })
        .collect();
    Ok((samples, notes))
}

/// Reads TUM's `accelerometer.txt`: time, accelerometer (m/s²).
pub fn accelerometer_list(
    source: &Source<'_>,
    rule: UnitRule,
) -> Result<(Vec<AccelSample>, Vec<Warning>), DatasetError> {
    let (rows, notes) = timed_numbers::<3>(source, rule, "time ax ay az")?;
    let samples = rows
        .into_iter()
        .map(|(time, [x, y, z])| AccelSample { time, accel: SpecificForce(Vector3::new(x, y, z)) })
        .collect();
    Ok((samples, notes))
}
