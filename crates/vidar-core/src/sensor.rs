//! Sensor measurements in time order.

use crate::geometry::MetricDepth;
use crate::id::{CameraId, FrameId};
use crate::image::FrameImage;
use crate::lie::Se3;
use crate::time::Timestamp;
use nalgebra::Vector3;

/// Angular rate as measured by the gyroscope (bias included), rad/s, in the IMU frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AngularRate(pub Vector3<f64>);

/// Specific force as measured by the accelerometer (bias and gravity reaction included), m/s², in the IMU frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SpecificForce(pub Vector3<f64>);

/// One IMU sample.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ImuSample {
    /// When it was taken, in the dataset's clock.
    pub time: Timestamp,
    /// Gyroscope measurement.
    pub gyro: AngularRate,
    /// Accelerometer measurement.
    pub accel: SpecificForce,
}

/// A measurement of one three-axis sensor: when, and its value.
pub type TimedVector = (Timestamp, Vector3<f64>);

/// Time between two accelerometer samples that is always bridged by interpolation, ns: five samples at 50 Hz …
const BRIDGE_NS: i64 = 100_000_000;
/// … and in median steps, for slower sensors.
const BRIDGE_STEPS: i64 = 3;

/// IMU samples at the gyroscope's times, the accelerometer interpolated between its own. Both lists are in order of time; nothing is
/// invented before the first, after the last, or in a gap of the accelerometer of more than 0.1 s and three median steps.
pub fn merge_imu(gyro: &[TimedVector], accel: &[TimedVector]) -> Vec<ImuSample> {
    let mut steps: Vec<i64> = accel.windows(2).map(|w| (w[1].0 - w[0].0).nanos()).collect();
    steps.sort_unstable();
    let median = steps.get(steps.len() / 2).copied().unwrap_or(0);
    let longest = BRIDGE_NS.max(median.saturating_mul(BRIDGE_STEPS));
    let mut samples = Vec::with_capacity(gyro.len());
    let mut at = 0;
    for &(time, rate) in gyro {
        while at + 1 < accel.len() && accel[at + 1].0 < time {
            at += 1;
        }
        let (Some(&before), Some(&after)) = (accel.get(at), accel.get(at + 1)) else { continue };
        let step = (after.0 - before.0).nanos();
        if time < before.0 || time > after.0 || step <= 0 {
            continue;
        }
        let share = (time - before.0).nanos() as f64 / step as f64;
        let force = match share {
            0.0 => before.1,
            1.0 => after.1,
            _ if step > longest => continue,
            _ => before.1 * (1.0 - share) + after.1 * share,
        };
        samples.push(ImuSample { time, gyro: AngularRate(rate), accel: SpecificForce(force) });
    }
    samples
}

/// One image as captured.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Its number in the sequence.
    pub id: FrameId,
    /// Middle of the exposure, where the dataset states it.
    pub time: Timestamp,
    /// Which camera took it.
    pub camera: CameraId,
    /// The pixels.
    pub image: FrameImage,
}

/// One measurement of any sensor. Streams are time-ordered; at equal times the IMU comes first.
#[derive(Clone, Debug)]
pub enum SensorEvent {
    /// An image.
    Image(Frame),
    /// An IMU sample.
    Imu(ImuSample),
    /// A depth image of a depth camera.
    Depth {
        /// When it was taken.
        time: Timestamp,
        /// The camera whose pixels it is registered to.
        camera: CameraId,
        /// z-depth in metres.
        depth: MetricDepth,
    },
    /// A reference pose, for evaluation only.
    GroundTruth {
        /// When it holds.
        time: Timestamp,
        /// Pose of the body.
        world_from_body: Se3,
    },
}

impl SensorEvent {
    /// When the event happened.
    pub fn time(&self) -> Timestamp {
        match self {
            Self::Image(frame) => frame.time,
            Self::Imu(sample) => sample.time,
            Self::Depth { time, .. } | Self::GroundTruth { time, .. } => *time,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: i64, value: f64) -> TimedVector {
        (Timestamp::from_nanos(ms * 1_000_000), Vector3::repeat(value))
    }

    #[test]
    fn the_accelerometer_is_interpolated_and_not_invented() {
        let gyro: Vec<_> = [0, 10, 15, 20, 30, 300, 500].map(|ms| at(ms, 0.5)).to_vec();
        let accel = [at(10, 1.0), at(20, 2.0), at(40, 4.0), at(500, 9.0)];
        let merged = merge_imu(&gyro, &accel);
        let found: Vec<(i64, f64)> =
            merged.iter().map(|s| (s.time.nanos() / 1_000_000, s.accel.0.x)).collect();
        // Nothing before the first and nothing at 300 ms, in a gap of 460 ms; a sample at its very end is one.
        assert_eq!(found, [(10, 1.0), (15, 1.5), (20, 2.0), (30, 3.0), (500, 9.0)]);
        assert!(merge_imu(&gyro, &accel[..1]).is_empty());
    }
}
