//! The adjustment of a recording after its end, as `vidar odometry` and `vidar run` use it: what may change, and what it found.

use crate::calibrate;
use crate::config::Config;
use nalgebra::Vector3;
use serde_json::{Value, json};
use vidar_core::{BodyFrame, Duration, StampedPose, Trajectory, Warning};
use vidar_dataset::{CalibrationSource, Recording};
use vidar_odometry::bundle_adjustment::{
    Adjusted, AdjustedCalibration, AdjustedImu, AdjustmentFinding, CalibrationSigmas, Focus,
};

/// Standard deviations of a calibration that was found from the recording's own tracks and gyroscope.
const FOUND_FOCAL: f64 = 0.02;
const FOUND_DISTORTION: f64 = 0.02;
/// Of the principal point, relative to the image's width: twice the error that was left on 29 rendered recordings
/// (`bench/self_calibration.py`). Held, it turns the camera by up to half a degree, which the stated deviation does not know of.
const FOUND_PRINCIPAL_POINT: f64 = 0.004;

/// What the adjustment may change of the camera; `None` where nothing is to be adjusted. `dataset` and `config` are as the user
/// gave them: what was given is held.
pub(crate) fn adjustable(dataset: &Recording, config: &Config) -> Option<CalibrationSigmas> {
    let settings = &config.odometry;
    let by_default = CalibrationSigmas::default();
    let clock = if settings.estimate_time_offset { by_default.time_offset_secs } else { 0.0 };
    let readout = if settings.readout_ms.is_none() { by_default.readout_secs } else { 0.0 };
    let given = CalibrationSigmas { time_offset_secs: clock, readout_secs: readout, ..by_default };
    let has_no_mount = calibrate::has_no_mount(dataset);
    let mounted = given.clone().with_found_mount();
    let sigmas = if dataset.calibration == CalibrationSource::Guessed
        || has_no_mount && calibrate::is_plain(dataset)
    {
        CalibrationSigmas {
            focal: FOUND_FOCAL,
            principal_point_px: FOUND_PRINCIPAL_POINT * image_width(dataset),
            distortion: FOUND_DISTORTION,
            ..mounted
        }
    } else if has_no_mount {
        mounted
    } else {
        given
    };
    settings.adjust.then_some(sigmas)
}

fn image_width(dataset: &Recording) -> f64 {
    dataset.rig.camera(dataset.camera).map_or(0.0, |camera| camera.model.intrinsics().width as f64)
}

/// Puts the adjusted calibration into the recording's rig.
pub(crate) fn apply(adjusted: &Adjusted, dataset: &mut Recording) {
    let Some(camera) = dataset.rig.cameras.get_mut(dataset.camera.index()) else { return };
    camera.model = adjusted.calibration.camera.clone();
    camera.body_from_camera = adjusted.calibration.body_from_camera;
    camera.time_offset = Duration::from_secs_f64(adjusted.calibration.time_offset_secs);
}

/// Standard deviations by which a readout must differ from zero before depth and map are corrected for it.
const SHOWN_SIGMAS: f64 = 3.0;

/// The readout that a recording shows, s: zero (a global shutter) where the estimate does not differ from it, so that images of a global
/// shutter stay as they are.
pub(crate) fn shown_readout_secs(calibration: &AdjustedCalibration) -> f64 {
    let std = calibration.sigmas.get(1).copied().unwrap_or(0.0);
    if calibration.readout_secs > SHOWN_SIGMAS * std { calibration.readout_secs } else { 0.0 }
}

/// The calibration as adjusted, with standard deviations; zero where it was held.
pub(super) fn calibration_json(adjusted: &Adjusted) -> Value {
    let AdjustedCalibration { camera, body_from_camera, time_offset_secs, readout_secs, sigmas } =
        &adjusted.calibration;
    json!({
        "model": camera.name(),
        "intrinsics": camera.parameters(), "intrinsics_std": &sigmas[8..],
        "time_offset_ms": 1e3 * time_offset_secs, "time_offset_std_ms": 1e3 * sigmas[0],
        "readout_ms": 1e3 * readout_secs, "readout_std_ms": 1e3 * sigmas[1],
        "body_from_camera_xyzw": body_from_camera.rotation.quaternion_xyzw(), "rotation_std_rad": &sigmas[2..5],
        "body_from_camera_m": body_from_camera.translation.as_slice(), "position_std_m": &sigmas[5..8],
    })
}

