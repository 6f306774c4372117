//! What messages of ROS have no fields for, kept as texts under one name in an MCAP file's metadata: noise of the IMU, the clock of the
//! camera, models that `CameraInfo` does not know, the unit of depth, and which topics hold poses.

use crate::camera_flag::CameraFlag;
use crate::recording::{CalibrationSource, Recording};
use std::collections::BTreeMap;
use std::fmt::Display;
use std::str::FromStr;
use vidar_core::{CameraModel, Duration, ImuNoise};

/// The name of the metadata.
pub(crate) const NAME: &str = "vidar.recording";

/// The facts; what the metadata does not hold, or not in a form that is understood, is `None`.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Facts {
    pub model: Option<CameraModel>,
    pub time_offset: Option<Duration>,
    pub readout: Option<Duration>,
    pub rate_hz: Option<f64>,
    pub imu_noise: Option<ImuNoise>,
    pub depth_units_per_metre: Option<f64>,
    pub truth_topic: Option<String>,
    pub trajectory_topic: Option<String>,
}

impl Facts {
    /// Those of a dataset, without its topics.
    pub(crate) fn of(dataset: &Recording) -> Self {
        let camera = dataset.rig.camera(dataset.camera);
        let is_known = dataset.calibration != CalibrationSource::Guessed;
        Self {
            model: camera.map(|c| c.model.clone()).filter(|_| is_known),
            time_offset: camera.map(|c| c.time_offset),
            readout: dataset.readout,
            rate_hz: camera.and_then(|c| c.rate_hz),
            imu_noise: dataset.rig.imu,
            ..Self::default()
        }
    }

    pub(crate) fn to_map(&self) -> BTreeMap<String, String> {
        let mut map = BTreeMap::new();
        let mut put = |key: &str, value: Option<String>| {
            if let Some(value) = value {
                map.insert(key.to_string(), value);
            }
        };
        put("camera.model", self.model.clone().map(|m| CameraFlag(m).to_string()));
        put("camera.time_offset_ns", self.time_offset.map(|d| d.nanos().to_string()));
        put("camera.readout_ns", self.readout.map(|d| d.nanos().to_string()));
        put("camera.rate_hz", self.rate_hz.map(|v| v.to_string()));
        if let Some(noise) = &self.imu_noise {
            for (key, value) in NOISE_KEYS.iter().zip(noise_values(noise)) {
                put(key, Some(value.to_string()));
            }
        }
        put("depth.units_per_metre", self.depth_units_per_metre.map(|v| v.to_string()));
        put("poses.ground_truth", self.truth_topic.clone());
        put("poses.trajectory", self.trajectory_topic.clone());
        map
    }

    pub(crate) fn from_map(map: &BTreeMap<String, String>) -> Self {
        let duration = |key: &str| value::<i64>(map, key).map(Duration::from_nanos);
        let positive = |key: &str| value::<f64>(map, key).filter(|v| v.is_finite() && *v > 0.0);
        let noise: Option<Vec<f64>> = NOISE_KEYS
            .iter()
            .map(|key| value::<f64>(map, key).filter(|v| v.is_finite() && *v >= 0.0))
            .collect();
        let noise = noise.and_then(|n| <[f64; 5]>::try_from(n).ok());
        Self {
            model: value::<CameraFlag>(map, "camera.model").map(|flag| flag.0),
            time_offset: duration("camera.time_offset_ns"),
            readout: duration("camera.readout_ns").filter(|d| (0..=100_000_000).contains(&d.nanos())),
            rate_hz: positive("camera.rate_hz"),
            imu_noise: noise.map(|[gyro_noise, gyro_walk, accel_noise, accel_walk, rate_hz]| ImuNoise {
                gyro_noise_density: gyro_noise,
                gyro_random_walk: gyro_walk,
                accel_noise_density: accel_noise,
                accel_random_walk: accel_walk,
                rate_hz,
            }),
            depth_units_per_metre: positive("depth.units_per_metre"),
            truth_topic: map.get("poses.ground_truth").cloned(),
            trajectory_topic: map.get("poses.trajectory").cloned(),
        }
    }
}

const NOISE_KEYS: [&str; 5] = [
    "imu.gyroscope_noise_density",
    "imu.gyroscope_random_walk",
    "imu.accelerometer_noise_density",
    "imu.accelerometer_random_walk",
    "imu.rate_hz",
];

fn noise_values(noise: &ImuNoise) -> [f64; 5] {
    [
        noise.gyro_noise_density,
        noise.gyro_random_walk,
        noise.accel_noise_density,
        noise.accel_random_walk,
        noise.rate_hz,
    ]
}

fn value<T: FromStr>(map: &BTreeMap<String, String>, key: &str) -> Option<T>
where
    T::Err: Display,
{
    map.get(key)?.parse().ok()
}
