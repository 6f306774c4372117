//! What can be tuned from outside. Everything else is a named constant with its reason beside the code.

use crate::backend::{Linearisation, SmootherConfig};
use crate::error::OdometryError;
use serde::{Deserialize, Serialize};

/// Whether IMU measurements are used.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum ImuUse {
    /// Where the rig has an IMU.
    #[default]
    Auto,
    /// Always; without one the odometry refuses to start.
    Required,
    /// Never: the camera alone, up to scale.
    Off,
}

/// Settings of the odometry. The defaults suit a drone or a hand-held camera with a consumer or industrial IMU.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct OdometryConfig {
    /// Whether IMU measurements are used: `auto`, `required` or `off` (the camera alone, up to scale).
    pub imu: ImuUse,
    /// Landmarks followed at once, 20…400. More are more accurate and cost time in proportion.
    pub max_landmarks: usize,
    /// Keyframes kept in the window, 4…20. More hold longer and cost time with the cube.
    pub max_keyframes: usize,
    /// Iterations of the smoother per image, 1…10.
    pub iterations: usize,
    /// Image noise of a feature's position at its own pyramid level, pixels, 0.1…5. Raise it for blurred or
    /// noisy cameras.
    pub pixel_noise_px: f64,
    /// Factor on the data sheet's gyroscope noise, 1…100: vibration and scale errors are in no data sheet.
    pub gyro_noise_factor: f64,
    /// Factor on the data sheet's accelerometer noise, 1…100.
    pub accel_noise_factor: f64,
    /// Standard deviation of the gyroscope's gain per axis while images come, relative, 0…0.1. Four real rooms lose a quarter of their error
    /// by 0.005, flights with an exact gyroscope gain a tenth (docs/decisions/0027); data sheets of phones' sensors state up to
    /// 0.03. The adjustment afterwards estimates the gains.
    pub gyro_gain_std: f64,
    /// Strength of gravity, m/s², 9.5…10.
    pub gravity_mps2: f64,
    /// Whether the offset between the clocks of camera and IMU is estimated on the way.
    pub estimate_time_offset: bool,
    /// Whether a clock offset of any size, the readout and a wrong camera rotation are looked for with feature tracks and gyroscope while
    /// images come. A recording on disk is looked through before, and then not again.
    pub align_timing: bool,
    /// Rolling shutter: time from the first to the last image row, milliseconds, 0…50; 0 is a global shutter. Absent: it is
    /// estimated from feature tracks and gyroscope as soon as the camera turns.
    pub readout_ms: Option<f64>,
    /// Standard deviation of image stamps about the instants of exposure, milliseconds, 0…20: large where an image is stamped when it arrives. Absent: 0 until
    /// the images contradict that, then 5; a recording on disk is tracked once more then.
    pub stamp_scatter_ms: Option<f64>,
    /// Standard deviation of how far a stabiliser shifts each image, as the angle that the camera would have to turn by, degrees, 0…3. Absent: 0 until the images
    /// contradict that, then 0.86; a recording on disk is tracked once more then.
    pub image_shift_deg: Option<f64>,
    /// Whether the camera's place on the body is refined on the way.
    pub estimate_extrinsics: bool,
    /// Whether all states of a recording on disk are adjusted together after its end: better poses, and poses for the images
    /// before the start.
    pub adjust: bool,
    /// Fastest speed that is believed, m/s, 0.1…100.
    pub max_speed_mps: f64,
    /// After this long without landmarks or IMU measurements the state is given up, s, 0.1…10.
    pub max_blind_secs: f64,
}

impl Default for OdometryConfig {
    fn default() -> Self {
        Self {
            imu: ImuUse::Auto,
            max_landmarks: 150,
            max_keyframes: 10,
            iterations: 4,
            pixel_noise_px: 0.3,
            gyro_noise_factor: 2.0,
            accel_noise_factor: 4.0,
            gyro_gain_std: 0.005,
            gravity_mps2: vidar_core::GRAVITY_MPS2,
            estimate_time_offset: true,
            align_timing: true,
            estimate_extrinsics: false,
            readout_ms: None,
            stamp_scatter_ms: None,
            image_shift_deg: None,
            adjust: true,
            max_speed_mps: 20.0,
            max_blind_secs: 2.0,
        }
    }
}

