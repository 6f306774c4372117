//! Checks of timestamps and IMU samples. Each fault becomes a warning.

use nalgebra::Vector3;
use std::path::Path;
use vidar_core::{Duration, ImuSample, Timestamp, Trajectory, Warning};

/// A gap is longer than this many median steps …
const GAP_STEPS: i64 = 3;
/// … and than this: odometry and interpolation bridge one or two dropped images at
/// 20 Hz, and ten lost IMU samples at 200 Hz.
pub(crate) const IMAGE_GAP_FLOOR: Duration = Duration::from_millis(200);
pub(crate) const IMU_GAP_FLOOR: Duration = Duration::from_millis(20);
pub(crate) const POSE_GAP_FLOOR: Duration = Duration::from_millis(500);

/// Brings `items` into strictly increasing time: sorts what is out of order, drops all but the first of each time.
pub(crate) fn put_in_order<T>(
    items: &mut Vec<T>,
    time: impl Fn(&T) -> Timestamp,
    what: &str,
    place: &Path,
    notes: &mut Vec<Warning>,
) {
    let backward = items.windows(2).filter(|w| time(&w[1]) < time(&w[0])).count();
    if backward > 0 {
        let message = format!("time of {what} goes backward {backward} times; sorted");
        notes.push(Warning::new("time-not-increasing", message).at(place.display()));
        items.sort_by_key(&time);
    }
    let before = items.len();
    let mut first = None;
    items.dedup_by(|later, earlier| {
        let same = time(later) == time(earlier);
        if same && first.is_none() {
            first = Some(time(later));
        }
        same
    });
    if let Some(at) = first {
        let message = format!(
            "{} {what} have the time of the one before, first at {at} s; dropped",
            before - items.len()
        );
        notes.push(Warning::new("time-duplicate", message).at(place.display()));
    }
}

/// Adds one warning for the gaps in strictly increasing times.
pub(crate) fn find_gaps(
    times: impl Iterator<Item = Timestamp>,
    floor: Duration,
    kind: &str,
    what: &str,
    place: &Path,
    notes: &mut Vec<Warning>,
) {
    let times: Vec<Timestamp> = times.collect();
    let steps: Vec<Duration> = times.windows(2).map(|w| w[1] - w[0]).collect();
    let mut sorted: Vec<i64> = steps.iter().map(|s| s.nanos()).collect();
    sorted.sort_unstable();
    let Some(&median) = sorted.get(sorted.len() / 2) else { return };
    let limit = Duration::from_nanos(median.saturating_mul(GAP_STEPS).max(floor.nanos()));
    let gaps: Vec<usize> = (0..steps.len()).filter(|&i| steps[i] > limit).collect();
    let Some(&longest) = gaps.iter().max_by_key(|&&i| (steps[i], std::cmp::Reverse(i))) else { return };
    let message = format!(
        "{} gaps in {what}; the longest is {} from {} s (the median step is {:.4} s)",
        gaps.len(),
        steps[longest],
        times[longest],
        median as f64 * 1e-9
    );
    notes.push(Warning::new(kind, message).at(place.display()));
}

/// Accelerometers measure about 9.8 m/s² at rest anywhere on Earth; 8.5 to 11 leaves room for motion and bias.
const GRAVITY_RANGE_MPS2: std::ops::RangeInclusive<f64> = 8.5..=11.0;
/// Largest standard deviation of |accel| in a second that counts as still (vibration of idle rotors stays below).
const STILL_DEVIATION_MPS2: f64 = 0.3;
/// 2000 °/s, the full scale of common gyroscopes, rad/s.
const GYRO_FULL_SCALE_RADPS: f64 = 34.9;

/// Mean of the norm over the first still second, else over everything.
pub(crate) fn resting_norm(samples: &[(Timestamp, f64)]) -> Option<(f64, bool)> {
    let mut from = 0;
    while from < samples.len() {
        let end = samples[from].0 + Duration::from_millis(1000);
        let until = from + samples[from..].partition_point(|s| s.0 < end);
        let window = &samples[from..until];
        // An incomplete second, or one with few samples, is not enough for a mean.
        if until < samples.len() && window.len() >= 10 {
            let mean = mean(window);
            let variance = window.iter().map(|s| (s.1 - mean).powi(2)).sum::<f64>() / window.len() as f64;
            if variance.sqrt() < STILL_DEVIATION_MPS2 {
                return Some((mean, true));
            }
        }
        from = until.max(from + 1);
    }
    (!samples.is_empty()).then(|| (mean(samples), false))
}

