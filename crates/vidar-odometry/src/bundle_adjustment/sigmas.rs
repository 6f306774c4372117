//! How far a calibration may be from what was given.

use super::image_prior::ImagePrior;
use super::observation::SensorCalibration;

/// Standard deviation of a lever arm that nothing is known of, m: a phone's camera is as far from its IMU.
pub const UNKNOWN_LEVER_M: f64 = 0.05;
/// Standard deviation of a camera's rotation on the body that a recording's own tracks and gyroscope show, rad.
const FOUND_ROTATION_RAD: f64 = 0.02;

/// What may change of the camera: standard deviations of the given values, zero where they are held.
#[derive(Clone, Debug, PartialEq)]
pub struct CalibrationSigmas {
    /// Clock offset, s.
    pub time_offset_secs: f64,
    /// Readout, s.
    pub readout_secs: f64,
    /// Rotation of the camera on the body, rad per axis.
    pub rotation_rad: f64,
    /// Position of the camera on the body, m per axis.
    pub position_m: f64,
    /// Focal lengths, relative.
    pub focal: f64,
    /// Principal point, px.
    pub principal_point_px: f64,
    /// Distortion parameters, in their own units.
    pub distortion: f64,
    /// Gain of the gyroscope, relative, per axis.
    pub gyro_gain: f64,
    /// Gain of the accelerometer, relative, per axis.
    pub accel_gain: f64,
    /// What images are known to have of their own. Of the rest the adjustment asks the recording, once all states fit as if there were none: an error that large leads clock,
    /// readout and lever arm away from where they were, and what follows begins there.
    pub images: ImagePrior,
}

impl Default for CalibrationSigmas {
    /// A calibrated camera whose clock and readout are not known: what alignment with the gyroscope leaves open of them after
    /// a few seconds (rendered phones: 7 ms and 24 ms at worst), half a degree of its rotation and the 5 mm that a calibration with a
    /// target leaves of its place (what is worse is told as a finding, and its prior widened). Gains as data sheets of consumer
    /// parts state them.
    fn default() -> Self {
        Self {
            time_offset_secs: 1e-2,
            readout_secs: 2e-2,
            rotation_rad: 5e-3,
            position_m: 0.005,
            focal: 0.0,
            principal_point_px: 0.0,
            distortion: 0.0,
            gyro_gain: 0.01,
            accel_gain: 0.005,
            images: ImagePrior::default(),
        }
    }
}

impl CalibrationSigmas {
    /// With a place of the camera on the body that nobody measured: its rotation was found from the recording, its position is not known.
    #[must_use]
    pub fn with_found_mount(self) -> Self {
        Self { rotation_rad: FOUND_ROTATION_RAD, position_m: UNKNOWN_LEVER_M, ..self }
    }

    pub(super) fn of(&self, calibration: &SensorCalibration) -> Vec<f64> {
        let mut sigmas = vec![self.time_offset_secs, self.readout_secs];
        sigmas.extend([self.rotation_rad; 3]);
        sigmas.extend([self.position_m; 3]);
        let parameters = calibration.camera.parameters();
        for (index, value) in parameters.iter().enumerate() {
            sigmas.push(match index {
                0 | 1 => self.focal * value,
                2 | 3 => self.principal_point_px,
                _ => self.distortion,
            });
        }
        sigmas.extend([[self.gyro_gain; 3], [self.accel_gain; 3]].concat());
        debug_assert_eq!(sigmas.len(), calibration.dim());
        sigmas
    }
}