/// The IMU as adjusted.
pub(super) fn imu_json(adjusted: &Adjusted) -> Value {
    let AdjustedImu { gyro_gain, accel_gain, gyro_gain_sigma, accel_gain_sigma, .. } = &adjusted.imu;
    json!({
        "gyro_gain": gyro_gain.as_slice(), "gyro_gain_std": gyro_gain_sigma.as_slice(),
        "accel_gain": accel_gain.as_slice(), "accel_gain_std": accel_gain_sigma.as_slice(),
        "gyro_noise_density": adjusted.imu.gyro_noise_density,
        "accel_noise_density": adjusted.imu.accel_noise_density,
    })
}

/// What was given and the recording contradicts: the values that were found are used. Of a recording that calibrated itself nothing was given.
pub(super) fn warnings(adjusted: &Adjusted, is_self_calibrated: bool) -> Vec<Warning> {
    let [is, given, hint] = if is_self_calibrated {
        [
            "was taken as",
            "what was used at first",
            "`vidar calibrate` tells how well it is known; --calibration FILE gives a better one",
        ]
    } else {
        [
            "is given as",
            "what is given",
            "`vidar calibrate` and a ruler show which is right; correct T_BS in the calibration",
        ]
    };
    let told = |finding: &AdjustmentFinding| {
        let text = match finding {
            AdjustmentFinding::FocalLength(focus) => return focal_length(focus, given),
            AdjustmentFinding::Shifted { rms } => return shifted(*rms),
            AdjustmentFinding::StampsScatter { rms_secs } => return stamps_scatter(*rms_secs),
            AdjustmentFinding::CameraPosition { given_m, found_m, sigma_m } => format!(
                "the camera's position on the IMU {is} {} cm, the recording shows {} (σ {}) cm: {:.0} cm apart",
                in_cm(given_m),
                in_cm(found_m),
                in_cm(sigma_m),
                100.0 * (found_m - given_m).norm()
            ),
            AdjustmentFinding::CameraRotation { turned_rad, sigma_rad } => format!(
                "the camera's orientation on the IMU is off by {:.1}° (σ {:.1}°)",
                turned_rad.norm().to_degrees(),
                sigma_rad.max().to_degrees()
            ),
            other => format!("the recording contradicts its calibration: {other:?}"),
        };
        Warning::new("calibration-contradicted", format!("{text}; what was found is used")).hint(hint)
    };
    // Where something is not modelled, gains take up part of it and say nothing of the sensors.
    let gains = gains(&adjusted.imu).filter(|_| adjusted.report.is_explained());
    adjusted.findings.iter().map(told).chain(gains).collect()
}

/// The least gain that is told, and in how many of its σ: sensors of phones are good to 1 to 3 %. Of 461 adjustments, many of the same recordings, 18 were beyond: twelve of
/// recordings whose gyroscope had been given a gain or swapped axes, six where stabilised images or a carrier in view were not modelled.
const TOLD_GAIN: f64 = 0.03;
const TOLD_GAIN_SIGMAS: f64 = 3.0;

/// Sensors that read by a factor.
fn gains(imu: &AdjustedImu) -> impl Iterator<Item = Warning> {
    let told = |sensor: &str, gain: &Vector3<f64>, sigma: &Vector3<f64>| {
        let is_off = |(gain, sigma): (&f64, &f64)| {
            let off = (gain - 1.0).abs();
            *sigma > 0.0 && off > TOLD_GAIN && off > TOLD_GAIN_SIGMAS * sigma
        };
        gain.iter().zip(sigma).any(is_off).then(|| {
            let message = format!(
                "the {sensor}'s readings have to be multiplied by {:.3} {:.3} {:.3} (x y z; σ {:.3}); so they are",
                gain.x,
                gain.y,
                gain.z,
                sigma.max()
            );
            Warning::new("imu-gain", message).hint(
                "a full-scale range or unit that the driver assumes wrongly does this: correct it where the recording is made",
            )
        })
    };
    let gyro = told("gyroscope", &imu.gyro_gain, &imu.gyro_gain_sigma);
    let accel = told("accelerometer", &imu.accel_gain, &imu.accel_gain_sigma);
    gyro.into_iter().chain(accel)
}

/// Where the images' focal lengths scatter by less than this share of what their mean is off by, the lens is fixed and was given wrong: in rendered
/// recordings 0.05 to 0.1, where it changes 1.5 and more.
const FIXED_FOCUS: f64 = 0.3;

fn focal_length(focus: &Focus, given: &str) -> Warning {
    let by = 100.0 * focus.mean.exp_m1();
    let direction = if by < 0.0 { "shorter" } else { "longer" };
    let by = by.abs();
    if focus.spread < FIXED_FOCUS * focus.mean.abs() {
        let text = format!(
            "the focal length is {by:.1} % (σ {:.1} %) {direction} than {given}; what was found is used",
            100.0 * focus.mean_sigma
        );
        return Warning::new("calibration-contradicted", text)
            .hint("`vidar calibrate` finds the camera's calibration; a resized or cropped recording has another one");
    }
    let text = format!(
        "the focal length changes while filming: by \u{b1}{:.1} % about one that is {by:.1} % {direction} than the calibration's; every image gets its own",
        100.0 * focus.spread
    );
    Warning::new("focus-changes", text).hint(
        "lock the focus before filming: `vidar live` and the live trajectory take one focal length for all images, and their scale is worse for it",
    )
}

