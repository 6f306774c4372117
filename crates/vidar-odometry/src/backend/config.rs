//! What can be set about the smoother.

use serde::{Deserialize, Serialize};

/// Where derivatives are taken, which decides how much spurious information about the heading the smoother gains.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Linearisation {
    /// Everything at the present states; the prior is corrected by the smallest change that keeps heading as free as it
    /// was (observability constraint: Hesch, Kottas, Bowman, Roumeliotis, "Camera-IMU-based localization", IJRR 2014).
    #[default]
    ObservabilityConstrained,
    /// States in the prior keep the point of their first use (Huang, Mourikis, Roumeliotis, IJRR 2010). As consistent
    /// later, but the rough states of the first seconds stay in every derivative.
    FirstEstimates,
    /// Everything at the present states: heading seems better known than it is.
    Present,
}

/// Settings of the fixed-lag smoother.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SmootherConfig {
    /// Most frames held at once, keyframes and recent ones, 4…40. Time grows with its square to cube.
    pub max_frames: usize,
    /// Residual (in standard deviations) from which an observation pulls only linearly, 0.5…10.
    pub huber_sigmas: f64,
    /// Squared whitened residual (2 degrees of freedom) beyond which an observation is reported as an outlier, 4…100.
    /// 9.2 is 99 %.
    pub outlier_chi2: f64,
    /// Keyframes whose observations a landmark keeps when its host leaves and it lives on with a newer host, 1…20.
    /// What is older goes into the prior.
    pub rehost_keyframes: usize,
    /// How shift and heading stay unobservable. Other values than the default are for comparison.
    pub linearisation: Linearisation,
    /// Whether the rotation of the camera on the body is estimated, starting from the given one.
    pub estimate_camera_rotation: bool,
    /// Whether the position of the camera on the body is estimated. Needs rotation about two axes.
    pub estimate_camera_position: bool,
    /// Whether the offset between camera and IMU clocks is estimated. Seen as soon as the body's turning changes.
    pub estimate_time_offset: bool,
    /// Standard deviation of the given camera rotation, degrees, 0.01…10.
    pub camera_rotation_sigma_deg: f64,
    /// Standard deviation of the given camera position, metres, 0.0001…0.5.
    pub camera_position_sigma_m: f64,
    /// Standard deviation of the given clock offset, milliseconds, 0.01…100.
    pub time_offset_sigma_ms: f64,
    /// Standard deviation of each image's stamp about the instant of its exposure, milliseconds, 0…20; 0: stamps are right up to the clock offset. Needs
    /// `estimate_time_offset`, which is their mean.
    pub stamp_scatter_ms: f64,
    /// Standard deviation of how far a stabiliser shifts each image, as the angle by which the camera would have to turn, degrees, 0…3; 0: images are not shifted.
    pub image_shift_deg: f64,
}

impl Default for SmootherConfig {
    fn default() -> Self {
        Self {
            max_frames: 16,
            huber_sigmas: 1.345,
            outlier_chi2: 9.2,
            rehost_keyframes: 3,
            linearisation: Linearisation::default(),
            estimate_camera_rotation: false,
            estimate_camera_position: false,
            estimate_time_offset: false,
            camera_rotation_sigma_deg: 1.0,
            camera_position_sigma_m: 0.01,
            time_offset_sigma_ms: 5.0,
            stamp_scatter_ms: 0.0,
            image_shift_deg: 0.0,
        }
    }
}

impl SmootherConfig {
    /// Checks every key against its range; the first that is outside is reported with its range.
    ///
    /// # Errors
    /// The key, its range and what was found.
    pub fn validate(&self) -> Result<(), super::SmootherError> {
        let ranges = [
            ("max_frames", self.max_frames as f64, 4.0, 40.0),
            ("huber_sigmas", self.huber_sigmas, 0.5, 10.0),
            ("outlier_chi2", self.outlier_chi2, 4.0, 100.0),
            ("rehost_keyframes", self.rehost_keyframes as f64, 1.0, 20.0),
            ("camera_rotation_sigma_deg", self.camera_rotation_sigma_deg, 0.01, 10.0),
            ("camera_position_sigma_m", self.camera_position_sigma_m, 1e-4, 0.5),
            ("time_offset_sigma_ms", self.time_offset_sigma_ms, 0.01, 100.0),
            ("stamp_scatter_ms", self.stamp_scatter_ms, 0.0, 20.0),
            ("image_shift_deg", self.image_shift_deg, 0.0, 3.0),
        ];
        for (key, found, low, high) in ranges {
            if !(low..=high).contains(&found) {
                return Err(super::SmootherError::BadSetting { key, low, high, found });
            }
        }
        Ok(())
    }

    pub(crate) fn first_estimates(&self) -> bool {
        self.linearisation == Linearisation::FirstEstimates
    }

    pub(crate) fn calibrates(&self) -> bool {
        self.calibrates_camera() || self.estimate_time_offset
    }

    /// Standard deviation of an image's delay, s, where every image has one of its own.
    pub(crate) fn delay_sigma(&self) -> Option<f64> {
        (self.stamp_scatter_ms > 0.0).then_some(self.stamp_scatter_ms * 1e-3)
    }

    pub(crate) fn image_shift_sigma(&self) -> Option<f64> {
        (self.image_shift_deg > 0.0).then_some(self.image_shift_deg.to_radians())
    }

    pub(crate) fn calibrates_camera(&self) -> bool {
        self.estimate_camera_rotation || self.estimate_camera_position
    }
}
