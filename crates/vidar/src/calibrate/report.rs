//! What was found, in words and as JSON.

use super::yaml::{disagreement, told};
use super::{CONTRADICTING_SIGMAS, CalibrateOutcome, Stated};
use nalgebra::Vector3;
use serde_json::{Value, json};
use vidar_core::{CameraModel, LieGroup};
use vidar_odometry::bundle_adjustment::UNKNOWN_LEVER_M;
use vidar_odometry::calibration::{Calibration, Estimate};

/// One sentence for a warning.
pub(super) fn sentence(found: &Calibration, has_lens: bool) -> String {
    let missing =
        if has_lens { "nothing says how the camera is mounted on the IMU" } else { "no calibration" };
    format!("{missing}; found from the recording: {}", values(found))
}

/// The values with their standard deviations.
pub(super) fn values(found: &Calibration) -> String {
    let sigma = found.rotation_sigma().to_degrees();
    let rotation = match found.rotation_is_observable {
        true if found.mount_is_assumed => {
            format!("rotation against the IMU within {sigma:.1}° (σ) of what is usual for such cameras")
        }
        true => format!("rotation against the IMU within {sigma:.1}° (σ)"),
        false => "rotation against the IMU not observable in this recording".to_owned(),
    };
    format!(
        "{}{}, {}, {}, {rotation}, lever arm 0 ± {UNKNOWN_LEVER_M} m{}",
        told("focal length", &found.focal_px, 1.0, "px", 1),
        if found.off_given_lens.is_some() { " (held near the given one)" } else { "" },
        told("time offset", &found.time_offset_secs, 1e3, "ms", 1),
        told("readout", &found.readout_secs, 1e3, "ms", 1),
        disagreement(found).map(|words| format!("; {words}")).unwrap_or_default(),
    )
}

/// Pixels per radian in the middle of the image: the focal length of any model.
fn central_focal(model: &CameraModel) -> Option<f64> {
    const ANGLE: f64 = 1e-3;
    let [left, right] = [-ANGLE, ANGLE].map(|x| model.project(&Vector3::new(x, 0.0, 1.0)));
    Some((right? - left?).norm() / (2.0 * ANGLE))
}

/// A found value beside a given one.
struct Comparison {
    what: &'static str,
    given: f64,
    found: f64,
    sigma: f64,
    unit: &'static str,
}

impl Comparison {
    fn sigmas(&self) -> f64 {
        (self.found - self.given).abs() / self.sigma
    }

    fn contradicts(&self) -> bool {
        self.sigmas() > CONTRADICTING_SIGMAS
    }
}

impl CalibrateOutcome {
    /// Label and value of everything found.
    pub fn summary_lines(&self) -> Vec<(&'static str, String)> {
        let c = &self.calibration;
        let value = |e: &Estimate, scale: f64, unit: &str, digits: usize| {
            let text = told("", e, scale, unit, digits);
            text.trim_start_matches(": ").to_owned()
        };
        let mut lines = vec![
            ("focal length", value(&c.focal_px, 1.0, "px", 1)),
            ("principal point x", value(&c.centre_px[0], 1.0, "px", 1)),
            ("principal point y", value(&c.centre_px[1], 1.0, "px", 1)),
            ("lens", c.lens.kalibr_name().to_owned()),
            ("distortion k1", value(&c.radial[0], 1.0, "", 3)),
            ("distortion k2", value(&c.radial[1], 1.0, "", 3)),
            ("time offset", value(&c.time_offset_secs, 1e3, "ms", 2)),
            ("readout", value(&c.readout_secs, 1e3, "ms", 1)),
            ("rotation", self.rotation_words()),
            ("lever arm", format!("not observable by rotation (0 ± {UNKNOWN_LEVER_M} m is assumed)")),
        ];
        for (axis, bias) in ["gyro bias x", "gyro bias y", "gyro bias z"].into_iter().zip(&c.gyro_bias) {
            lines.push((axis, value(bias, 1e3, "mrad/s", 2)));
        }
        lines.extend(self.noise_lines());
        lines.extend(disagreement(c).map(|words| ("doubt", words)));
        for compared in self.comparisons() {
            let verdict = if compared.contradicts() { "contradicts" } else { "agrees" };
            lines.push((
                compared.what,
                format!(
                    "given {:.2} {unit}, found {:.2} {unit}: {:.1} σ, {verdict}",
                    compared.given,
                    compared.found,
                    compared.sigmas(),
                    unit = compared.unit
                ),
            ));
        }
        let used = format!("{} images, {} stretches, {:.2} px", c.images, c.stretches, c.pixel_sigma);
        lines.push(("used", used));
        lines.extend(self.file.as_ref().map(|f| ("file", f.display().to_string())));
        lines
    }

    /// Whether a given calibration differs from what was found by more than three standard deviations.
    pub fn contradicts(&self) -> bool {
        self.comparisons().iter().any(Comparison::contradicts)
    }

