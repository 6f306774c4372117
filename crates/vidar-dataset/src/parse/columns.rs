//! Which columns of a table are time, gyroscope and accelerometer: by the names in its header, else by its numbers.

use super::timed::Places;
use crate::options::TimeUnit;

/// What a table of inertial measurements states about itself.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImuColumns {
    pub(crate) places: Places<6>,
    /// The unit of time, where the header names it.
    pub time_unit: Option<TimeUnit>,
    /// Whether the header says that the gyroscope is in degrees.
    pub is_in_degrees: bool,
    /// The unit of the accelerometer, where the header names it.
    pub accel_unit: Option<AccelUnit>,
    /// Whether the columns were told by their numbers, because there is no header.
    pub is_guessed: bool,
}

/// Unit of an accelerometer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AccelUnit {
    /// m/s².
    MetresPerSecondSquared,
    /// Standard gravity.
    Gravities,
}

impl ImuColumns {
    /// Whether the table holds a gyroscope.
    pub fn has_gyroscope(&self) -> bool {
        self.places.sensor.is_some() || self.places.numbers[0].is_some()
    }

    /// Whether the table holds an accelerometer.
    pub fn has_accelerometer(&self) -> bool {
        self.places.sensor.is_some() || self.places.numbers[3].is_some()
    }
}

/// Which sensor a file's name says that it holds, where its columns are only x, y and z.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Sensor {
    Gyroscope,
    Accelerometer,
}

fn sensor_of_name(file_name: &str) -> Option<Sensor> {
    let lower = file_name.to_ascii_lowercase();
    match (lower.contains("gyr"), lower.contains("acc")) {
        (true, false) => Some(Sensor::Gyroscope),
        (false, true) => Some(Sensor::Accelerometer),
        _ => None,
    }
}

/// The name of a column without its unit, in lower case, letters and digits only; and the unit.
fn split_unit(name: &str) -> (String, String) {
    let (stem, unit) = match name.find(['[', '(']) {
        Some(at) => name.split_at(at),
        None => (name, ""),
    };
    let stem: String =
        stem.chars().filter(char::is_ascii_alphanumeric).map(|c| c.to_ascii_lowercase()).collect();
    (stem, unit.trim_matches(['[', ']', '(', ')', ' ', '?']).to_ascii_lowercase())
}

fn time_unit(stem: &str, unit: &str) -> Option<TimeUnit> {
    let by_name = |text: &str| match text {
        "ns" | "nanosec" | "nanosecs" | "nanosecond" | "nanoseconds" => Some(TimeUnit::Nanoseconds),
        "us" | "microsec" | "microseconds" | "µs" => Some(TimeUnit::Microseconds),
        "ms" | "millisec" | "milliseconds" => Some(TimeUnit::Milliseconds),
        "s" | "sec" | "secs" | "seconds" => Some(TimeUnit::Seconds),
        _ => None,
    };
    let ending = ["timestamp", "time", "stamp", "t", ""].iter().find_map(|word| stem.strip_prefix(word));
    by_name(unit).or_else(|| by_name(ending.unwrap_or("")))
}

/// How well a name fits a column of times; of equally good ones the first is taken.
fn fit_as_time(stem: &str) -> u8 {
    let is_short = ["t", "ts", "ns", "tns", "tus", "tms", "stamp", "nanoseconds", "seconds"].contains(&stem);
    match stem {
        _ if stem.contains("unix") || stem.contains("system") => 1,
        _ if stem.contains("time") || stem.contains("nsec") => 3,
        _ if is_short => 2,
        _ => 0,
    }
}

/// Names of gyroscopes and accelerometers before x, y, z. Alone, `alpha` and `omega` are decided by each other.
const GYROSCOPES: [&str; 14] = [
    "g",
    "w",
    "gyr",
    "gyro",
    "gyroscope",
    "rotationrate",
    "rot",
    "omega",
    "angularvelocity",
    "angvel",
    "wrss",
    "rotation",
    "angularrate",
    "gyrometer",
];
const ACCELEROMETERS: [&str; 9] = [
    "a",
    "acc",
    "accel",
    "accelerometer",
    "acceleration",
    "linearacceleration",
    "arss",
    "specificforce",
    "totalacceleration",
];