fn mean(samples: &[(Timestamp, f64)]) -> f64 {
    samples.iter().map(|s| s.1).sum::<f64>() / samples.len() as f64
}

/// Standard gravity, m/s²; anywhere on Earth it is within 0.3 % of it.
const GRAVITY_MPS2: f64 = 9.80665;
/// Specific force at rest further off than this share is a wrong gain or a large bias. Gravity's own variation is 0.3 %.
const GAIN_TOLERANCE: f64 = 0.01;
/// At rest: largest standard deviation of each axis of the accelerometer over a second, and largest mean rate of turn, which
/// leaves room for the bias of a consumer gyroscope and none for a hand that sways.
const REST_DEVIATION_MPS2: f64 = 0.3;
const REST_TURN_RADPS: f64 = 0.1;
const REST_TURN_DEVIATION_RADPS: f64 = 0.02;

/// Median of |accel| over the seconds in which the IMU rests, m/s²; none where it never does.
///
/// The mean of each axis is taken before the norm, so that noise does not make it longer. `imu` must be in order of time.
pub fn specific_force_at_rest(imu: &[ImuSample]) -> Option<f64> {
    let mut norms = Vec::new();
    let mut from = 0;
    while from < imu.len() {
        let end = imu[from].time + Duration::from_millis(1000);
        let until = from + imu[from..].partition_point(|s| s.time < end);
        let window = &imu[from..until];
        if until < imu.len() && window.len() >= 10 {
            let (accel, accel_std) = mean_and_deviation(window.iter().map(|s| s.accel.0));
            let (gyro, gyro_std) = mean_and_deviation(window.iter().map(|s| s.gyro.0));
            if accel_std < REST_DEVIATION_MPS2
                && gyro_std < REST_TURN_DEVIATION_RADPS
                && gyro.norm() < REST_TURN_RADPS
            {
                norms.push(accel.norm());
            }
        }
        from = until.max(from + 1);
    }
    norms.sort_unstable_by(f64::total_cmp);
    norms.get(norms.len() / 2).copied()
}

/// Mean, and the largest standard deviation of an axis.
fn mean_and_deviation(values: impl Iterator<Item = Vector3<f64>> + Clone) -> (Vector3<f64>, f64) {
    let n = values.clone().count().max(1) as f64;
    let mean = values.clone().sum::<Vector3<f64>>() / n;
    let variance = values.map(|v| (v - mean).component_mul(&(v - mean))).sum::<Vector3<f64>>() / n;
    (mean, variance.max().max(0.0).sqrt())
}

/// Share by which the accelerometer's length of gravity is off at rest; none where the IMU never rests.
pub fn gain_error_at_rest(imu: &[ImuSample]) -> Option<f64> {
    specific_force_at_rest(imu).map(|norm| norm / GRAVITY_MPS2 - 1.0)
}

/// Checks the accelerometer's gain at rest.
fn check_gain(imu: &[ImuSample], place: &Path, notes: &mut Vec<Warning>) {
    let Some(error) = gain_error_at_rest(imu).filter(|e| e.abs() > GAIN_TOLERANCE) else { return };
    let norm = GRAVITY_MPS2 * (1.0 + error);
    if !GRAVITY_RANGE_MPS2.contains(&norm) {
        // `gravity-norm` says it.
        return;
    }
    let message = format!(
        "at rest the accelerometer measures {norm:.3} m/s², {:+.1} % of gravity: its gain is wrong or its bias is large",
        100.0 * error
    );
    notes.push(
        Warning::new("accelerometer-gain", message)
            .at(place.display())
            .hint("a wrong gain makes all lengths wrong by as much; calibrate the IMU, or scale its samples"),
    );
}

