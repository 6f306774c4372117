//! Tables of a time and numbers in every row: IMU samples, accelerometer samples, poses with numbers of frames.

use super::units::{UnitRule, decide_unit, read_time};
use crate::error::DatasetError;
use crate::options::TimeUnit;
use crate::recording::AccelSample;
use crate::source::{MAX_ROWS, Row, Source, for_each_block};
use nalgebra::Vector3;
use std::path::Path;
use vidar_core::{AngularRate, ImuSample, Se3, So3, SpecificForce, Timestamp, Warning};

pub(crate) type TimedRow<const N: usize> = (Timestamp, [f64; N]);

/// Most columns of a row that are looked at.
const MAX_COLUMNS: usize = 64;

/// Which columns of a row hold its time and its numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Places<const N: usize> {
    pub time: usize,
    /// `None`: the table does not hold this number; it is then NaN.
    pub numbers: [Option<usize>; N],
    /// A column that tells whose the row is: rows that are not the gyroscope's hold the second half of the numbers.
    pub sensor: Option<usize>,
    /// Whether rows may hold one half of the numbers: two sensors in one table, row by row.
    pub is_sparse: bool,
}

impl<const N: usize> Places<N> {
    /// The time, then the numbers, and nothing is missing.
    fn in_order() -> Self {
        Self { time: 0, numbers: std::array::from_fn(|i| Some(i + 1)), sensor: None, is_sparse: false }
    }
}

/// Rows of a time and `N` numbers, taken block by block. Rows with a number that is not finite are skipped and counted; in a
/// table of two sensors those without a whole triple.
struct TimedNumbers<const N: usize> {
    rule: UnitRule,
    places: Places<N>,
    columns: &'static str,
    unit: Option<TimeUnit>,
    rows: Vec<TimedRow<N>>,
    notes: Vec<Warning>,
    /// How many rows are not finite, and the line of the first.
    not_finite: Option<(usize, usize)>,
}

impl<const N: usize> TimedNumbers<N> {
    fn new(rule: UnitRule, columns: &'static str) -> Self {
        Self::at(rule, Places::in_order(), columns)
    }

    fn at(rule: UnitRule, places: Places<N>, columns: &'static str) -> Self {
        Self { rule, places, columns, unit: None, rows: Vec::new(), notes: Vec::new(), not_finite: None }
    }

    /// Takes a block with `lines_before` lines before it. The first one decides the unit of time.
    fn add(&mut self, source: &Source<'_>, lines_before: usize) -> Result<(), DatasetError> {
        let mut notes = Vec::new();
        let lines = source.lines_after(lines_before, &mut notes)?;
        // Every block of a file with CRLF says so.
        notes.retain(|note| !self.notes.contains(note));
        self.notes.extend(notes);
        let unit = *self.unit.get_or_insert_with(|| {
            let times = lines.rows.iter().map(|r| r.fields().nth(self.places.time).unwrap_or(""));
            decide_unit(self.rule, times, &source.path.display().to_string(), &mut self.notes)
        });
        for row in &lines.rows {
            if self.rows.len() == MAX_ROWS {
                return Err(source.too_many_rows(row.line, MAX_ROWS));
            }
            let (time, numbers) = self.row(source, row, unit)?;
            let mut halves = numbers.chunks(N.div_ceil(2)).map(|half| half.iter().all(|v| v.is_finite()));
            let is_kept = if self.places.is_sparse { halves.any(|h| h) } else { halves.all(|h| h) };
            if is_kept {
                self.rows.push((time, numbers));
            } else {
                self.not_finite.get_or_insert((0, row.line)).0 += 1;
            }
        }
        Ok(())
    }

    fn row(&self, source: &Source<'_>, row: &Row<'_>, unit: TimeUnit) -> Result<TimedRow<N>, DatasetError> {
        let mut fields = [""; MAX_COLUMNS];
        let mut count = 0;
        for (field, found) in fields.iter_mut().zip(row.fields()) {
            (*field, count) = (found, count + 1);
        }
        let time = read_time(source, row, fields.get(self.places.time).copied().unwrap_or(""), unit)?;
        let mut numbers = [f64::NAN; N];
        for (number, place) in numbers.iter_mut().zip(self.places.numbers) {
            let Some(place) = place else { continue };
            let field = fields.get(place).copied().unwrap_or("");
            if field.is_empty() && self.places.is_sparse {
                continue;
            }
            if place >= count {
                let expected = format!("{} columns: {}", N + 1, self.columns);
                return Err(source.malformed(row.line, format!("{count} columns"), expected));
            }
            *number = source.number(row, field, self.columns)?;
        }
        let sensor = self.places.sensor.map(|place| fields.get(place).copied().unwrap_or(""));
        if sensor.is_some_and(|name| !is_gyroscope(name)) {
            numbers.rotate_right(N / 2);
        }
        Ok((time, numbers))
    }

    fn finish(mut self, path: &Path) -> (Vec<TimedRow<N>>, Vec<Warning>) {
        if let Some((count, line)) = self.not_finite {
            let message = format!("{count} samples contain NaN or infinity; skipped");
            let place = format!("{}:{line}", path.display());
            self.notes.push(Warning::new("sample-not-finite", message).at(place));
        }
        (self.rows, self.notes)
    }
}

const IMU_COLUMNS: &str = "time, gyro x y z, accel x y z";

fn imu_numbers(rule: UnitRule) -> TimedNumbers<6> {
    TimedNumbers::new(rule, IMU_COLUMNS)
}

/// Whether a row's mark names the gyroscope: its name, or 1 in a column "is it the gyroscope?".
fn is_gyroscope(mark: &str) -> bool {
    mark.to_ascii_lowercase().contains("gyr") || mark.parse() == Ok(1.0)
}

