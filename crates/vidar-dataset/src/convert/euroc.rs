//! A recording as a folder in EuRoC's layout, whose body is the IMU.

use super::mcap::without_invalid;
use super::{Converted, Progress, interrupted};
use crate::error::{DatasetError, io_error};
use crate::location::StoredDepth;
use crate::recording::{CalibrationSource, DepthSensor, Recording};
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use std::fmt::Write as _;
use std::io::{BufWriter, Write};
use std::path::Path;
use vidar_core::{
    BodyFrame, CameraModel, FrameImage, LieGroup, RigCamera, Se3, Timestamp, Trajectory, Warning,
};

/// Writes the folder.
pub(super) fn write(
    dataset: &Recording,
    out: &Path,
    progress: &Progress<'_>,
) -> Result<Converted, DatasetError> {
    let root = out.join("mav0");
    let mut done = Converted::default();
    write_images(dataset, &root.join("cam0"), &mut done, progress)?;
    write_imu(dataset, &root.join("imu0"), &mut done)?;
    write_depth(dataset, &root.join("depth0"), &mut done)?;
    if let Some(truth) = &dataset.ground_truth {
        write_truth(dataset, truth, &root)?;
        done.truth_poses = truth.len();
    }
    if let Some(own) = &dataset.external_trajectory {
        done.trajectory_poses = own.trajectory.len();
        let file = out.join("trajectory.tum");
        write_tum(&own.trajectory, &file)?;
        let message = "the layout has no place for a trajectory of the recording; it is in trajectory.tum";
        done.warnings
            .push(Warning::new("convert-trajectory", message).hint("--trajectory OUT/trajectory.tum"));
    }
    if let Some(cloud) = &dataset.reference_cloud {
        let folder = root.join("pointcloud0");
        std::fs::create_dir_all(&folder).map_err(io_error(&folder))?;
        std::fs::copy(cloud, folder.join("data.ply")).map_err(io_error(cloud))?;
    }
    Ok(done)
}

/// A file that is written line by line.
fn text_file(path: &Path) -> Result<BufWriter<std::fs::File>, DatasetError> {
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder).map_err(io_error(folder))?;
    }
    std::fs::File::create(path).map(BufWriter::new).map_err(io_error(path))
}

fn write_text(path: &Path, text: &str) -> Result<(), DatasetError> {
    let mut file = text_file(path)?;
    file.write_all(text.as_bytes()).and_then(|()| file.flush()).map_err(io_error(path))
}

fn write_images(
    dataset: &Recording,
    folder: &Path,
    done: &mut Converted,
    progress: &Progress<'_>,
) -> Result<(), DatasetError> {
    let data = folder.join("data");
    std::fs::create_dir_all(&data).map_err(io_error(&data))?;
    let mut list = String::from("#timestamp [ns],filename\n");
    for entry in &dataset.images {
        let name = format!("{}.png", entry.time.nanos());
        write_png(&data.join(&name), &dataset.load_image(entry)?)?;
        let _ = writeln!(list, "{},{name}", entry.time.nanos());
        done.images += 1;
        if !progress(done.images, dataset.images.len()) {
            return Err(interrupted(folder));
        }
    }
    write_text(&folder.join("data.csv"), &list)?;
    let Some(camera) = dataset.rig.camera(dataset.camera) else { return Ok(()) };
    let is_known = dataset.calibration != CalibrationSource::Guessed;
    write_text(&folder.join("sensor.yaml"), &camera_yaml(dataset, camera, is_known))
}

fn write_png(path: &Path, image: &FrameImage) -> Result<(), DatasetError> {
    let (width, height) = (image.width() as u32, image.height() as u32);
    let (color, bytes): (ExtendedColorType, Vec<u8>) = match image {
        FrameImage::Gray8(i) => (ExtendedColorType::L8, i.data().to_vec()),
        // The encoder takes 16-bit values in the machine's order.
        FrameImage::Gray16(i) => {
            (ExtendedColorType::L16, i.data().iter().flat_map(|v| v.to_ne_bytes()).collect())
        }
        FrameImage::Rgb8(i) => (ExtendedColorType::Rgb8, i.data().iter().flatten().copied().collect()),
    };
    let file = std::fs::File::create(path).map_err(io_error(path))?;
    let mut out = BufWriter::new(file);
    let encoder = PngEncoder::new_with_quality(&mut out, CompressionType::Fast, FilterType::Adaptive);
    let failed = |e: image::ImageError| io_error(path)(std::io::Error::other(e));
    encoder.write_image(&bytes, width, height, color).map_err(failed)?;
    out.flush().map_err(io_error(path))
}

