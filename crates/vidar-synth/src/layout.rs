//! The texts and clouds of a EuRoC folder (ASL format).

use crate::config::SynthConfig;
use crate::device::Mount;
use crate::error::SynthError;
use crate::flight::FlightPath;
use crate::imu::ImuRecord;
use crate::rig::EUROC_BODY_FROM_CAMERA;
use crate::scan::ScanPoint;
use crate::stamps::secs;
use std::fmt::Write as _;
use std::fs::File;
use std::io::{BufWriter, Write as _};
use std::path::Path;
use vidar_core::{CameraModel, Timestamp};

/// `data.csv` of a camera or a depth camera.
pub(crate) fn image_list(times: &[Timestamp], extension: &str) -> String {
    let mut text = String::from("#timestamp [ns],filename\n");
    for t in times {
        let _ = writeln!(text, "{0},{0}.{extension}", t.nanos());
    }
    text
}

/// `data.csv` of the IMU.
pub(crate) fn imu_list(record: &ImuRecord) -> String {
    let mut text = String::from(
        "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],\
         a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n",
    );
    for s in &record.samples {
        let (w, a) = (s.gyro.0, s.accel.0);
        let t = s.time.nanos();
        let _ = writeln!(text, "{t},{:.12},{:.12},{:.12},{:.10},{:.10},{:.10}", w.x, w.y, w.z, a.x, a.y, a.z);
    }
    text
}

/// `data.csv` of the ground truth: EuRoC's 17 columns.
pub(crate) fn truth_list(flight: &FlightPath, record: &ImuRecord) -> String {
    let mut text = String::from(
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], \
         v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], \
         b_w_RS_S_z [rad s^-1], b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]\n",
    );
    let mut previous = None;
    for ((sample, bw), ba) in record.samples.iter().zip(&record.gyro_bias).zip(&record.accel_bias) {
        let time = sample.time;
        // A repeated row of the IMU is one state.
        if previous.replace(time) == Some(time) {
            continue;
        }
        let state = flight.state(secs(time));
        let (p, v) = (state.world_from_body.translation, state.velocity_in_world);
        let [x, y, z, w] = state.world_from_body.rotation.quaternion_xyzw();
        let _ =
            write!(text, "{},{:.9},{:.9},{:.9},{w:.12},{x:.12},{y:.12},{z:.12}", time.nanos(), p.x, p.y, p.z);
        for part in [v, *bw, *ba] {
            let _ = write!(text, ",{:.9},{:.9},{:.9}", part.x, part.y, part.z);
        }
        text.push('\n');
    }
    text
}

fn transform_yaml(matrix: &[f64; 16]) -> String {
    let mut text = String::from("T_BS:\n  cols: 4\n  rows: 4\n  data: [");
    for (i, value) in matrix.iter().enumerate() {
        let gap = if i == 15 {
            "]\n"
        } else if i % 4 == 3 {
            ",\n         "
        } else {
            ", "
        };
        let _ = write!(text, "{value:?}{gap}");
    }
    text
}

#[rustfmt::skip]
const IDENTITY: [f64; 16] =
    [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];

/// Name and coefficients of a camera's distortion, as EuRoC's `sensor.yaml` has them: k1, k2, p1, p2, or k1 to k4 of a fisheye.
pub(crate) fn distortion(camera: &CameraModel) -> (&'static str, [f64; 4]) {
    match camera {
        CameraModel::RadTan(m) => ("radial-tangential", m.distortion),
        CameraModel::Equidistant(m) => ("equidistant", m.distortion),
        _ => ("radial-tangential", [0.0; 4]),
    }
}

/// `T_BS` of the mount, row by row; EuRoC's as published, digit for digit.
pub(crate) fn mount_matrix(config: &SynthConfig) -> [f64; 16] {
    if config.device.mount == Mount::Euroc {
        return EUROC_BODY_FROM_CAMERA;
    }
    let matrix = config.body_from_camera().matrix();
    std::array::from_fn(|i| matrix[(i / 4, i % 4)])
}