/// Reads a table of gyroscope and accelerometer, which may share rows or not; what a row does not hold is NaN.
pub(crate) fn imu_table(
    path: &Path,
    rule: UnitRule,
    places: Places<6>,
) -> Result<(Vec<TimedRow<6>>, Vec<Warning>), DatasetError> {
    let mut numbers = TimedNumbers::at(rule, places, IMU_COLUMNS);
    for_each_block(path, |block, lines_before| numbers.add(block, lines_before))?;
    Ok(numbers.finish(path))
}

/// A row of a table of poses with numbers of frames.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NumberedPose {
    /// When.
    pub time: Timestamp,
    /// Number of the frame.
    pub frame: u64,
    /// The pose as written; `None` where it is no rigid motion.
    pub world_from_camera: Option<Se3>,
}

/// Reads `time, frame, x, y, z, qx, qy, qz, qw` rows (Stray Scanner's `odometry.csv`).
pub fn numbered_poses(
    source: &Source<'_>,
    rule: UnitRule,
) -> Result<(Vec<NumberedPose>, Vec<Warning>), DatasetError> {
    let mut numbers = TimedNumbers::<8>::new(rule, "time, frame, x y z, qx qy qz qw");
    numbers.add(source, 0)?;
    let (rows, notes) = numbers.finish(source.path);
    let pose = |(time, [frame, x, y, z, qx, qy, qz, qw]): TimedRow<8>| {
        let norm = (qx * qx + qy * qy + qz * qz + qw * qw).sqrt();
        let rotation = So3::from_quaternion(qx, qy, qz, qw).filter(|_| (norm - 1.0).abs() < 0.05);
        let world_from_camera = rotation.map(|r| Se3::new(r, Vector3::new(x, y, z)));
        // A negative or fractional number becomes that of no frame's file.
        NumberedPose { time, frame: frame.max(0.0) as u64, world_from_camera }
    };
    Ok((rows.into_iter().map(pose).collect(), notes))
}

fn imu_samples((rows, notes): (Vec<TimedRow<6>>, Vec<Warning>)) -> (Vec<ImuSample>, Vec<Warning>) {
    let sample = |(time, [gx, gy, gz, ax, ay, az]): TimedRow<6>| ImuSample {
        time,
        gyro: AngularRate(Vector3::new(gx, gy, gz)),
        accel: SpecificForce(Vector3::new(ax, ay, az)),
    };
    (rows.into_iter().map(sample).collect(), notes)
}

/// Reads EuRoC's `imu0/data.csv`: time, gyroscope (rad/s), accelerometer (m/s²).
pub fn imu_csv(source: &Source<'_>, rule: UnitRule) -> Result<(Vec<ImuSample>, Vec<Warning>), DatasetError> {
    let mut numbers = imu_numbers(rule);
    numbers.add(source, 0)?;
    Ok(imu_samples(numbers.finish(source.path)))
}

/// The same of a file, which is never in memory as a whole.
pub(crate) fn imu_file(path: &Path, rule: UnitRule) -> Result<(Vec<ImuSample>, Vec<Warning>), DatasetError> {
    let mut numbers = imu_numbers(rule);
    for_each_block(path, |block, lines_before| numbers.add(block, lines_before))?;
    Ok(imu_samples(numbers.finish(path)))
}

/// Reads TUM's `accelerometer.txt`: time, accelerometer (m/s²).
pub fn accelerometer_list(
    source: &Source<'_>,
    rule: UnitRule,
) -> Result<(Vec<AccelSample>, Vec<Warning>), DatasetError> {
    let mut numbers = TimedNumbers::<3>::new(rule, "time ax ay az");
    numbers.add(source, 0)?;
    let (rows, notes) = numbers.finish(source.path);
    let samples = rows
        .into_iter()
        .map(|(time, [x, y, z])| AccelSample { time, accel: SpecificForce(Vector3::new(x, y, z)) })
        .collect();
    Ok((samples, notes))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_in_blocks_is_the_same_as_the_whole() {
        // Some 7 MB: two block boundaries, each inside a line.
        let row = |i: usize| {
            let x = if i == 80_000 { f64::NAN } else { (i as f64 * 0.37).sin() };
            format!(
                "{},{x},-0.25,{i},0.1,9.80665,-0.000123456789\r\n",
                1_400_000_000_000_000_000 + 5_000_000 * i
            )
        };
        let text: String =
            std::iter::once("#timestamp [ns],w_x,...\n".into()).chain((0..100_000).map(row)).collect();
        assert!(text.len() > 6 << 20);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("data.csv");
        std::fs::write(&path, &text).unwrap();
        let rule = UnitRule::Expected(TimeUnit::Nanoseconds);
        let whole = imu_csv(&Source { path: &path, bytes: text.as_bytes() }, rule).unwrap();
        assert_eq!(whole.0.len(), 99_999);
        assert_eq!(
            whole.1.iter().map(|w| w.kind.as_str()).collect::<Vec<_>>(),
            ["crlf", "sample-not-finite"]
        );
        assert!(imu_file(&path, rule).unwrap() == whole);

        // An error names the line of the file, not of the block.
        std::fs::write(&path, text.replacen(",99000,", ",x,", 1)).unwrap();
        let error = imu_file(&path, rule).unwrap_err().to_string();
        assert!(error.contains("data.csv:99002"), "{error}");
        // One line without end.
        std::fs::write(&path, vec![b'1'; 9 << 20]).unwrap();
        let error = imu_file(&path, rule).unwrap_err().to_string();
        assert!(error.contains("bytes a line"), "{error}");
    }
}