fn list(numbers: &[f64]) -> String {
    let texts: Vec<String> = numbers.iter().map(f64::to_string).collect();
    format!("[{}]", texts.join(", "))
}

/// `T_BS` in EuRoC's form.
fn mount_yaml(body_from_sensor: &Se3) -> String {
    let matrix = body_from_sensor.matrix();
    let rows: Vec<f64> = matrix.transpose().iter().copied().collect();
    format!("T_BS:\n  cols: 4\n  rows: 4\n  data: {}\n", list(&rows))
}

fn model_yaml(model: &CameraModel) -> String {
    let parameters = model.parameters();
    let (intrinsics, rest) = parameters.split_at(4.min(parameters.len()));
    let (camera, intrinsics, distortion, coefficients) = match model {
        CameraModel::Pinhole(_) => ("pinhole", intrinsics.to_vec(), "none", Vec::new()),
        CameraModel::RadTan(_) => ("pinhole", intrinsics.to_vec(), "radial-tangential", rest.to_vec()),
        CameraModel::Equidistant(_) => ("pinhole", intrinsics.to_vec(), "equidistant", rest.to_vec()),
        CameraModel::Fov(_) => ("pinhole", intrinsics.to_vec(), "fov", rest.to_vec()),
        CameraModel::DoubleSphere(_) => ("ds", [rest, intrinsics].concat(), "none", Vec::new()),
    };
    format!(
        "resolution: [{}, {}]\ncamera_model: {camera}\nintrinsics: {}\ndistortion_model: {distortion}\ndistortion_coefficients: {}\n",
        model.width(),
        model.height(),
        list(&intrinsics),
        list(&coefficients)
    )
}

fn camera_yaml(dataset: &Recording, camera: &RigCamera, is_known: bool) -> String {
    let mut text = format!("sensor_type: camera\n{}", mount_yaml(&camera.body_from_camera));
    if let Some(rate_hz) = camera.rate_hz {
        let _ = writeln!(text, "rate_hz: {rate_hz}");
    }
    if is_known {
        text += &model_yaml(&camera.model);
        if camera.time_offset.nanos() != 0 {
            let _ = writeln!(
                text,
                "# t_imu = t_camera + timeshift_cam_imu\ntimeshift_cam_imu: {}",
                camera.time_offset.as_secs_f64()
            );
        }
        if let Some(readout) = dataset.readout {
            let _ = writeln!(text, "readout_secs: {}", readout.as_secs_f64());
        }
    }
    text
}

fn write_imu(dataset: &Recording, folder: &Path, done: &mut Converted) -> Result<(), DatasetError> {
    if dataset.imu.is_empty() {
        return Ok(());
    }
    let path = folder.join("data.csv");
    let mut out = text_file(&path)?;
    let head = "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]";
    writeln!(out, "{head}").map_err(io_error(&path))?;
    for s in &dataset.imu {
        let (w, a) = (s.gyro.0, s.accel.0);
        writeln!(out, "{},{},{},{},{},{},{}", s.time.nanos(), w.x, w.y, w.z, a.x, a.y, a.z)
            .map_err(io_error(&path))?;
    }
    out.flush().map_err(io_error(&path))?;
    done.imu_samples = dataset.imu.len();
    let mut text = format!("sensor_type: imu\n{}", mount_yaml(&Se3::IDENTITY));
    if let Some(noise) = &dataset.rig.imu {
        let _ = write!(
            text,
            "rate_hz: {}\ngyroscope_noise_density: {}\ngyroscope_random_walk: {}\naccelerometer_noise_density: {}\naccelerometer_random_walk: {}\n",
            noise.rate_hz,
            noise.gyro_noise_density,
            noise.gyro_random_walk,
            noise.accel_noise_density,
            noise.accel_random_walk
        );
    }
    write_text(&folder.join("sensor.yaml"), &text)
}

/// Millimetres, for depth that is not stored as whole numbers.
const UNITS_PER_METRE: f64 = 1000.0;

