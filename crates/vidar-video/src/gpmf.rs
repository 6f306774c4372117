//! Telemetry of GoPro cameras: key, length, value (<https://github.com/gopro/gpmf-parser>, "GPMF format").
//!
//! A payload covers about a second. It holds devices (`DEVC`) of streams (`STRM`); a stream states its unit (`SIUN`), scale
//! (`SCAL`) and axes (`ORIN`) before its values (`GYRO`, `ACCL`).

use nalgebra::Vector3;
use vidar_core::{ImuSample, TimedVector, Timestamp, merge_imu};

/// What an action camera recorded beside the pictures.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Telemetry {
    /// The camera's name.
    pub device: String,
    /// Samples of gyroscope and accelerometer at the gyroscope's times, in axes of the camera's own.
    pub imu: Vec<ImuSample>,
    /// Mean rate of the gyroscope, Hz.
    pub gyro_rate_hz: f64,
    /// Mean rate of the accelerometer, Hz; the samples above are interpolated to the gyroscope's times.
    pub accel_rate_hz: f64,
    /// Whether the axes are stated (`ORIN`) or those published for the older cameras.
    pub axes_are_stated: bool,
    /// How the camera and, against it, the picture are turned, where the camera states it: it may be stabilised.
    pub turns: StatedTurns,
    /// Units of gyroscope and accelerometer, as stated.
    pub units: [String; 2],
}

/// What a camera states of its stabiliser, one value a frame: quaternions, w first.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StatedTurns {
    /// Turn of the camera since the recording began (`CORI`).
    pub camera: Vec<[f64; 4]>,
    /// Turn of the picture against the camera (`IORI`).
    pub image: Vec<[f64; 4]>,
    /// The axes, X 0 to Z 2, that the telemetry names its channels by. Quaternions seem to have the same order, without signs: those of a GoPro
    /// MAX agree so with its gyroscope.
    pub channels: [usize; 3],
}

impl StatedTurns {
    /// Whether the camera states none.
    pub fn is_empty(&self) -> bool {
        self.camera.is_empty() && self.image.is_empty()
    }
}

/// One entry.
struct Entry<'a> {
    key: [u8; 4],
    kind: u8,
    size: usize,
    data: &'a [u8],
}

/// The entries that follow each other; ends at the first one that is not whole.
fn entries(mut bytes: &[u8]) -> impl Iterator<Item = Entry<'_>> {
    std::iter::from_fn(move || {
        let head: [u8; 8] = *bytes.first_chunk()?;
        let size = usize::from(head[5]);
        let length = size * usize::from(u16::from_be_bytes([head[6], head[7]]));
        let data = bytes.get(8..8 + length)?;
        bytes = bytes.get(8 + length.next_multiple_of(4)..).unwrap_or_default();
        Some(Entry { key: [head[0], head[1], head[2], head[3]], kind: head[4], size, data })
    })
}

impl Entry<'_> {
    fn text(&self) -> String {
        // Type `c` is Latin-1: "m/s²" has one byte for its square.
        let text: String = self.data.iter().map(|&b| char::from(b)).collect();
        vidar_core::printable(text.trim_matches(['\0', ' '])).into_owned()
    }

    /// Its numbers, whatever their type.
    fn numbers(&self) -> Vec<f64> {
        let wide = match self.kind {
            b's' | b'S' => 2,
            b'l' | b'L' | b'f' => 4,
            b'b' | b'B' => 1,
            b'd' => 8,
            _ => return Vec::new(),
        };
        let number = |b: &[u8]| match (self.kind, b) {
            (b's', &[a, b]) => f64::from(i16::from_be_bytes([a, b])),
            (b'S', &[a, b]) => f64::from(u16::from_be_bytes([a, b])),
            (b'l', &[a, b, c, d]) => f64::from(i32::from_be_bytes([a, b, c, d])),
            (b'L', &[a, b, c, d]) => f64::from(u32::from_be_bytes([a, b, c, d])),
            (b'f', &[a, b, c, d]) => f64::from(f32::from_be_bytes([a, b, c, d])),
            (b'd', &[a, b, c, d, e, f, g, h]) => f64::from_be_bytes([a, b, c, d, e, f, g, h]),
            (b'b', &[a]) => f64::from(a as i8),
            (_, &[a]) => f64::from(a),
            _ => 0.0,
        };
        self.data.chunks_exact(wide).map(number).collect()
    }
}

