//! Describes a calibration in plain terms, so that errors are noticed before it is used.

use nalgebra::{Vector2, Vector3};
use vidar_core::{CameraModel, ImuNoise, LieGroup, Pinhole, RigCamera, Se3};
use vidar_dataset::{CalibrationSource, Recording};

/// The camera in use: model, field of view, extrinsics, clock, distance to the other cameras.
pub(super) fn describe_camera(dataset: &Recording) -> Vec<String> {
    let Some(camera) = dataset.rig.camera(dataset.camera) else { return Vec::new() };
    let mut words = describe_model(&camera.model, &dataset.calibration);
    if dataset.rig.imu.is_some() || camera.body_from_camera != Se3::IDENTITY {
        words.push(describe_position(&camera.body_from_camera));
        words.push(describe_axes(&camera.body_from_camera));
        words.push(describe_clock(camera));
    }
    let others = dataset.rig.cameras.iter().enumerate().filter(|(k, _)| *k != dataset.camera.index());
    for (number, other) in others.filter(|(_, o)| o.body_from_camera != camera.body_from_camera) {
        words.push(describe_baseline(number, &(camera.body_from_camera.inverse() * other.body_from_camera)));
    }
    words
}

fn describe_model(model: &CameraModel, source: &CalibrationSource) -> Vec<String> {
    let k = model.intrinsics();
    let from = match source {
        CalibrationSource::File(path) => format!("from {}", path.display()),
        CalibrationSource::Topic(name) => format!("from the topic {name}"),
        CalibrationSource::Flags => "from --camera-model".into(),
        CalibrationSource::Recording => "found from the recording itself".into(),
        CalibrationSource::Guessed => "guessed".into(),
        CalibrationSource::DatasetDefault => "the dataset's published calibration".into(),
    };
    let mut words = vec![format!(
        "{} {}x{}, f {:.1}/{:.1} px, centre {:.1}/{:.1} px; {from}",
        model.name(),
        k.width,
        k.height,
        k.fx,
        k.fy,
        k.cx,
        k.cy
    )];
    if let Some([across, down, corner]) = field_of_view_deg(model) {
        words.push(format!("field of view {across:.0} x {down:.0} degrees, {corner:.0} on the diagonal"));
    }
    words.extend(describe_distortion(model, k));
    words
}

/// Angles between the directions of opposite border pixels: across, down, from corner to corner.
fn field_of_view_deg(model: &CameraModel) -> Option<[f64; 3]> {
    let (w, h) = (model.width() as f64 - 1.0, model.height() as f64 - 1.0);
    let ray = |x: f64, y: f64| model.unproject(&Vector2::new(x, y));
    let between = |a: Option<Vector3<f64>>, b: Option<Vector3<f64>>| Some(a?.angle(&b?).to_degrees());
    Some([
        between(ray(0.0, h / 2.0), ray(w, h / 2.0))?,
        between(ray(w / 2.0, 0.0), ray(w / 2.0, h))?,
        between(ray(0.0, 0.0), ray(w, h))?,
    ])
}

/// Largest shift of a corner by the distortion.
fn describe_distortion(model: &CameraModel, k: &Pinhole) -> Option<String> {
    if matches!(model, CameraModel::Pinhole(_)) {
        return Some("no distortion".into());
    }
    let (w, h) = (k.width as f64 - 1.0, k.height as f64 - 1.0);
    let mut most: Option<(f64, f64)> = None;
    for corner in [(0.0, 0.0), (w, 0.0), (0.0, h), (w, h)].map(|(x, y)| Vector2::new(x, y)) {
        let ray = model.unproject(&corner)?;
        if ray.z <= 1e-3 {
            return Some("distortion: corners are at 90 degrees or more, outside any pinhole view".into());
        }
        let straight = Vector2::new(k.fx * ray.x / ray.z + k.cx, k.fy * ray.y / ray.z + k.cy);
        let centre = Vector2::new(k.cx, k.cy);
        let moved = (straight - corner).norm();
        let outward = (corner - centre).norm() - (straight - centre).norm();
        if most.is_none_or(|(m, _)| moved > m) {
            most = Some((moved, outward));
        }
    }
    let (moved, outward) = most?;
    let way = if outward < 0.0 { "inwards (barrel)" } else { "outwards (pincushion)" };
    Some(format!("distortion moves a corner's pixel by {moved:.1} px, {way}"))
}

