//! The calibration as a file of Kalibr's kind, camera and IMU in one, that `--calibration` reads.

use super::{CalibrateOutcome, used_readout_ms};
use crate::imu_noise::believed_noise;
use std::fmt::Write;
use vidar_core::LieGroup;
use vidar_odometry::bundle_adjustment::UNKNOWN_LEVER_M;
use vidar_odometry::calibration::{Calibration, Estimate};

impl CalibrateOutcome {
    /// The file's text.
    pub fn to_yaml(&self) -> String {
        let c = &self.calibration;
        let (width, height) = self.size;
        let rows = c.body_from_camera.inverse().matrix();
        let noise = believed_noise(self.noise);
        let [cx, cy] = c.centre_px;
        let [k1, k2] = c.radial;
        let mut out = String::new();
        let mut line = |text: String| {
            // Writing to a String does not fail.
            let _ = writeln!(out, "{text}");
        };
        line(format!("# Found by `vidar calibrate` from {}: {} images.", self.name, c.images));
        if let Some(words) = disagreement(c) {
            line(format!("# Doubt: {words}."));
        }
        line("cam0:".into());
        line("  camera_model: pinhole".into());
        line(format!("  # {}", told("focal length", &c.focal_px, 1.0, "px", 1)));
        line(format!("  # {}", told("cx", &cx, 1.0, "px", 1)));
        line(format!("  # {}", told("cy", &cy, 1.0, "px", 1)));
        line(format!(
            "  intrinsics: [{:.4}, {:.4}, {:.4}, {:.4}]",
            c.focal_px.value, c.focal_px.value, cx.value, cy.value
        ));
        line(format!("  distortion_model: {}", c.lens.kalibr_name()));
        line(format!("  # {}", told("k1", &k1, 1.0, "", 4)));
        line(format!("  # {}", told("k2", &k2, 1.0, "", 4)));
        line(format!("  distortion_coeffs: [{:.6}, {:.6}, 0.0, 0.0]", k1.value, k2.value));
        line(format!("  resolution: [{width}, {height}]"));
        let sigma = c.rotation_sigma().to_degrees();
        let seen = if c.rotation_is_observable { "" } else { ", not observable in this recording" };
        line(format!(
            "  # rotation: sigma {sigma:.2} degrees{seen}; lever arm: not observable, sigma {UNKNOWN_LEVER_M} m"
        ));
        line("  T_cam_imu:".into());
        for row in 0..3 {
            let [a, b, d] = [rows[(row, 0)], rows[(row, 1)], rows[(row, 2)]];
            line(format!("  - [{a:.9}, {b:.9}, {d:.9}, 0.0]"));
        }
        line("  - [0.0, 0.0, 0.0, 1.0]".into());
        line(format!("  # {}", told("time offset", &c.time_offset_secs, 1e3, "ms", 2)));
        line(format!("  timeshift_cam_imu: {:.6}", c.time_offset_secs.value));
        line(format!("  # {}", told("readout", &c.readout_secs, 1e3, "ms", 2)));
        line(format!("  readout_secs: {:.6}", 1e-3 * used_readout_ms(c)));
        line("imu0:".into());
        line(
            "  # Noise as the data show it; bias walks as consumer sensors have them, not observable.".into(),
        );
        line(format!("  gyroscope_noise_density: {:.3e}", noise.gyro_noise_density));
        line(format!("  gyroscope_random_walk: {:.3e}", noise.gyro_random_walk));
        line(format!("  accelerometer_noise_density: {:.3e}", noise.accel_noise_density));
        line(format!("  accelerometer_random_walk: {:.3e}", noise.accel_random_walk));
        line(format!("  update_rate: {:.1}", noise.rate_hz));
        out
    }
}

/// That images turn otherwise than the gyroscope says, where they do. What does it is not told apart here: stamps that scatter by 3 ms looked like a stabiliser.
pub(super) fn disagreement(found: &Calibration) -> Option<String> {
    let times = found.gyro_noise_ratio;
    let by = match found.image_shift_rad {
        Some(shift) => format!("by {:.1}° in the root mean square", shift.to_degrees()),
        None if times > 1.0 => format!("{times:.1} times its noise; each σ is as much larger"),
        None => return None,
    };
    Some(format!(
        "images turn otherwise than the gyroscope says ({by}), as where they are stabilised or stamps scatter"
    ))
}

/// `what value ± sigma unit`, or that the recording does not show it.
pub(super) fn told(what: &str, estimate: &Estimate, scale: f64, unit: &str, digits: usize) -> String {
    let (value, sigma) = (scale * estimate.value, scale * estimate.sigma);
    let space = if unit.is_empty() { "" } else { " " };
    match estimate.is_observable {
        true => format!("{what}: {value:.digits$} ± {sigma:.digits$}{space}{unit}"),
        false => {
            format!("{what}: not observable in this recording ({value:.digits$}{space}{unit} is assumed)")
        }
    }
}
