//! Whether a calibration can be true.

use crate::error::OdometryError;
use vidar_core::RigCamera;

/// Cameras sit nearer to their IMU than this, m.
const MAX_LEVER_M: f64 = 2.0;
/// Clocks of camera and IMU are closer than this, s.
const MAX_OFFSET_SECS: f64 = 1.0;

/// Rejects calibrations that no rig has: a lever of metres, an offset of seconds, a focal length far from the image's size.
pub(crate) fn check(camera: &RigCamera) -> Result<(), OdometryError> {
    let bad = |what, found: f64, expected| Err(OdometryError::BadCalibration { what, found, expected });
    let lever = camera.body_from_camera.translation.norm();
    if !(lever < MAX_LEVER_M && camera.body_from_camera.is_finite()) {
        return bad("distance of camera and IMU", lever, "below 2 m");
    }
    let offset = camera.time_offset.as_secs_f64();
    if offset.abs() > MAX_OFFSET_SECS {
        return bad("time offset of camera and IMU", offset, "within 1 s");
    }
    let intrinsics = camera.model.intrinsics();
    let size = intrinsics.width.max(intrinsics.height) as f64;
    let ratio = intrinsics.fx / size;
    if !(ratio > 0.1 && ratio < 10.0) {
        return bad("focal length over image size", ratio, "0.1 to 10");
    }
    Ok(())
}