/// Position of the camera on the body.
fn describe_position(body_from_camera: &Se3) -> String {
    let t = body_from_camera.translation;
    let parts: Vec<String> =
        ["x", "y", "z"].iter().zip(t.iter()).map(|(axis, v)| format!("{axis} {:+.1}", v * 100.0)).collect();
    format!("is {:.1} cm from the IMU: {} cm in the IMU's axes", t.norm() * 100.0, parts.join(", "))
}

/// Directions of the camera's axes on the body.
fn describe_axes(body_from_camera: &Se3) -> String {
    let along = |axis: Vector3<f64>| {
        let (name, off) = nearest_axis(&(body_from_camera.rotation * axis));
        if off < 0.05 { format!("body {name}") } else { format!("body {name} ({off:.1} deg off)") }
    };
    format!(
        "looks along {}; its right is {}, its down is {}",
        along(Vector3::z()),
        along(Vector3::x()),
        along(Vector3::y())
    )
}

/// The body's axis nearest to a direction, and the angle to it in degrees.
fn nearest_axis(direction: &Vector3<f64>) -> (String, f64) {
    let at = direction.iamax();
    let sign = if direction[at] < 0.0 { "-" } else { "+" };
    let mut axis = Vector3::zeros();
    axis[at] = direction[at].signum();
    (
        format!("{sign}{}", ["x", "y", "z"][at]),
        axis.cross(direction).norm().atan2(axis.dot(direction)).to_degrees(),
    )
}

fn describe_clock(camera: &RigCamera) -> String {
    let millis = camera.time_offset.as_secs_f64() * 1e3;
    match millis {
        0.0 => "clock: image timestamps are IMU time".into(),
        _ => format!("clock: IMU time is the image timestamp {millis:+.2} ms"),
    }
}

fn describe_baseline(number: usize, chosen_from_other: &Se3) -> String {
    let t = chosen_from_other.translation;
    let at = t.iamax();
    let side = match (at, t[at] > 0.0) {
        (0, true) => "to the right",
        (0, false) => "to the left",
        (1, true) => "below",
        (1, false) => "above",
        (_, true) => "ahead",
        (_, false) => "behind",
    };
    let turned = chosen_from_other.rotation.log().norm().to_degrees();
    format!("camera {number} is {:.1} cm {side} (baseline), rotated by {turned:.1} degrees", t.norm() * 100.0)
}