/// The columns that a header names; `None` where it names no time, or neither sensor.
///
/// `file_name` decides whose `x`, `y` and `z` are, where that is all the header says.
pub fn imu_columns(header: &str, file_name: &str) -> Option<ImuColumns> {
    let header = header.trim_start_matches(['#', ' ']);
    let by_blank = !header.contains([',', ';', '\t']);
    let is_end = |c: char| if by_blank { c == ' ' } else { [',', ';', '\t'].contains(&c) };
    let names: Vec<(String, String)> = header.split(is_end).take(64).map(split_unit).collect();
    let best = names.iter().map(|(stem, _)| fit_as_time(stem)).max().filter(|&fit| fit > 0)?;
    let time = names.iter().position(|(stem, _)| fit_as_time(stem) == best)?;
    let axes = |is_named: &dyn Fn(&str) -> bool| -> Option<[usize; 3]> {
        let find = |axis: &str| names.iter().position(|(s, _)| s.strip_suffix(axis).is_some_and(is_named));
        Some([find("x")?, find("y")?, find("z")?])
    };
    let listed = |list: &[&str]| axes(&|stem| list.contains(&stem));
    // "g-force" columns hold gravity and are in g; `a` beside them is without gravity (Physics Toolbox).
    let g_force = listed(&["gf", "gforce"]);
    let mut accel = g_force.or_else(|| listed(&ACCELEROMETERS));
    let mut gyro = listed(&GYROSCOPES);
    // Stray Scanner calls the rate of turn alpha, Kalibr the acceleration.
    match (gyro, accel) {
        (None, Some(_)) => gyro = listed(&["alpha"]),
        (Some(_), None) => accel = listed(&["alpha"]),
        _ => {}
    }
    let mut sensor = None;
    if gyro.is_none() && accel.is_none() {
        let plain = listed(&[""])?;
        let mark = |(stem, _): &(String, String)| {
            ["isgyro", "sensor", "sensortype", "type", "sensorname"].contains(&stem.as_str())
        };
        sensor = names.iter().position(mark);
        match (sensor, sensor_of_name(file_name)) {
            (Some(_), _) | (None, Some(Sensor::Gyroscope)) => gyro = Some(plain),
            (None, Some(Sensor::Accelerometer)) => accel = Some(plain),
            (None, None) => return None,
        }
    }
    let unit_of = |axes: Option<[usize; 3]>| axes.map_or("", |[x, ..]| names[x].1.as_str());
    let accel_unit = match unit_of(accel) {
        "g" | "gs" => Some(AccelUnit::Gravities),
        unit if unit.contains("m/s") || unit.contains("m s") => Some(AccelUnit::MetresPerSecondSquared),
        _ => g_force.map(|_| AccelUnit::Gravities),
    };
    let gyro_unit = unit_of(gyro);
    let is_in_degrees = ["deg", "°", "dps"].iter().any(|word| gyro_unit.contains(word));
    let (stem, unit) = &names[time];
    Some(ImuColumns {
        places: places(time, gyro, accel, sensor),
        time_unit: time_unit(stem, unit),
        is_in_degrees,
        accel_unit,
        is_guessed: false,
    })
}

fn places(
    time: usize,
    gyro: Option<[usize; 3]>,
    accel: Option<[usize; 3]>,
    sensor: Option<usize>,
) -> Places<6> {
    let both = [gyro, accel].map(|axes| axes.map_or([None; 3], |a| a.map(Some)));
    let [[gx, gy, gz], [ax, ay, az]] = both;
    Places { time, numbers: [gx, gy, gz, ax, ay, az], sensor, is_sparse: true }
}

/// The columns of a table without header, by its first rows: the time is the first column that never goes backward, else the last;
/// of two triples the one whose mean has the length of gravity is the accelerometer, else the second, as in EuRoC's lists. Rows of
/// poses look the same, so the file's name must speak of an IMU.
pub(crate) fn columns_by_numbers(rows: &[Vec<f64>], file_name: &str) -> Option<ImuColumns> {
    let width = rows.first()?.len();
    let lower = file_name.to_ascii_lowercase();
    if !["imu", "gyr", "acc", "inertial", "motion"].iter().any(|word| lower.contains(word)) {
        return None;
    }
    if rows.len() < 3 || !(4..=64).contains(&width) || rows.iter().any(|r| r.len() != width) {
        return None;
    }
    let is_time = |column: usize| {
        rows.windows(2).all(|w| w[0][column] <= w[1][column])
            && rows[0][column] < rows[rows.len() - 1][column]
    };
    let time = [0, width - 1].into_iter().find(|&column| is_time(column))?;
    let free: Vec<usize> = (0..width).filter(|&column| column != time).collect();
    let triple = |from: usize| -> Option<[usize; 3]> { free.get(from..from + 3)?.try_into().ok() };
    let first = triple(0)?;
    let (gyro, accel) = match (triple(3), sensor_of_name(file_name)) {
        (None, Some(Sensor::Gyroscope)) => (Some(first), None),
        (None, Some(Sensor::Accelerometer)) => (None, Some(first)),
        (None, None) if is_gravity(rows, first) => (None, Some(first)),
        (None, None) => return None,
        (Some(second), _) if is_gravity(rows, first) && !is_gravity(rows, second) => {
            (Some(second), Some(first))
        }
        (Some(second), _) => (Some(first), Some(second)),
    };
    Some(ImuColumns {
        places: places(time, gyro, accel, None),
        time_unit: None,
        is_in_degrees: false,
        accel_unit: None,
        is_guessed: true,
    })
}

