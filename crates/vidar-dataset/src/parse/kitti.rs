//! KITTI's calibrations (`NAME: numbers` lines), times of day, and records of its inertial and satellite navigation.

use crate::error::DatasetError;
use crate::source::{MAX_ROWS, Source, quoted};
use nalgebra::{Matrix3, Vector3};
use vidar_core::{Se3, So3, Timestamp};

/// Most lines of a calibration, and most numbers of a line.
const MAX_LINES: usize = 256;
const MAX_NUMBERS: usize = 64;

/// K·[I | t] of a rectified image, row by row.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ProjectionMatrix([f64; 12]);

impl ProjectionMatrix {
    /// Focal length along x, pixels.
    pub fn fx(&self) -> f64 {
        self.0[0]
    }

    /// Focal length along y, pixels.
    pub fn fy(&self) -> f64 {
        self.0[5]
    }

    /// Principal point, pixels.
    pub fn cx(&self) -> f64 {
        self.0[2]
    }

    /// Principal point, pixels.
    pub fn cy(&self) -> f64 {
        self.0[6]
    }

    /// t: the position of the reference camera in this camera, m; zero where the focal lengths are.
    pub fn translation(&self) -> Vector3<f64> {
        let p = &self.0;
        let z = p[11];
        let over = |value: f64, focal: f64| if focal == 0.0 { 0.0 } else { value / focal };
        Vector3::new(over(p[3] - p[2] * z, p[0]), over(p[7] - p[6] * z, p[5]), z)
    }

    fn is_finite(&self) -> bool {
        self.0.iter().all(|v| v.is_finite())
    }
}

/// Lines `NAME: numbers`; lines of other content (dates, names) hold no numbers and are left out.
pub fn named_numbers(source: &Source<'_>) -> Result<Vec<(String, Vec<f64>)>, DatasetError> {
    let mut out = Vec::new();
    let text = source.text(&mut Vec::new())?;
    for (index, line) in text.lines().enumerate() {
        let Some((name, rest)) = line.split_once(':') else { continue };
        if index >= MAX_LINES {
            return Err(source.malformed(index + 1, format!("more than {MAX_LINES} lines"), "a calibration"));
        }
        let numbers: Option<Vec<f64>> =
            rest.split_ascii_whitespace().take(MAX_NUMBERS + 1).map(|n| n.parse().ok()).collect();
        if let Some(numbers) = numbers.filter(|n| !n.is_empty()) {
            if numbers.len() > MAX_NUMBERS {
                return Err(source.malformed(
                    index + 1,
                    format!("more than {MAX_NUMBERS} numbers"),
                    "a matrix",
                ));
            }
            out.push((name.trim().to_string(), numbers));
        }
    }
    Ok(out)
}

/// The projections of a calibration: its lines of twelve numbers, by name.
pub fn projection_matrices(source: &Source<'_>) -> Result<Vec<(String, ProjectionMatrix)>, DatasetError> {
    let matrices = named_numbers(source)?.into_iter().filter_map(|(name, n)| {
        let matrix = ProjectionMatrix(n.try_into().ok()?);
        matrix.is_finite().then_some((name, matrix))
    });
    Ok(matrices.collect())
}

/// The rigid motion of the lines `R:` (9 numbers) and `T:` (3).
pub fn rotation_and_translation(source: &Source<'_>) -> Result<Se3, DatasetError> {
    let lines = named_numbers(source)?;
    let find = |name: &str| lines.iter().find(|(n, _)| n == name).map(|(_, v)| v.as_slice());
    let expected = "R: with 9 numbers and T: with 3";
    let (Some(r), Some(&[x, y, z])) = (find("R"), find("T")) else {
        return Err(source.malformed(0, "no rotation and translation", expected));
    };
    let rotation = (r.len() == 9).then(|| So3::from_matrix(&Matrix3::from_row_slice(r))).flatten();
    let motion = rotation.map(|r| Se3::new(r, Vector3::new(x, y, z))).filter(Se3::is_finite);
    motion.ok_or_else(|| source.malformed(0, "R is no rotation, or T is not finite", expected))
}

/// Reads lines such as `2011-09-26 13:02:25.964389445`.
pub fn times_of_day(source: &Source<'_>) -> Result<Vec<Timestamp>, DatasetError> {
    let mut times = Vec::new();
    for row in source.lines(&mut Vec::new())?.rows {
        if times.len() == MAX_ROWS {
            return Err(source.too_many_rows(row.line, MAX_ROWS));
        }
        let time = date_and_time(row.text).ok_or_else(|| {
            source.malformed(
                row.line,
                quoted(row.text),
                "a date and a time, such as 2011-09-26 13:02:25.964389445",
            )
        })?;
        times.push(time);
    }
    Ok(times)
}

