//! Tables of a phone's gyroscope and accelerometer: columns, units and signs, and both sensors as one stream.

use crate::checks::resting_norm;
use crate::draft::Draft;
use crate::error::{DatasetError, io_error};
use crate::options::{OpenOptions, TimeUnit};
use crate::parse::columns::{AccelUnit, ImuColumns, columns_by_numbers};
use crate::parse::{self, Source, TimedRow, UnitRule};
use nalgebra::Vector3;
use std::io::Read;
use std::path::{Path, PathBuf};
use vidar_core::{
    AngularRate, Duration, ImuSample, SpecificForce, TimedVector, Timestamp, Warning, merge_imu,
};

/// Standard gravity, m/s².
const GRAVITY_MPS2: f64 = 9.80665;
/// Bytes at the beginning of a table that tell its columns.
const HEAD_BYTES: u64 = 16 << 10;
/// Rows of a table without header that tell its columns.
const HEAD_ROWS: usize = 200;

/// A table of a recording, and what its columns are.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ImuFile {
    pub path: PathBuf,
    pub columns: ImuColumns,
}

/// The table at `path` if it holds a gyroscope or an accelerometer.
pub(crate) fn imu_file_at(path: &Path) -> Result<Option<ImuFile>, DatasetError> {
    let file = std::fs::File::open(path).map_err(io_error(path))?;
    let mut head = Vec::new();
    file.take(HEAD_BYTES).read_to_end(&mut head).map_err(io_error(path))?;
    // The last line may be cut.
    if head.len() as u64 == HEAD_BYTES {
        head.truncate(head.iter().rposition(|&b| b == b'\n').map_or(0, |at| at + 1));
    }
    let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let source = Source { path, bytes: &head };
    // What is no text is no table.
    let Ok(text) = source.text(&mut Vec::new()) else { return Ok(None) };
    let named = text.lines().take(8).find_map(|line| parse::imu_columns(line, &name));
    let columns = named.or_else(|| {
        let rows = source.lines(&mut Vec::new()).ok()?.rows;
        let numbers = |row: &crate::source::Row<'_>| row.fields().map(|f| f.parse().ok()).collect();
        let rows: Option<Vec<Vec<f64>>> = rows.iter().take(HEAD_ROWS).map(numbers).collect();
        columns_by_numbers(&rows?, &name)
    });
    Ok(columns.map(|columns| ImuFile { path: path.to_path_buf(), columns }))
}

/// Reads the tables of one IMU into the draft, with units, signs and noise; what was assumed becomes a warning.
pub(crate) fn read_imu(
    draft: &mut Draft,
    files: &[ImuFile],
    options: &OpenOptions,
    recorder: &str,
) -> Result<(), DatasetError> {
    let (mut gyro, mut accel, mut paired) = (Vec::new(), Vec::new(), true);
    let mut stated = None;
    for file in files {
        let rows = read_table(draft, file, options.time_unit)?;
        paired &= rows.iter().all(|(_, n)| n.iter().all(|v| v.is_finite()));
        let to_radians = if file.columns.is_in_degrees { std::f64::consts::PI / 180.0 } else { 1.0 };
        let take = |out: &mut Vec<TimedVector>, from: usize, scale: f64| {
            let vector =
                |(time, n): &TimedRow<6>| (*time, Vector3::new(n[from], n[from + 1], n[from + 2]) * scale);
            out.extend(rows.iter().map(vector).filter(|(_, v)| v.iter().all(|c| c.is_finite())));
        };
        take(&mut gyro, 0, to_radians);
        take(&mut accel, 3, 1.0);
        stated = stated.or(file.columns.accel_unit.filter(|_| file.columns.has_accelerometer()));
    }
    let place = files.first().map_or(draft.root.as_path(), |f| f.path.as_path()).to_path_buf();
    put_in_order(&mut gyro, "gyroscope samples", &place, &mut draft.warnings);
    put_in_order(&mut accel, "accelerometer samples", &place, &mut draft.warnings);
    if gyro.is_empty() || !to_specific_force(&mut accel, stated, &place, &mut draft.warnings) {
        let what = if gyro.is_empty() { "no gyroscope" } else { "no accelerometer with gravity" };
        let message = format!("{what}, so there is no IMU");
        draft.warnings.push(Warning::degraded("imu-incomplete", message).at(place.display()));
        return Ok(());
    }
    // Rows that hold both sensors stay as they are; of streams of their own the accelerometer is interpolated.
    draft.imu = match paired && gyro.len() == accel.len() {
        true => gyro
            .iter()
            .zip(&accel)
            .map(|(&(time, rate), &(_, force))| ImuSample {
                time,
                gyro: AngularRate(rate),
                accel: SpecificForce(force),
            })
            .collect(),
        false => merge_imu(&gyro, &accel),
    };
    let rate_hz = median_rate_hz(&draft.imu).unwrap_or(vidar_core::ImuNoise::EUROC.rate_hz);
    draft.assume_imu_noise(recorder, rate_hz, &place.display().to_string());
    Ok(())
}