/// Checks the norm of gravity.
pub(crate) fn check_gravity(norms: &[(Timestamp, f64)], place: &Path, notes: &mut Vec<Warning>) {
    let Some((norm, still)) = resting_norm(norms) else { return };
    if GRAVITY_RANGE_MPS2.contains(&norm) {
        return;
    }
    let when = if still { "over the first still second" } else { "on the whole" };
    let guess = match norm {
        n if (0.8..1.2).contains(&n) => "; it looks like units of g",
        n if (800.0..1200.0).contains(&n) => "; it looks like units of mg",
        n if n < 0.5 => "; gravity seems to have been removed",
        _ => "",
    };
    let message = format!("mean |accel| {when} is {norm:.3} m/s², not 8.5 to 11{guess}");
    let hint = "the accelerometer must hold specific force in m/s², gravity included";
    notes.push(Warning::new("gravity-norm", message).at(place.display()).hint(hint));
}

/// Checks IMU samples, which must be in order of time.
pub(crate) fn check_imu(imu: &[ImuSample], place: &Path, notes: &mut Vec<Warning>) {
    find_gaps(imu.iter().map(|s| s.time), IMU_GAP_FLOOR, "imu-gap", "the IMU samples", place, notes);
    let norms: Vec<_> = imu.iter().map(|s| (s.time, s.accel.0.norm())).collect();
    check_gravity(&norms, place, notes);
    check_gain(imu, place, notes);
    let fastest = imu.iter().map(|s| s.gyro.0.amax()).fold(0.0, f64::max);
    if fastest > GYRO_FULL_SCALE_RADPS {
        let message =
            format!("the gyroscope measures up to {fastest:.1} rad/s, more than 2000 °/s; it looks like °/s");
        notes.push(Warning::new("gyro-range", message).at(place.display()));
    }
}

/// Checks that there are IMU samples before and after every image.
pub(crate) fn check_imu_coverage(
    images: &[crate::recording::ImageEntry],
    imu: &[ImuSample],
    place: &Path,
    notes: &mut Vec<Warning>,
) {
    let (Some(first), Some(last)) = (imu.first(), imu.last()) else { return };
    let outside = images.iter().filter(|i| i.time < first.time || i.time > last.time).count();
    if outside > 0 {
        let message = format!(
            "{outside} of {} images lie outside the time of the IMU samples ({} to {} s)",
            images.len(),
            first.time,
            last.time
        );
        notes.push(Warning::new("imu-coverage", message).at(place.display()));
    }
}

/// Checks that images and a trajectory overlap in time.
pub(crate) fn check_overlap(
    images: Option<(Timestamp, Timestamp)>,
    trajectory: &Trajectory,
    what: &str,
    place: &Path,
    notes: &mut Vec<Warning>,
) {
    let (Some(images), Some(poses)) = (images, trajectory.time_range()) else { return };
    if poses.0 <= images.1 && images.0 <= poses.1 {
        return;
    }
    let message = format!(
        "no overlap in time: images {} to {} s, {what} {} to {} s{}",
        images.0,
        images.1,
        poses.0,
        poses.1,
        slip_between(images, poses)
    );
    notes.push(
        Warning::new("no-overlap", message)
            .at(place.display())
            .hint("give both files the same clock: the same unit and the same origin"),
    );
}

/// The likely reason why the ranges do not overlap: a power of a thousand between the units, or a clock that starts at zero.
fn slip_between(images: (Timestamp, Timestamp), poses: (Timestamp, Timestamp)) -> String {
    let secs = |r: (Timestamp, Timestamp)| (r.0.as_secs_f64(), r.1.as_secs_f64());
    let ((i0, i1), (p0, p1)) = (secs(images), secs(poses));
    for factor in [1e3, 1e6, 1e9] {
        if p0 * factor <= i1 && i0 <= p1 * factor {
            return format!("; pose times multiplied by {factor:e} would fit: they are in another unit");
        }
        if p0 / factor <= i1 && i0 <= p1 / factor {
            return format!("; pose times divided by {factor:e} would fit: they are in another unit");
        }
    }
    if p0.abs() < 1e3 && i0 > 1e8 {
        return "; the poses' clock starts near zero, the images' is Unix time".into();
    }
    if i0.abs() < 1e3 && p0 > 1e8 {
        return "; the images' clock starts near zero, the poses' is Unix time".into();
    }
    String::new()
}
