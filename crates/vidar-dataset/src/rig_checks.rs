//! Plausibility checks of a calibration. Values that no real rig has are reported when the calibration is read.
//!
//! Nothing here stops a run. The limits are wide: they catch another unit, a swapped or inverted entry, a forgotten one,
//! not an unusual rig. Errors that show only with motion (an inverted camera orientation) are checked by the odometry in its first seconds.

use std::path::Path;
use vidar_core::{CameraModel, Duration, ImuNoise, ImuSample, LieGroup, Rig, RigCamera, Warning};

/// Largest plausible distance of camera and IMU, m.
const MAX_LEVER_M: f64 = 1.0;
/// Largest plausible time offset of camera and IMU, s.
const MAX_OFFSET_SECS: f64 = 0.1;
/// Focal length over the longer side of the image: 8° to 136° across without distortion.
const FOCAL_RATIO: std::ops::RangeInclusive<f64> = 0.2..=7.0;
/// Pixels are square within this factor.
const MAX_PIXEL_ASPECT: f64 = 1.25;
/// Largest plausible distance of the principal point from the image centre, as a share of the image's side.
const MAX_CENTRE_SHIFT: f64 = 0.25;
/// Largest error of unprojecting and projecting a border pixel, pixels.
const MAX_RETURN_PX: f64 = 0.5;
/// White noise of IMUs from tactical grade to phones, with a margin of ten, rad/s/√Hz and m/s²/√Hz.
const GYRO_NOISE: std::ops::RangeInclusive<f64> = 1e-6..=2e-2;
const ACCEL_NOISE: std::ops::RangeInclusive<f64> = 1e-5..=0.5;
/// Largest factor between the stated rate and that of the samples.
const MAX_RATE_FACTOR: f64 = 1.25;
/// Baselines of two cameras on one body, m.
const BASELINE_M: std::ops::RangeInclusive<f64> = 1e-3..=3.0;

/// Reports implausible values of the rig. `chosen` is the camera in use; `imu` are the samples.
pub(crate) fn check_rig(rig: &Rig, chosen: usize, imu: &[ImuSample], place: &Path, notes: &mut Vec<Warning>) {
    let mut report = |kind: &str, message: String, hint: &str| {
        notes.push(Warning::new(kind, message).at(place.display()).hint(hint));
    };
    if let Some(camera) = rig.cameras.get(chosen) {
        check_model(&camera.model, &mut report);
        if !imu.is_empty() {
            check_place(camera, &mut report);
        }
        for (number, other) in rig.cameras.iter().enumerate().filter(|(k, _)| *k != chosen) {
            let baseline = (camera.body_from_camera.inverse() * other.body_from_camera).translation.norm();
            let known = |c: &RigCamera| !c.has_no_mount();
            if (known(camera) || known(other)) && !BASELINE_M.contains(&baseline) {
                let message =
                    format!("cameras {chosen} and {number} are {baseline:.4} m apart, not 1 mm to 3 m");
                report("calibration-baseline", message, "camera positions are in metres, in the body frame");
            }
        }
    }
    if let Some(noise) = &rig.imu
        && !imu.is_empty()
    {
        check_noise(noise, imu, &mut report);
    }
}

fn check_model(model: &CameraModel, report: &mut impl FnMut(&str, String, &str)) {
    let k = model.intrinsics();
    let (w, h) = (k.width as f64, k.height as f64);
    let ratio = k.fx / w.max(h);
    if !FOCAL_RATIO.contains(&ratio) {
        let message = format!("focal length {:.1} px is {ratio:.2} of the image's {} px", k.fx, w.max(h));
        report("calibration-focal", message, "are the intrinsics for this image size?");
    }
    let aspect = (k.fx / k.fy).max(k.fy / k.fx);
    if aspect > MAX_PIXEL_ASPECT {
        let message = format!("fx {:.1} and fy {:.1} px differ by a factor of {aspect:.2}", k.fx, k.fy);
        report("calibration-focal", message, "the order is fx, fy, cx, cy");
    }
    let shift = [(k.cx + 0.5 - w / 2.0) / w, (k.cy + 0.5 - h / 2.0) / h];
    if shift.iter().any(|s| s.abs() > MAX_CENTRE_SHIFT) {
        let message = format!("principal point {:.1}, {:.1} of a {w} x {h} image", k.cx, k.cy);
        report(
            "calibration-centre",
            message,
            "are the intrinsics for this image size? The order is fx, fy, cx, cy",
        );
    }
    let (right, low) = (w - 1.0, h - 1.0);
    let border =
        [(0.0, 0.0), (0.5, 0.0), (1.0, 0.0), (0.0, 0.5), (1.0, 0.5), (0.0, 1.0), (0.5, 1.0), (1.0, 1.0)];
    let returns = |&(x, y): &(f64, f64)| {
        let pixel = nalgebra::Vector2::new(x * right, y * low);
        let back = model.unproject(&pixel).and_then(|ray| model.project(&ray));
        back.is_some_and(|b| (b - pixel).norm() < MAX_RETURN_PX)
    };
    let failing = border.iter().filter(|p| !returns(p)).count();
    if failing > 0 {
        let message = format!(
            "the distortion cannot be inverted at {failing} of 8 points of the image border (it folds over)"
        );
        report(
            "calibration-distortion",
            message,
            "the order is k1, k2, p1, p2 (radtan), k1 … k4 (equidistant)",
        );
    }
}