fn put_in_order(samples: &mut Vec<TimedVector>, what: &str, place: &Path, notes: &mut Vec<Warning>) {
    crate::checks::put_in_order(samples, |s| s.0, what, place, notes);
}

fn read_table(
    draft: &mut Draft,
    file: &ImuFile,
    given: Option<TimeUnit>,
) -> Result<Vec<TimedRow<6>>, DatasetError> {
    let rule = match (given, file.columns.time_unit) {
        (Some(unit), _) => UnitRule::Given(unit),
        (None, Some(unit)) => UnitRule::Expected(unit),
        (None, None) => UnitRule::Guess,
    };
    let (rows, notes) = parse::imu_table(&file.path, rule, file.columns.places)?;
    draft.warnings.extend(notes);
    draft.text_files.push(file.path.clone());
    let columns = &file.columns;
    if columns.is_guessed {
        let words = |from: usize| {
            let columns = &columns.places.numbers[from..from + 3];
            match columns {
                [Some(x), Some(y), Some(z)] => format!("columns {}, {}, {}", x + 1, y + 1, z + 1),
                _ => "not in this file".into(),
            }
        };
        let message = format!(
            "no header names the columns; by its numbers: time column {}, gyroscope {}, accelerometer {}",
            columns.places.time + 1,
            words(0),
            words(3)
        );
        draft.warnings.push(Warning::new("imu-columns", message).at(file.path.display()));
    }
    if columns.is_in_degrees {
        let message = "the gyroscope is in degrees per second, as its header says; turned into rad/s";
        draft.warnings.push(Warning::new("gyro-unit", message).at(file.path.display()));
    }
    Ok(rows)
}

/// Turns the accelerometer's values into specific force, m/s². Its length at rest tells the unit: gravity is 9.8 m/s² or 1 g.
/// False where it holds no gravity.
///
/// Values in g are taken as Core Motion of iOS writes them: a device at rest on its back reads −1 g along z, the opposite of the
/// specific force (Apple, "Getting raw accelerometer events"). A header that says g-force is taken as it stands.
pub(crate) fn to_specific_force(
    accel: &mut [TimedVector],
    stated: Option<AccelUnit>,
    place: &Path,
    notes: &mut Vec<Warning>,
) -> bool {
    let norms: Vec<(Timestamp, f64)> = accel.iter().map(|s| (s.0, s.1.norm())).collect();
    let Some((norm, _)) = resting_norm(&norms) else { return false };
    let is_g = (0.8..=1.25).contains(&norm);
    if norm < 0.5 {
        let message = format!(
            "the accelerometer's mean length is {norm:.3}: gravity was taken out of it (\"user\" or \"linear\" acceleration)"
        );
        let warning = Warning::degraded("accelerometer-without-gravity", message).at(place.display());
        notes.push(warning.hint("record the raw accelerometer"));
        return false;
    }
    if !is_g {
        if stated == Some(AccelUnit::Gravities) {
            let message = format!(
                "the header says g, but the accelerometer's length at rest is {norm:.2}; m/s² is used"
            );
            notes.push(Warning::new("accel-unit", message).at(place.display()));
        }
        return true;
    }
    let (factor, sign) = match stated {
        Some(AccelUnit::Gravities) => (GRAVITY_MPS2, "their sign is kept"),
        _ => (-GRAVITY_MPS2, "their sign is turned, as Core Motion (iOS) writes them"),
    };
    let header =
        if stated == Some(AccelUnit::MetresPerSecondSquared) { "; the header says m/s²" } else { "" };
    let message =
        format!("the accelerometer's length at rest is {norm:.3}, so its values are in g; {sign}{header}");
    notes.push(Warning::new("accel-unit", message).at(place.display()));
    accel.iter_mut().for_each(|s| s.1 *= factor);
    true
}

/// Rate by the median step, Hz.
pub(crate) fn median_rate_hz(imu: &[ImuSample]) -> Option<f64> {
    let mut steps: Vec<Duration> = imu.windows(2).map(|w| w[1].time - w[0].time).collect();
    steps.sort_unstable();
    let step = steps.get(steps.len() / 2)?.nanos();
    (step > 0).then(|| 1e9 / step as f64)
}