/// From here on images are stabilised, focal lengths: rendered stabilised phones have 0.016 to 0.021. A gyroscope in whose noise rows are placed wrongly has
/// 0.002.
const STABILISED: f64 = 0.005;

fn shifted(rms: f64) -> Warning {
    let shifted = format!(
        "shifted against what the gyroscope says, by {:.1}° (root mean square); every image gets its own shift",
        rms.atan().to_degrees()
    );
    if rms < STABILISED {
        return Warning::new("camera-not-rigid", format!("the images are {shifted}")).hint(
            "the camera moves on the IMU, or the gyroscope is noisier than it says; their common mount should be rigid",
        );
    }
    Warning::new("images-stabilised", format!("the images are stabilised: {shifted}")).hint(
        "switch optical and electronic stabilisation off before filming: live states are worse for it, and `vidar live` may begin late; it is told before by \
         odometry.image_shift_deg",
    )
}

fn stamps_scatter(rms_secs: f64) -> Warning {
    let message = format!(
        "image stamps scatter by {:.1} ms or more (root mean square, where it shows) about when the images were exposed; every image gets its own instant",
        1e3 * rms_secs
    );
    Warning::new("stamps-scatter", message).hint(
        "stamp images with the sensor's time (Android: the image's own timestamp), not when they arrive; `vidar live` finds it some seconds after the start, or is told \
         by odometry.stamp_scatter_ms",
    )
}

fn in_cm(v: &Vector3<f64>) -> String {
    let v = v * 100.0;
    format!("{:+.1} {:+.1} {:+.1}", v.x, v.y, v.z)
}

/// Poses of the body at every adjusted image.
pub(super) fn trajectory(adjusted: &Adjusted) -> Option<Trajectory> {
    let poses = adjusted
        .images
        .iter()
        .map(|(_, state)| StampedPose { time: state.time, world_from_body: state.world_from_body });
    Trajectory::new(BodyFrame::Imu, poses.collect()).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lens_that_moves_is_told_apart_from_one_that_is_given_wrong() {
        let told = |mean, spread| focal_length(&Focus { mean, mean_sigma: 1e-3, spread }, "what is given");
        let wrong = told(-0.02, 0.002);
        assert_eq!(wrong.kind, "calibration-contradicted");
        assert!(wrong.message.contains("2.0 % (σ 0.1 %) shorter than what is given"), "{}", wrong.message);
        let moves = told(0.004, 0.006);
        assert_eq!(moves.kind, "focus-changes");
        assert!(moves.message.contains("by ±0.6 % about one that is 0.4 % longer"), "{}", moves.message);
    }

    #[test]
    fn a_gain_is_told_where_it_is_large_and_known() {
        let with = |gyro: f64, gyro_sigma: f64, accel: f64| AdjustedImu {
            gyro_gain: Vector3::new(1.0, gyro, 1.0),
            accel_gain: Vector3::new(1.0, 1.0, accel),
            gyro_gain_sigma: Vector3::repeat(gyro_sigma),
            accel_gain_sigma: Vector3::repeat(0.002),
            gyro_noise_density: 1e-3,
            accel_noise_density: 1e-2,
        };
        let told = |imu: AdjustedImu| gains(&imu).map(|w| w.message).collect::<Vec<_>>();
        assert!(told(with(1.02, 1e-3, 0.98)).is_empty(), "what a phone's sensors do");
        assert!(told(with(0.93, 0.03, 1.0)).is_empty(), "not known");
        assert!(told(with(0.93, 0.0, 1.0)).is_empty(), "held");
        let gyro = told(with(0.93, 1e-3, 1.0));
        assert!(
            gyro.len() == 1
                && gyro[0].contains("gyroscope's readings have to be multiplied by 1.000 0.930 1.000")
        );
        assert!(told(with(0.93, 1e-3, 1.2)).len() == 2);
    }

    #[test]
    fn stabilised_images_are_told_apart_from_a_loose_camera() {
        let stabilised = shifted(0.0175);
        assert_eq!(stabilised.kind, "images-stabilised");
        assert!(stabilised.message.contains("by 1.0° (root mean square)"), "{}", stabilised.message);
        assert_eq!(shifted(0.002).kind, "camera-not-rigid");
    }
}
