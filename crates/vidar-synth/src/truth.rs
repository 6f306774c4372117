//! `truth.json`: the device's true parameters, for comparison with what was estimated.

use crate::config::SynthConfig;
use crate::error::SynthError;
use crate::layout;
use crate::schedule::Shot;
use serde_json::json;
use vidar_core::CameraModel;

/// File of the true parameters in a sequence's folder.
pub(crate) const TRUTH_FILE: &str = "truth.json";

/// The text of `truth.json`. Matrices are row by row; SI units, pixels with the first pixel's centre at (0, 0).
pub(crate) fn truth_text(
    config: &SynthConfig,
    camera: &CameraModel,
    shots: &[Shot],
) -> Result<String, SynthError> {
    let k = camera.intrinsics();
    let (model, distortion) = layout::distortion(camera);
    let [gyro_scale, accel_scale] = config.imu_scale();
    let noise = &config.imu_noise;
    let scale = config.imu_noise_scale;
    let repeated: Vec<i64> =
        shots.iter().flat_map(|s| s.stamps.iter().skip(1).map(|stamp| stamp.nanos())).collect();
    let truth = json!({
        "schema": "vidar.synth-truth/1",
        "camera": {
            "resolution": [k.width, k.height],
            "model": format!("pinhole with {model} distortion"),
            "intrinsics": [k.fx, k.fy, k.cx, k.cy],
            "distortion": distortion,
            "body_from_camera": layout::mount_matrix(config),
            "readout_secs": config.device.readout_secs,
            "stabilisation": config.device.stabilisation,
            "stamp_delay_secs": config.device.stamp_delay_secs,
            "stamp_scatter_secs": config.device.stamp_scatter_secs,
            "imu_time_minus_stamp_secs": -config.device.stamp_delay_secs,
            "frames": shots.iter().map(|s| s.stamps.len()).sum::<usize>(),
            "repeated_stamps_nanos": repeated,
            "calibration_written": config.device.calibration,
        },
        "imu": {
            "gyro_noise_density": noise.gyro_noise_density * scale,
            "gyro_random_walk": noise.gyro_random_walk * scale,
            "accel_noise_density": noise.accel_noise_density * scale,
            "accel_random_walk": noise.accel_random_walk * scale,
            "gyro_scale": gyro_scale.as_slice(),
            "accel_scale": accel_scale.as_slice(),
            "timing": config.device.imu_timing,
        },
    });
    Ok(format!("{truth:#}\n"))
}