fn check_place(camera: &RigCamera, report: &mut impl FnMut(&str, String, &str)) {
    let lever = camera.body_from_camera.translation.norm();
    if camera.has_no_mount() {
        report(
            "extrinsics-identity",
            "the camera's pose is that of the IMU: same position, same axes".into(),
            "this is not plausible; give T_BS (EuRoC), T_cam_imu (Kalibr) or T_imu_cam (OpenVINS)",
        );
    } else if lever > MAX_LEVER_M {
        let message = format!("camera and IMU are {lever:.2} m apart");
        report("calibration-lever", message, "positions are in metres");
    }
    if camera.time_offset > Duration::from_secs_f64(MAX_OFFSET_SECS)
        || camera.time_offset < Duration::from_secs_f64(-MAX_OFFSET_SECS)
    {
        let message =
            format!("the time offset of camera and IMU is {:.4} s", camera.time_offset.as_secs_f64());
        report("calibration-clock", message, "timeshift_cam_imu is in seconds, t_imu = t_camera + shift");
    }
}

fn check_noise(noise: &ImuNoise, imu: &[ImuSample], report: &mut impl FnMut(&str, String, &str)) {
    let density =
        "noise densities are expected: not per sample (sqrt(rate) times as much), not in degrees, not in g";
    let given = [
        ("gyroscope", noise.gyro_noise_density, GYRO_NOISE, "rad/s/sqrt(Hz)"),
        ("accelerometer", noise.accel_noise_density, ACCEL_NOISE, "m/s2/sqrt(Hz)"),
    ];
    for (sensor, value, range, unit) in given.into_iter().filter(|g| !g.2.contains(&g.1)) {
        let (low, high) = (range.start(), range.end());
        let message = format!("{sensor} noise {value:.2e} {unit} is not within {low:e} to {high:e}");
        report("imu-noise-range", message, density);
    }
    let walks = [
        ("gyroscope", noise.gyro_random_walk, noise.gyro_noise_density),
        ("accelerometer", noise.accel_random_walk, noise.accel_noise_density),
    ];
    for (sensor, walk, white) in walks {
        if walk == 0.0 {
            let message = format!("the random walk of the {sensor}'s bias is 0: the bias never changes");
            report("imu-noise-range", message, "a hundredth of the white noise is usual for a gyroscope");
        } else if walk > 100.0 * white {
            let message = format!(
                "the random walk of the {sensor}'s bias is {walk:.1e}, {:.0} times its white noise",
                walk / white
            );
            report("imu-noise-range", message, "with such a bias the scale is hardly observable");
        }
    }
    let mut steps: Vec<i64> = imu.windows(2).map(|w| (w[1].time - w[0].time).nanos()).collect();
    steps.sort_unstable();
    let Some(&step) = steps.get(steps.len() / 2).filter(|s| **s > 0) else { return };
    let rate = 1e9 / step as f64;
    if (noise.rate_hz / rate).max(rate / noise.rate_hz) > MAX_RATE_FACTOR {
        let message = format!(
            "the calibration states an IMU rate of {} Hz; the samples have {rate:.1} Hz",
            noise.rate_hz
        );
        report("imu-rate", message, "the rate of the samples is used");
    }
}