fn write_depth(dataset: &Recording, folder: &Path, done: &mut Converted) -> Result<(), DatasetError> {
    let Some(sensor) = dataset.depth_sensor.as_ref().filter(|_| !dataset.depths.is_empty()) else {
        return Ok(());
    };
    let data = folder.join("data");
    std::fs::create_dir_all(&data).map_err(io_error(&data))?;
    let (mut list, mut units, mut clipped) =
        (String::from("#timestamp [ns],filename\n"), sensor.units_per_metre, 0usize);
    for entry in &dataset.depths {
        let raw = match dataset.media.depth(&entry.location)? {
            StoredDepth::Units(raw) => raw.map(|&v| without_invalid(v, sensor)),
            StoredDepth::Metres(metres) => {
                units = UNITS_PER_METRE;
                metres.map(|&m| {
                    let value = (f64::from(m) * UNITS_PER_METRE).round();
                    let fits = (1.0..f64::from(u16::MAX)).contains(&value);
                    clipped += usize::from(!fits && m.is_finite() && m > 0.0);
                    if fits { value as u16 } else { 0 }
                })
            }
        };
        let name = format!("{}.png", entry.time.nanos());
        write_png(&data.join(&name), &FrameImage::Gray16(raw))?;
        let _ = writeln!(list, "{},{name}", entry.time.nanos());
        done.depths += 1;
    }
    write_text(&folder.join("data.csv"), &list)?;
    if clipped > 0 {
        let message = format!(
            "{clipped} depths beyond 65 m do not fit into millimetres of 16 bits and are written as none"
        );
        done.warnings.push(Warning::degraded("convert-depth", message).at(folder.display()));
    }
    write_text(&folder.join("sensor.yaml"), &depth_yaml(dataset, sensor, units))
}

fn depth_yaml(dataset: &Recording, sensor: &DepthSensor, units: f64) -> String {
    let body_from_camera = dataset.rig.camera(dataset.camera).map_or(Se3::IDENTITY, |c| c.body_from_camera);
    let body_from_depth = body_from_camera * sensor.color_from_depth;
    let pinhole = CameraModel::Pinhole(sensor.intrinsics);
    let model = model_yaml(sensor.distorted.as_ref().unwrap_or(&pinhole));
    format!("sensor_type: depth\n{}{model}units_per_metre: {units}\n", mount_yaml(&body_from_depth))
}

/// Reference poses of the body, or positions of another one.
fn write_truth(dataset: &Recording, truth: &Trajectory, root: &Path) -> Result<(), DatasetError> {
    let camera_from_body = |id| {
        let camera = dataset.rig.camera(id).map(|c| c.body_from_camera);
        camera.filter(|m| *m != Se3::IDENTITY).map(|m| m.inverse())
    };
    let sensor_from_body = match truth.body() {
        BodyFrame::Imu => None,
        BodyFrame::Camera(id) => camera_from_body(id),
        BodyFrame::Other => {
            let mut text = String::from("#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m]\n");
            for p in truth.poses() {
                let t = p.world_from_body.translation;
                let _ = writeln!(text, "{},{},{},{}", p.time.nanos(), t.x, t.y, t.z);
            }
            return write_text(&root.join("leica0/data.csv"), &text);
        }
    };
    let mut text = String::from(
        "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []\n",
    );
    for p in truth.poses() {
        let pose = sensor_from_body.map_or(p.world_from_body, |motion| p.world_from_body * motion);
        let (t, [x, y, z, w]) = (pose.translation, pose.rotation.quaternion_xyzw());
        let _ = writeln!(text, "{},{},{},{},{w},{x},{y},{z}", p.time.nanos(), t.x, t.y, t.z);
    }
    write_text(&root.join("state_groundtruth_estimate0/data.csv"), &text)
}

/// The recording's own trajectory in TUM's format, with its body.
fn write_tum(trajectory: &Trajectory, path: &Path) -> Result<(), DatasetError> {
    let body = match trajectory.body() {
        BodyFrame::Imu => "imu".to_string(),
        BodyFrame::Camera(id) => format!("camera{id}"),
        BodyFrame::Other => "tracked-object".to_string(),
    };
    let mut text = format!("# world_from_body, body = {body}\n# timestamp tx ty tz qx qy qz qw\n");
    for p in trajectory.poses() {
        let (t, [x, y, z, w]) = (p.world_from_body.translation, p.world_from_body.rotation.quaternion_xyzw());
        let time: Timestamp = p.time;
        let _ = writeln!(text, "{} {} {} {} {x} {y} {z} {w}", time.to_secs_string(), t.x, t.y, t.z);
    }
    write_text(path, &text)
}
