//! What phones have in common: how the camera is mounted, and a check of it against gravity.

use crate::draft::Draft;
use nalgebra::{Matrix3, Vector3};
use vidar_core::{LieGroup, So3, Warning};

/// Orientation of a back camera, as its sensor delivers its rows, on the phone's IMU axes (x right, y up, z out of the screen, the same
/// on Android and iOS). The longer side of the image lies along the phone: image right is −y, image down is −x, the view is −z.
///
/// It follows from Android's `SENSOR_ORIENTATION` of 90°, which nearly all back cameras have, and from Apple's device axes. An upright
/// video is turned clockwise by `quarter_turns` from it.
pub(crate) fn camera_from_imu(quarter_turns: u8) -> So3 {
    let native = Matrix3::new(0.0, -1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, -1.0);
    // Clockwise in an image whose y points down is a positive turn about the view.
    let turn = f64::from(quarter_turns % 4) * std::f64::consts::FRAC_PI_2;
    So3::from_axis_angle(&Vector3::z(), turn) * So3::from_matrix(&native).unwrap_or(So3::IDENTITY)
}

/// `[fx, fy, cx, cy]` of a picture that is turned clockwise by quarter turns to be `upright` columns and rows.
pub(crate) fn turned([fx, fy, cx, cy]: [f64; 4], quarter_turns: u8, upright: (usize, usize)) -> [f64; 4] {
    let (right, bottom) = (upright.0 as f64 - 1.0, upright.1 as f64 - 1.0);
    match quarter_turns % 4 {
        0 => [fx, fy, cx, cy],
        1 => [fy, fx, right - cy, cx],
        2 => [fx, fy, right - cx, bottom - cy],
        _ => [fy, fx, cy, bottom - cx],
    }
}

/// Uses the usual mount for the camera of a phone whose recorder states none.
pub(crate) fn assume_mount(draft: &mut Draft, quarter_turns: u8) {
    if draft.imu.is_empty() {
        return;
    }
    let message = "the recorder states no pose of the camera on the IMU; a back camera with the usual orientation is \
                   assumed, at the IMU's position (true within some centimetres)";
    draft.assume_mount(camera_from_imu(quarter_turns).inverse(), message);
}

/// Compares the mean direction of the specific force with the vertical of the recorder's poses, of which `up` is an axis; turns the sign of
/// the accelerometer where they are opposite, and warns where they do not agree.
pub(crate) fn check_vertical(draft: &mut Draft, up_in_world: Vector3<f64>) {
    let Some((trajectory, place)) = &draft.trajectory else { return };
    let Some(camera) = draft.cameras.get(draft.chosen) else { return };
    let camera_from_body = camera.body_from_camera.inverse();
    let (mut sum, mut count, mut at) = (Vector3::zeros(), 0usize, 0);
    for pose in trajectory.poses() {
        while at + 1 < draft.imu.len() && draft.imu[at].time < pose.time {
            at += 1;
        }
        let Some(sample) = draft.imu.get(at).filter(|s| (s.time - pose.time).abs().as_secs_f64() < 0.05)
        else {
            continue;
        };
        let in_camera = camera_from_body.rotation.act(&sample.accel.0);
        sum += pose.world_from_body.rotation.act(&in_camera);
        count += 1;
    }
    // Fewer poses are no mean: a hand's accelerations do not cancel.
    if count < 10 || sum.norm() < 1e-6 {
        return;
    }
    let cosine = sum.normalize().dot(&up_in_world);
    let degrees = cosine.clamp(-1.0, 1.0).acos().to_degrees();
    let place = place.display().to_string();
    if cosine < -0.9 {
        draft.imu.iter_mut().for_each(|s| s.accel.0 = -s.accel.0);
        let message = "the accelerometer points down where the recorder's poses say up; its sign is turned";
        draft.warnings.push(Warning::new("accel-sign", message).at(place));
    } else if cosine < 0.9 {
        let message =
            format!("the accelerometer's vertical is {degrees:.0}° off that of the recorder's poses");
        let warning = Warning::degraded("mount-gravity", message).at(place);
        draft.warnings.push(
            warning.hint("the camera may be mounted in another way: `vidar calibrate` finds its rotation"),
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn intrinsics_turn_with_the_picture() {
        // A ray through a pixel of the sensor goes through the same pixel of the upright picture.
        let [fx, fy, cx, cy] = [500.0, 510.0, 300.0, 200.0];
        let native = Vector3::new(0.1, -0.2, 1.0);
        let (x, y) = (cx + fx * native.x, cy + fy * native.y);
        for (turns, upright) in [(0, (640, 480)), (1, (480, 640)), (2, (640, 480)), (3, (480, 640))] {
            let (w, h) = (upright.0 as f64 - 1.0, upright.1 as f64 - 1.0);
            let shown = [(x, y), (w - y, x), (w - x, h - y), (y, h - x)][usize::from(turns)];
            let ray = (camera_from_imu(turns) * camera_from_imu(0).inverse()).act(&native);
            let [fx, fy, cx, cy] = turned([fx, fy, cx, cy], turns, upright);
            let found = (cx + fx * ray.x / ray.z, cy + fy * ray.y / ray.z);
            assert!(
                (found.0 - shown.0).abs() + (found.1 - shown.1).abs() < 1e-9,
                "{turns}: {found:?} {shown:?}"
            );
        }
    }

    #[test]
    fn an_upright_portrait_video_sees_gravity_downward() {
        // A phone held upright: the specific force at rest is along its +y, up, which is −y in an upright image.
        let up = Vector3::new(0.0, 9.81, 0.0);
        let in_image = camera_from_imu(1).act(&up);
        assert!((in_image - Vector3::new(0.0, -9.81, 0.0)).norm() < 1e-12, "{in_image}");
        // In landscape with the top to the left, the right edge up, the picture needs no turn.
        let up = Vector3::new(9.81, 0.0, 0.0);
        let in_image = camera_from_imu(0).act(&up);
        assert!((in_image - Vector3::new(0.0, -9.81, 0.0)).norm() < 1e-12, "{in_image}");
        // Looking down at the floor, the phone on its back in the air: the view is against the force.
        assert!(camera_from_imu(3).act(&Vector3::z()).z < -0.999);
    }
}