/// An IMU's noise in units that can be compared with a data sheet or with samples at rest.
pub(super) fn describe_noise(noise: &ImuNoise) -> Vec<String> {
    let root_rate = noise.rate_hz.max(0.0).sqrt();
    let (gyro, accel) = (noise.gyro_noise_density, noise.accel_noise_density);
    // A random walk of density d has grown to d·√t after t seconds.
    let minute = 60.0_f64.sqrt();
    vec![
        format!(
            "gyroscope noise {gyro:.2e} rad/s/sqrt(Hz): standard deviation of samples {:.3} deg/s at {:.0} Hz, of the angle {:.2} deg after an hour; bias drift {:.4} deg/s in a minute",
            (gyro * root_rate).to_degrees(),
            noise.rate_hz,
            (gyro * 60.0).to_degrees(),
            (noise.gyro_random_walk * minute).to_degrees()
        ),
        format!(
            "accelerometer noise {accel:.2e} m/s2/sqrt(Hz): standard deviation of samples {:.3} m/s2, of the velocity {:.3} m/s after a minute; bias drift {:.4} m/s2 in a minute",
            accel * root_rate,
            accel * minute,
            noise.accel_random_walk * minute
        ),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::camera::RadTan;
    use vidar_core::{Duration, So3};

    fn euroc() -> RigCamera {
        let pinhole = Pinhole::new(458.654, 457.296, 367.215, 248.375, 752, 480).unwrap();
        let radtan = RadTan::new(pinhole, [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]).unwrap();
        let matrix = nalgebra::Matrix4::new(
            0.0148655429818,
            -0.999880929698,
            0.00414029679422,
            -0.0216401454975,
            0.999557249008,
            0.0149672133247,
            0.025715529948,
            -0.064676986768,
            -0.0257744366974,
            0.00375618835797,
            0.999660727178,
            0.00981073058949,
            0.0,
            0.0,
            0.0,
            1.0,
        );
        RigCamera {
            model: CameraModel::RadTan(radtan),
            body_from_camera: Se3::from_matrix(&matrix).unwrap(),
            time_offset: Duration::ZERO,
            rate_hz: Some(20.0),
        }
    }

    #[test]
    fn the_euroc_camera_is_described() {
        let camera = euroc();
        let words = describe_model(&camera.model, &CalibrationSource::Flags).join("\n");
        assert!(words.contains("752x480, f 458.7/457.3 px"), "{words}");
        assert!(words.contains("px, inwards (barrel)"), "{words}");
        assert_eq!(
            describe_position(&camera.body_from_camera),
            "is 6.9 cm from the IMU: x -2.2, y -6.5, z +1.0 cm in the IMU's axes"
        );
        assert_eq!(
            describe_axes(&camera.body_from_camera),
            "looks along body +z (1.5 deg off); its right is body +y (1.7 deg off), its down is body -x (0.9 deg off)"
        );
        assert_eq!(describe_clock(&camera), "clock: image timestamps are IMU time");
        let late = RigCamera { time_offset: Duration::from_nanos(-7_500_000), ..camera };
        assert_eq!(describe_clock(&late), "clock: IMU time is the image timestamp -7.50 ms");
    }

    #[test]
    fn the_shift_of_a_corner_follows_the_model() {
        // One radial term: r becomes r(1 + k1 r²).
        let pinhole = Pinhole::new(100.0, 100.0, 49.5, 37.0, 100, 75).unwrap();
        let model = |k1| CameraModel::RadTan(RadTan::new(pinhole, [k1, 0.0, 0.0, 0.0]).unwrap());
        let shown = describe_distortion(&model(-0.1), &pinhole).unwrap();
        // The corner is at r_distorted; its ray at r with r(1 - 0.1 r²) = r_distorted.
        let distorted = (49.5_f64 / 100.0).hypot(37.0 / 100.0);
        let mut r = distorted;
        for _ in 0..200 {
            r = distorted + 0.1 * r * r * r;
        }
        let expected = format!("by {:.1} px, inwards", (r - distorted) * 100.0);
        assert!(shown.contains(&expected), "{shown}: {expected}");
        assert!(describe_distortion(&model(0.1), &pinhole).unwrap().contains("outwards"));
        assert_eq!(describe_distortion(&CameraModel::Pinhole(pinhole), &pinhole).unwrap(), "no distortion");
    }

    #[test]
    fn a_second_camera_is_described_by_its_direction() {
        let at = |x, y, z| Se3::new(So3::IDENTITY, Vector3::new(x, y, z));
        let turned = Se3::new(So3::exp(&Vector3::new(0.0, 0.1, 0.0)), Vector3::new(0.11, 0.002, 0.001));
        assert_eq!(
            describe_baseline(1, &turned),
            "camera 1 is 11.0 cm to the right (baseline), rotated by 5.7 degrees"
        );
        assert!(describe_baseline(1, &at(0.0, -0.2, 0.0)).contains("20.0 cm above"));
        assert!(describe_baseline(1, &at(0.0, 0.0, 0.3)).contains("30.0 cm ahead"));
    }

    #[test]
    fn noise_is_described_in_practical_units() {
        let words = describe_noise(&ImuNoise::EUROC);
        assert!(
            words[0].contains("0.137 deg/s at 200 Hz, of the angle 0.58 deg after an hour"),
            "{}",
            words[0]
        );
        assert!(words[1].contains("samples 0.028 m/s2, of the velocity 0.015 m/s"), "{}", words[1]);
    }
}