/// Whether the mean length of a triple is that of gravity, in m/s² or in g.
fn is_gravity(rows: &[Vec<f64>], axes: [usize; 3]) -> bool {
    let length = |row: &Vec<f64>| axes.iter().map(|&a| row[a] * row[a]).sum::<f64>().sqrt();
    let mean = rows.iter().map(length).sum::<f64>() / rows.len() as f64;
    (8.5..=11.0).contains(&mean) || (0.85..=1.15).contains(&mean)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(header: &str, name: &str) -> ([Option<usize>; 6], usize, Option<TimeUnit>) {
        let found = imu_columns(header, name).unwrap_or_else(|| panic!("{header}"));
        (found.places.numbers, found.places.time, found.time_unit)
    }

    #[test]
    fn headers_of_recorders_are_understood() {
        let six = |first: usize, second: usize| {
            [first, first + 1, first + 2, second, second + 1, second + 2].map(Some)
        };
        let ns = Some(TimeUnit::Nanoseconds);
        // MARS Logger, Stray Scanner, Kalibr, EuRoC.
        let mars = "Timestamp[nanosec],gx[rad/s],gy[rad/s],gz[rad/s],ax[m/s^2],ay[m/s^2],az[m/s^2],Unix time[nanosec]";
        assert_eq!(of(mars, "gyro_accel.csv"), (six(1, 4), 0, ns));
        let stray = "timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z";
        assert_eq!(of(stray, "imu.csv"), (six(4, 1), 0, None));
        let kalibr = "timestamp,omega_x,omega_y,omega_z,alpha_x,alpha_y,alpha_z";
        assert_eq!(of(kalibr, "imu0.csv"), (six(1, 4), 0, None));
        let euroc = "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]";
        assert_eq!(of(euroc, "data.csv"), (six(1, 4), 0, ns));
        assert_eq!(
            imu_columns(euroc, "").unwrap().accel_unit,
            Some(AccelUnit::MetresPerSecondSquared),
            "the unit in brackets"
        );
        // Physics Toolbox: g-force with gravity beside an acceleration without.
        let toolbox = "time,gFx,gFy,gFz,ax,ay,az,wx,wy,wz";
        assert_eq!(of(toolbox, "x.csv"), (six(7, 1), 0, None));
        assert_eq!(imu_columns(toolbox, "").unwrap().accel_unit, Some(AccelUnit::Gravities));
        assert!(imu_columns("t_ns,gyro_x (deg/s),gyro_y (deg/s),gyro_z (deg/s)", "").unwrap().is_in_degrees);
        // A sensor in a file of its own, its axes in any order; two sensors row by row.
        let [x, y, z] = [4, 3, 2].map(Some);
        let alone = "time,seconds_elapsed,z,y,x";
        assert_eq!(of(alone, "Gyroscope.csv"), ([x, y, z, None, None, None], 0, None));
        assert_eq!(of(alone, "Accelerometer.csv"), ([None, None, None, x, y, z], 0, None));
        let mixed =
            imu_columns("Timestamp[nanosec], x, y, z[(a:m/s^2)/(g:rad/s)], isGyro?", "raw.csv").unwrap();
        assert_eq!(mixed.places.sensor, Some(4));
        assert_eq!(of("timestamp wx wy wz ax ay az", "imu.txt"), (six(1, 4), 0, None));
        for no in ["", "time,latitude,longitude", "a_x,a_y,a_z", "time,x,y,z", "frame,file"] {
            assert_eq!(imu_columns(no, "Location.csv"), None, "{no}");
        }
    }

    #[test]
    fn without_a_header_numbers_tell() {
        let row = |i: usize, first: f64, second: f64| vec![i as f64, 0.0, 0.0, first, 0.0, second, 0.0];
        let euroc: Vec<_> = (0..9).map(|i| row(i, 0.1, 9.8)).collect();
        let found = columns_by_numbers(&euroc, "imu.csv").unwrap();
        assert_eq!(found.places.numbers, [1, 2, 3, 4, 5, 6].map(Some));
        let swapped: Vec<_> = (0..9).map(|i| row(i, -1.0, 0.1)).collect();
        let found = columns_by_numbers(&swapped, "imu.csv").unwrap();
        assert_eq!(found.places.numbers, [4, 5, 6, 1, 2, 3].map(Some));
        // OpenCamera Sensors: x, y, z, then the time.
        let last: Vec<_> =
            (0..9).map(|i| vec![0.1, -0.1 * (i % 3) as f64, 0.0, 1e12 + i as f64 * 1e7]).collect();
        let found = columns_by_numbers(&last, "VID_1_gyro.csv").unwrap();
        assert_eq!((found.places.time, found.places.numbers[0]), (3, Some(0)));
        assert_eq!(columns_by_numbers(&last, "VID_1.csv"), None, "whose they are is not known");
        assert_eq!(columns_by_numbers(&euroc, "trajectory.txt"), None, "poses look the same");
        assert_eq!(columns_by_numbers(&euroc[..2], "imu.csv"), None);
        let constant: Vec<_> = (0..9).map(|_| row(1, 0.1, 9.8)).collect();
        assert_eq!(columns_by_numbers(&constant, "imu.csv"), None);
    }
}