/// One sensor over the whole recording.
#[derive(Default)]
struct Stream {
    values: Vec<Vector3<f64>>,
    /// For every payload: its time and duration, and the number of values up to its beginning.
    payloads: Vec<Payload>,
    unit: String,
    axes: Option<[(usize, f64); 3]>,
}

/// Without `ORIN` the order is Z, X, Y, as published for the first cameras with telemetry.
const UNSTATED_AXES: [(usize, f64); 3] = [(2, 1.0), (0, 1.0), (1, 1.0)];

#[derive(Clone, Copy)]
struct Payload {
    time_ns: i64,
    duration_ns: i64,
    values_before: usize,
}

/// Most values of a stream: ten hours at 1 kHz.
const MAX_VALUES: usize = 36_000_000;

/// Reads all payloads: time and duration of each, ns, and its bytes.
pub(crate) fn read(payloads: &[(i64, i64, Vec<u8>)]) -> Telemetry {
    let (mut gyro, mut accel) = (Stream::default(), Stream::default());
    let mut telemetry = Telemetry::default();
    for (time_ns, duration_ns, bytes) in payloads {
        for device in entries(bytes).filter(|e| e.key == *b"DEVC" && e.kind == 0) {
            for entry in entries(device.data) {
                match &entry.key {
                    b"DVNM" if telemetry.device.is_empty() => telemetry.device = entry.text(),
                    b"STRM" if entry.kind == 0 => {
                        for (key, stream) in [(b"GYRO", &mut gyro), (b"ACCL", &mut accel)] {
                            stream.take(entry.data, key, (*time_ns, *duration_ns));
                        }
                        let turns = &mut telemetry.turns;
                        take_quaternions(&mut turns.camera, entry.data, b"CORI");
                        take_quaternions(&mut turns.image, entry.data, b"IORI");
                    }
                    _ => {}
                }
            }
        }
    }
    telemetry.axes_are_stated = gyro.axes.is_some() && accel.axes.is_some();
    telemetry.turns.channels = gyro.axes.unwrap_or(UNSTATED_AXES).map(|(axis, _)| axis);
    telemetry.units = [gyro.unit.clone(), accel.unit.clone()];
    let (gyro_times, accel_times) = (gyro.times(), accel.times());
    telemetry.gyro_rate_hz = rate_hz(&gyro_times);
    telemetry.accel_rate_hz = rate_hz(&accel_times);
    telemetry.imu = merge_imu(&timed(&gyro, &gyro_times), &timed(&accel, &accel_times));
    telemetry
}

impl Stream {
    /// Takes the values of one payload's stream, where it is this sensor's.
    fn take(&mut self, stream: &[u8], key: &[u8; 4], (time_ns, duration_ns): (i64, i64)) {
        let (mut scale, mut axes) = (vec![1.0], None);
        for entry in entries(stream) {
            match &entry.key {
                b"SCAL" => scale = entry.numbers(),
                b"ORIN" => axes = axes_of(&entry.text()),
                b"SIUN" | b"UNIT" if entries(stream).any(|e| e.key == *key) => self.unit = entry.text(),
                found if found == key && self.values.len() < MAX_VALUES => {
                    let per_value = entry.numbers();
                    let channels = entry.size / if matches!(entry.kind, b's' | b'S') { 2 } else { 4 };
                    if channels != 3 {
                        continue;
                    }
                    self.axes = axes;
                    self.payloads.push(Payload { time_ns, duration_ns, values_before: self.values.len() });
                    let axes = axes.unwrap_or(UNSTATED_AXES);
                    for value in per_value.as_chunks::<3>().0 {
                        let mut vector = Vector3::zeros();
                        for (channel, (axis, sign)) in axes.iter().enumerate() {
                            let divisor = scale.get(channel).or(scale.first()).copied().unwrap_or(1.0);
                            vector[*axis] = sign * value[channel] / divisor;
                        }
                        self.values.push(vector);
                    }
                }
                _ => {}
            }
        }
    }