/// A date and a time of the same zone as time since 1970.
pub(crate) fn date_and_time(text: &str) -> Option<Timestamp> {
    let (date, time) = text.trim().split_once([' ', 'T'])?;
    let mut date = date.split(['-', ':']).map(|part| part.parse::<i64>().ok());
    let (year, month, day) = (date.next()??, date.next()??, date.next()??);
    let (hours, rest) = time.split_once(':')?;
    let (minutes, secs) = rest.split_once(':')?;
    let (hours, minutes): (i64, i64) = (hours.parse().ok()?, minutes.parse().ok()?);
    let secs = Timestamp::parse_secs(secs).ok()?.nanos();
    let fits = (1900..2200).contains(&year)
        && (1..=12).contains(&month)
        && (1..=31).contains(&day)
        && (0..24).contains(&hours)
        && (0..60).contains(&minutes)
        && (0..61_000_000_000).contains(&secs);
    if !fits {
        return None;
    }
    // Days since 1970 of the Gregorian calendar, whose years are counted from March.
    let (y, m) = if month > 2 { (year, month - 3) } else { (year - 1, month + 9) };
    let days = 365 * y + y / 4 - y / 100 + y / 400 + (153 * m + 2) / 5 + day - 719_469;
    Some(Timestamp::from_nanos(((days * 24 + hours) * 60 + minutes) * 60_000_000_000 + secs))
}

/// A record of KITTI's inertial and satellite navigation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Oxts {
    /// Latitude and longitude, degrees; altitude, m.
    pub place: [f64; 3],
    /// Roll, pitch and yaw, rad.
    pub angles: [f64; 3],
    /// Specific force, m/s², in the vehicle's axes: forward, left, up.
    pub accel: [f64; 3],
    /// Rate of turn, rad/s, in the same.
    pub gyro: [f64; 3],
}

/// Reads one record (`oxts/data/NNNNNNNNNN.txt`): 30 numbers, `dataformat.txt` names them.
pub fn oxts(source: &Source<'_>) -> Result<Oxts, DatasetError> {
    let rows = source.lines(&mut Vec::new())?.rows;
    let row = rows.first().ok_or_else(|| source.malformed(0, "an empty file", "30 numbers"))?;
    let mut numbers = [f64::NAN; 20];
    let mut fields = row.fields();
    for (index, number) in numbers.iter_mut().enumerate() {
        let field = fields
            .next()
            .ok_or_else(|| source.malformed(row.line, format!("{index} numbers"), "30 numbers"))?;
        *number = source.number(row, field, "a record of oxts")?;
    }
    let three = |from: usize| [numbers[from], numbers[from + 1], numbers[from + 2]];
    Ok(Oxts { place: three(0), angles: three(3), accel: three(11), gyro: three(17) })
}

impl Oxts {
    /// Pose of the unit in a local frame (x east, y north, z up) by the Mercator projection of the dataset's development kit, at
    /// the latitude `origin_deg` of the first record; `None` where a number is not finite.
    pub fn world_from_unit(&self, origin_deg: f64) -> Option<Se3> {
        const EARTH_RADIUS_M: f64 = 6_378_137.0;
        let scale = origin_deg.to_radians().cos();
        let [latitude, longitude, altitude] = self.place;
        let north = (std::f64::consts::FRAC_PI_4 + latitude.to_radians() / 2.0).tan().ln();
        let position = Vector3::new(
            scale * longitude.to_radians() * EARTH_RADIUS_M,
            scale * EARTH_RADIUS_M * north,
            altitude,
        );
        let [roll, pitch, yaw] = self.angles;
        if !self.angles.iter().all(|v| v.is_finite()) {
            return None;
        }
        let turn = |axis: Vector3<f64>, angle: f64| So3::from_axis_angle(&axis, angle);
        let rotation = turn(Vector3::z(), yaw) * turn(Vector3::y(), pitch) * turn(Vector3::x(), roll);
        let pose = Se3::new(rotation, position);
        pose.is_finite().then_some(pose)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_become_time_since_1970() {
        let secs = |text: &str| date_and_time(text).map(|t| t.nanos() / 1_000_000_000);
        assert_eq!(secs("1970-01-01 00:00:00"), Some(0));
        assert_eq!(secs("2000-02-29 12:00:00"), Some(951_825_600));
        assert_eq!(secs("2011-09-26 13:02:25.964389445"), Some(1_317_042_145));
        assert_eq!(
            date_and_time("2011-09-26 13:02:25.964389445").unwrap().nanos() % 1_000_000_000,
            964_389_445
        );
        assert_eq!(secs("2024:03:01 00:00:01"), Some(1_709_251_201), "as EXIF writes it");
        for bad in [
            "",
            "2011-09-26",
            "2011-13-26 1:1:1",
            "2011-09-26 25:00:00",
            "99999999999999999999-1-1 1:1:1",
            "4000000000000000000-1-1 1:1:1",
            "é-é-é 1:1:1",
        ] {
            assert_eq!(date_and_time(bad), None, "{bad}");
        }
    }
}