    fn rotation_words(&self) -> String {
        let c = &self.calibration;
        let camera = ["right", "down", "ahead"];
        let matrix = c.body_from_camera.matrix();
        let axes: Vec<String> = (0..3)
            .map(|k| {
                let column = matrix.column(k);
                let body = column.iamax();
                let sign = if column[body] < 0.0 { '-' } else { '+' };
                format!("{} {sign}{}", camera[k], ['x', 'y', 'z'][body])
            })
            .collect();
        let sigmas = c.rotation_sigmas.map(f64::to_degrees);
        let seen = match (c.rotation_is_observable, c.mount_is_assumed) {
            (_, true) => "; as such cameras are mounted, within 3°: the recording does not show it",
            (true, false) => "",
            (false, false) => "; not observable in this recording",
        };
        format!(
            "camera {} of the IMU, nearly; ± {:.2}, {:.2}, {:.2}° about the camera's axes{seen}",
            axes.join(", "),
            sigmas[0],
            sigmas[1],
            sigmas[2]
        )
    }

    fn noise_lines(&self) -> Vec<(&'static str, String)> {
        let Some(seen) = &self.noise else { return Vec::new() };
        let words = |given: Option<f64>, seen: f64, unit: &str| match given {
            Some(given) => format!("the file says {given:.2e}, the data says {seen:.2e} {unit}"),
            None => format!("the data says {seen:.2e} {unit}"),
        };
        let given = self.stated_noise;
        let mut lines = vec![(
            "gyroscope noise",
            words(given.map(|n| n.gyro_noise_density), seen.gyro, "rad/s/sqrt(Hz)"),
        )];
        if seen.accel > 0.0 {
            let given = given.map(|n| n.accel_noise_density);
            lines.push(("accelerometer noise", words(given, seen.accel, "m/s2/sqrt(Hz)")));
        }
        lines
    }

    fn comparisons(&self) -> Vec<Comparison> {
        let c = &self.calibration;
        let Some(Stated { model, body_from_camera, time_offset }) = &self.stated else { return Vec::new() };
        let mut all = Vec::new();
        if let Some(given) = central_focal(model).filter(|_| c.focal_px.is_observable) {
            let (found, sigma) = (c.focal_px.value, c.focal_px.sigma);
            all.push(Comparison { what: "check focal length", given, found, sigma, unit: "px" });
        }
        if c.time_offset_secs.is_observable {
            all.push(Comparison {
                what: "check time offset",
                given: 1e3 * time_offset.as_secs_f64(),
                found: 1e3 * c.time_offset_secs.value,
                sigma: 1e3 * c.time_offset_secs.sigma,
                unit: "ms",
            });
        }
        if c.rotation_is_observable {
            let turn = (body_from_camera.rotation.inverse() * c.body_from_camera).log();
            // The axis that is off by most standard deviations.
            let sigmas = (0..3).map(|a| turn[a].abs() / c.rotation_sigmas[a]).fold(0.0, f64::max);
            let angle = turn.norm().to_degrees();
            all.push(Comparison {
                what: "check rotation",
                given: 0.0,
                found: angle,
                sigma: angle / sigmas.max(1e-9),
                unit: "degrees of difference",
            });
        }
        all
    }

    /// Everything as JSON.
    pub fn to_json(&self) -> Value {
        let c = &self.calibration;
        let number =
            |e: &Estimate| json!({ "value": e.value, "sigma": e.sigma, "observable": e.is_observable });
        let matrix = c.body_from_camera.matrix();
        let rows: Vec<Vec<f64>> = (0..3).map(|r| matrix.row(r).iter().copied().collect()).collect();
        let checks: Vec<Value> = self
            .comparisons()
            .iter()
            .map(|k| {
                json!({
                    "what": k.what, "given": k.given, "found": k.found, "sigma": k.sigma, "unit": k.unit,
                    "contradicts": k.contradicts(),
                })
            })
            .collect();
        json!({
            "name": self.name,
            "resolution": [self.size.0, self.size.1],
            "focal_px": number(&c.focal_px),
            "centre_px": c.centre_px.iter().map(number).collect::<Vec<_>>(),
            "lens": c.lens.kalibr_name(),
            "radial": c.radial.iter().map(number).collect::<Vec<_>>(),
            "time_offset_secs": number(&c.time_offset_secs),
            "readout_secs": number(&c.readout_secs),
            "body_from_camera": rows,
            "rotation_sigmas_rad": c.rotation_sigmas,
            "rotation_observable": c.rotation_is_observable,
            "mount_assumed": c.mount_is_assumed,
            "gyro_bias": c.gyro_bias.iter().map(number).collect::<Vec<_>>(),
            "gyro_noise": self.noise.map(|n| n.gyro),
            "accel_noise": self.noise.map(|n| n.accel),
            "stated_gyro_noise": self.stated_noise.map(|n| n.gyro_noise_density),
            "stated_accel_noise": self.stated_noise.map(|n| n.accel_noise_density),
            "pixel_sigma": c.pixel_sigma,
            "gyro_noise_ratio": c.gyro_noise_ratio,
            "image_shift_deg": c.image_shift_rad.map(f64::to_degrees),
            "images": c.images,
            "checks": checks,
            "file": self.file.as_ref().map(|f| f.display().to_string()),
        })
    }
}