    /// The time of every value, ns. The sensor's clock is steady and the payloads' times are not, so a straight line is fitted through
    /// the beginnings of the payloads; with fewer than three payloads the values are spread evenly.
    fn times(&self) -> Vec<f64> {
        let count = self.values.len();
        let (Some(first), Some(last)) = (self.payloads.first(), self.payloads.last()) else {
            return Vec::new();
        };
        let end_ns = (last.time_ns + last.duration_ns) as f64;
        let even = (end_ns - first.time_ns as f64) / count.max(1) as f64;
        let (mut slope, mut start) = (even, first.time_ns as f64);
        if self.payloads.len() >= 3 {
            let n = self.payloads.len() as f64;
            let mean = |f: &dyn Fn(&Payload) -> f64| self.payloads.iter().map(f).sum::<f64>() / n;
            let (x, y) = (mean(&|p| p.values_before as f64), mean(&|p| p.time_ns as f64));
            let xy = mean(&|p| (p.values_before as f64 - x) * (p.time_ns as f64 - y));
            let xx = mean(&|p| (p.values_before as f64 - x).powi(2));
            if xx > 0.0 && xy > 0.0 {
                slope = xy / xx;
                start = y - slope * x;
            }
        }
        (0..count).map(|i| start + slope * i as f64).collect()
    }
}

/// Takes one payload's quaternions, where the stream has them under `key`.
fn take_quaternions(all: &mut Vec<[f64; 4]>, stream: &[u8], key: &[u8; 4]) {
    let mut scale = 1.0;
    for entry in entries(stream) {
        match &entry.key {
            b"SCAL" => scale = entry.numbers().first().copied().unwrap_or(1.0),
            found if found == key && all.len() < MAX_VALUES => {
                all.extend(entry.numbers().as_chunks::<4>().0.iter().map(|q| q.map(|v| v / scale)));
            }
            _ => {}
        }
    }
}

fn rate_hz(times: &[f64]) -> f64 {
    match times {
        [first, .., last] if last > first => (times.len() - 1) as f64 * 1e9 / (last - first),
        _ => 0.0,
    }
}

/// `YxZ`: the first channel is Y, the second is −X, the third is Z.
fn axes_of(text: &str) -> Option<[(usize, f64); 3]> {
    let mut axes = [(0, 0.0); 3];
    let letters: Vec<char> = text.chars().collect();
    if letters.len() != 3 {
        return None;
    }
    let mut seen = [false; 3];
    for (axis, letter) in axes.iter_mut().zip(letters) {
        let number = "XYZ".find(letter.to_ascii_uppercase())?;
        seen[number] = true;
        *axis = (number, if letter.is_ascii_uppercase() { 1.0 } else { -1.0 });
    }
    seen.iter().all(|s| *s).then_some(axes)
}