/// `sensor.yaml` of cam0, or, with `depth_units_per_metre`, of the depth registered to cam0's pixels.
///
/// `body_from_camera` is `T_BS`, row by row; without it no place of the sensor is written.
pub(crate) fn camera_yaml(
    camera: &CameraModel,
    body_from_camera: Option<&[f64; 16]>,
    rate_hz: f64,
    depth_units_per_metre: Option<u32>,
) -> String {
    let k = camera.intrinsics();
    let (model, distortion) = distortion(camera);
    let kind = if depth_units_per_metre.is_some() { "depth" } else { "camera" };
    let comment = if depth_units_per_metre.is_some() {
        "exact z-depth along the optical axis of cam0, registered to cam0's (distorted) pixels"
    } else {
        "simulated VI-Sensor cam0"
    };
    let mut text =
        format!("%YAML:1.0\n# General sensor definitions.\nsensor_type: {kind}\ncomment: {comment}\n\n");
    if let Some(matrix) = body_from_camera {
        text.push_str("# Sensor extrinsics wrt. the body-frame.\n");
        text.push_str(&transform_yaml(matrix));
    }
    let _ = write!(
        text,
        "\n# Camera specific definitions.\nrate_hz: {rate_hz}\nresolution: [{}, {}]\ncamera_model: pinhole\n\
         intrinsics: [{:?}, {:?}, {:?}, {:?}] #fu, fv, cu, cv\ndistortion_model: {model}\n\
         distortion_coefficients: {distortion:?}\n",
        k.width, k.height, k.fx, k.fy, k.cx, k.cy
    );
    if let Some(units) = depth_units_per_metre {
        let _ = write!(
            text,
            "\n# 16-bit value = depth in metres times this; 0 = no depth.\nunits_per_metre: {units}\n"
        );
    }
    text
}

/// `sensor.yaml` of the IMU.
pub(crate) fn imu_yaml(config: &SynthConfig) -> String {
    let n = &config.imu_noise;
    // A noise-free IMU still states its data sheet, since estimators divide by it.
    let scale = if config.imu_noise_scale > 0.0 { config.imu_noise_scale } else { 1.0 };
    let stated = scale * config.device.stated_noise_factor;
    format!(
        "%YAML:1.0\n# General sensor definitions.\nsensor_type: imu\ncomment: simulated IMU\n\n\
         # Sensor extrinsics wrt. the body-frame.\n{}rate_hz: {}\n\n\
         # inertial sensor noise model parameters (static)\n\
         gyroscope_noise_density: {:?}     # [ rad / s / sqrt(Hz) ]   ( gyro \"white noise\" )\n\
         gyroscope_random_walk: {:?}       # [ rad / s^2 / sqrt(Hz) ] ( gyro bias diffusion )\n\
         accelerometer_noise_density: {:?}  # [ m / s^2 / sqrt(Hz) ]   ( accel \"white noise\" )\n\
         accelerometer_random_walk: {:?}    # [ m / s^3 / sqrt(Hz) ].  ( accel bias diffusion )\n",
        transform_yaml(&IDENTITY),
        config.imu_rate_hz,
        n.gyro_noise_density * stated,
        n.gyro_random_walk * stated,
        n.accel_noise_density * stated,
        n.accel_random_walk * stated,
    )
}

/// `sensor.yaml` of a sensor that is at the body or in the world itself.
pub(crate) fn plain_yaml(sensor_type: &str, comment: &str) -> String {
    let transform = transform_yaml(&IDENTITY);
    format!(
        "%YAML:1.0\n# General sensor definitions.\nsensor_type: {sensor_type}\ncomment: {comment}\n\n{transform}"
    )
}

/// Writes a text file.
pub(crate) fn write_text(path: &Path, text: &str) -> Result<(), SynthError> {
    std::fs::write(path, text).map_err(SynthError::write(path))
}

/// Writes a binary PLY of positions in the world (float32) and grey as colour.
pub(crate) fn write_ply(path: &Path, points: &[ScanPoint]) -> Result<(), SynthError> {
    let write = || -> std::io::Result<()> {
        let mut file = BufWriter::new(File::create(path)?);
        write!(
            file,
            "ply\nformat binary_little_endian 1.0\ncomment world frame, metres\nelement vertex {}\n\
             property float x\nproperty float y\nproperty float z\n\
             property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n",
            points.len()
        )?;
        for p in points {
            for k in 0..3 {
                file.write_all(&(p.position[k] as f32).to_le_bytes())?;
            }
            file.write_all(&[p.gray; 3])?;
        }
        file.flush()
    };
    write().map_err(SynthError::write(path))
}
