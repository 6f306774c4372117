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