/// The values of a stream with their times, in whole nanoseconds.
fn timed(stream: &Stream, times: &[f64]) -> Vec<TimedVector> {
    times.iter().map(|t| Timestamp::from_nanos(t.round() as i64)).zip(stream.values.iter().copied()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(key: &[u8; 4], kind: u8, size: u8, data: &[u8]) -> Vec<u8> {
        let repeat = (data.len() / usize::from(size.max(1))) as u16;
        let mut all = [key.as_slice(), &[kind, size], &repeat.to_be_bytes(), data].concat();
        all.resize(all.len().next_multiple_of(4), 0);
        all
    }

    fn shorts(values: &[i16]) -> Vec<u8> {
        values.iter().flat_map(|v| v.to_be_bytes()).collect()
    }

    fn payload(axes: Option<&[u8]>, gyro: &[i16], accel: &[i16]) -> Vec<u8> {
        let stream = |key, unit: &[u8], scale: i16, values: &[i16]| {
            let mut inside = entry(b"SIUN", b'c', unit.len() as u8, unit);
            inside.extend(entry(b"SCAL", b's', 2, &shorts(&[scale])));
            if let Some(axes) = axes {
                inside.extend(entry(b"ORIN", b'c', 3, axes));
            }
            inside.extend(entry(key, b's', 6, &shorts(values)));
            entry(b"STRM", 0, 1, &inside)
        };
        let mut device = entry(b"DVNM", b'c', 6, b"Camera");
        device.extend(stream(b"GYRO", b"rad/s", 100, gyro));
        device.extend(stream(b"ACCL", b"m/s2", 10, accel));
        entry(b"DEVC", 0, 1, &device)
    }

    #[test]
    fn values_are_scaled_and_turned_and_spread_over_their_payloads() {
        let second = 1_000_000_000;
        let bytes = payload(
            Some(b"YxZ"),
            &[100, 200, 300, 100, 200, 300, 100, 200, 300, 100, 200, 300],
            &[10, 20, 30, 30, 40, 50],
        );
        let read = read(&[(0, second, bytes.clone()), (second, second, bytes)]);
        assert_eq!((read.device.as_str(), read.units), ("Camera", ["rad/s".to_string(), "m/s2".to_string()]));
        assert!(read.axes_are_stated && read.turns.is_empty());
        assert_eq!(read.turns.channels, [1, 0, 2]);
        assert_eq!(read.imu[0].gyro.0, Vector3::new(-2.0, 1.0, 3.0));
        assert_eq!(read.imu[0].accel.0, Vector3::new(-2.0, 1.0, 3.0));
        // Half way between the accelerometer's values at 0 s and 0.5 s.
        assert_eq!(read.imu[1].time.nanos(), second / 4);
        assert_eq!(read.imu[1].accel.0, Vector3::new(-3.0, 2.0, 4.0));
        assert!((read.gyro_rate_hz - 4.0).abs() < 1e-9 && (read.accel_rate_hz - 2.0).abs() < 1e-9);
        // The last accelerometer value is at 1.5 s; nothing is invented after it.
        assert_eq!(read.imu.last().map(|s| s.time.nanos()), Some(3 * second / 2));
    }

    #[test]
    fn turns_of_camera_and_picture_are_one_a_frame() {
        let stream = |key, values: &[i16]| {
            let mut inside = entry(b"SCAL", b's', 2, &shorts(&[100]));
            inside.extend(entry(key, b's', 8, &shorts(values)));
            entry(b"STRM", 0, 1, &inside)
        };
        let mut device = stream(b"CORI", &[100, 0, 0, 0, 0, 100, 0, 0]);
        device.extend(stream(b"IORI", &[60, 0, 80, 0]));
        let read = read(&[(0, 1_000_000_000, entry(b"DEVC", 0, 1, &device))]);
        assert_eq!(read.turns.camera, [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]]);
        assert_eq!((read.turns.image, read.turns.channels), (vec![[0.6, 0.0, 0.8, 0.0]], [2, 0, 1]));
    }

    #[test]
    fn the_first_cameras_order_is_z_x_y() {
        let read =
            read(&[(0, 1_000_000_000, payload(None, &[100, 200, 300, 1, 1, 1], &[10, 20, 30, 10, 20, 30]))]);
        assert!(!read.axes_are_stated);
        assert_eq!(read.imu[0].gyro.0, Vector3::new(2.0, 3.0, 1.0));
    }

    #[test]
    fn cut_and_nested_nonsense_is_survived() {
        let whole = payload(Some(b"XYZ"), &[1; 30], &[1; 30]);
        for keep in 0..whole.len() {
            let _ = read(&[(0, 1, whole[..keep].to_vec())]);
        }
    }
}