impl OdometryConfig {
    /// The smoother's settings.
    pub(crate) fn smoother(&self) -> SmootherConfig {
        let has_imu = self.imu != ImuUse::Off;
        // Without an IMU neither inclination nor scale is observable, and only first estimates keep all seven freedoms:
        // the correction for heading alone lets the scale jump at every fast turn (rendered V1_03: 0.43 m against 0.013 m).
        let linearisation = if has_imu { Linearisation::default() } else { Linearisation::FirstEstimates };
        SmootherConfig {
            max_frames: self.max_keyframes + 8,
            estimate_time_offset: has_imu && self.estimate_time_offset,
            estimate_camera_rotation: has_imu && self.estimate_extrinsics,
            estimate_camera_position: has_imu && self.estimate_extrinsics,
            linearisation,
            stamp_scatter_ms: self.stamp_scatter_ms.filter(|_| has_imu).unwrap_or(0.0),
            image_shift_deg: self.image_shift_deg.filter(|_| has_imu).unwrap_or(0.0),
            ..SmootherConfig::default()
        }
    }

    /// Refuses values outside the ranges that the fields state, naming the key.
    pub fn validate(&self) -> Result<(), OdometryError> {
        let check = |key, found: f64, low: f64, high: f64, expected| {
            if found >= low && found <= high {
                return Ok(());
            }
            Err(OdometryError::BadConfig { key, expected, found })
        };
        check("max_landmarks", self.max_landmarks as f64, 20.0, 400.0, "20 to 400")?;
        check("max_keyframes", self.max_keyframes as f64, 4.0, 20.0, "4 to 20")?;
        check("iterations", self.iterations as f64, 1.0, 10.0, "1 to 10")?;
        check("pixel_noise_px", self.pixel_noise_px, 0.1, 5.0, "0.1 to 5 px")?;
        check("gyro_noise_factor", self.gyro_noise_factor, 1.0, 100.0, "1 to 100")?;
        check("accel_noise_factor", self.accel_noise_factor, 1.0, 100.0, "1 to 100")?;
        check("gyro_gain_std", self.gyro_gain_std, 0.0, 0.1, "0 to 0.1")?;
        check("gravity_mps2", self.gravity_mps2, 9.5, 10.0, "9.5 to 10 m/s²")?;
        check("readout_ms", self.readout_ms.unwrap_or(0.0), 0.0, 50.0, "0 to 50 ms")?;
        check("stamp_scatter_ms", self.stamp_scatter_ms.unwrap_or(0.0), 0.0, 20.0, "0 to 20 ms")?;
        check("image_shift_deg", self.image_shift_deg.unwrap_or(0.0), 0.0, 3.0, "0 to 3 degrees")?;
        check("max_speed_mps", self.max_speed_mps, 0.1, 100.0, "0.1 to 100 m/s")?;
        check("max_blind_secs", self.max_blind_secs, 0.1, 10.0, "0.1 to 10 s")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_bad_key_is_named() {
        type Corrupt = fn(&mut OdometryConfig);
        let cases: [(&str, Corrupt); 12] = [
            ("max_landmarks", |c| c.max_landmarks = 3),
            ("max_keyframes", |c| c.max_keyframes = 100),
            ("iterations", |c| c.iterations = 0),
            ("pixel_noise_px", |c| c.pixel_noise_px = f64::NAN),
            ("gyro_noise_factor", |c| c.gyro_noise_factor = 0.0),
            ("accel_noise_factor", |c| c.accel_noise_factor = -1.0),
            ("gyro_gain_std", |c| c.gyro_gain_std = 0.5),
            ("gravity_mps2", |c| c.gravity_mps2 = 1.62),
            ("stamp_scatter_ms", |c| c.stamp_scatter_ms = Some(-1.0)),
            ("image_shift_deg", |c| c.image_shift_deg = Some(4.0)),
            ("max_speed_mps", |c| c.max_speed_mps = 0.0),
            ("max_blind_secs", |c| c.max_blind_secs = f64::INFINITY),
        ];
        OdometryConfig::default().validate().unwrap();
        for (name, corrupt) in cases {
            let mut config = OdometryConfig::default();
            corrupt(&mut config);
            match config.validate() {
                Err(OdometryError::BadConfig { key, .. }) => assert_eq!(key, name),
                other => panic!("{name}: {other:?}"),
            }
        }
    }
}
