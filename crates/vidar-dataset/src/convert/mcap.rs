//! A recording as MCAP: `/cam0/image_raw`, `/cam0/camera_info`, `/imu0`, `/tf_static`, `/depth0/…`, and poses as odometry.

use super::facts::{Facts, NAME};
use super::{Converted, Progress, interrupted};
use crate::error::{DatasetError, io_error};
use crate::location::StoredDepth;
use crate::recording::{CalibrationSource, DepthEntry, DepthSensor, ImageEntry, Recording};
use std::fs::File;
use std::io::BufWriter;
use std::path::Path;
use vidar_bag::write::{ChannelId, McapWriter, encode};
use vidar_bag::{CameraInfo, FramePose, FrameTransform, Header, ImuMessage, Message, Pose, RawImage};
use vidar_core::{
    BodyFrame, CameraModel, FrameImage, Pinhole, Se3, StampedPose, Timestamp, Trajectory, Warning,
};

const CAMERA: &str = "cam0";
const IMU: &str = "imu0";
const DEPTH: &str = "depth0";
const WORLD: &str = "world";

/// What comes next, in the order of time; at equal times IMU and poses come before the images.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Item {
    Imu(usize),
    Truth(usize),
    Trajectory(usize),
    Depth(usize),
    Image(usize),
}

struct Writer<'a> {
    dataset: &'a Recording,
    out: McapWriter<BufWriter<File>>,
    path: &'a Path,
    channels: Vec<(String, ChannelId)>,
}

/// Writes the file.
pub(super) fn write(
    dataset: &Recording,
    path: &Path,
    progress: &Progress<'_>,
) -> Result<Converted, DatasetError> {
    let file = File::create(path).map_err(io_error(path))?;
    let library = concat!("vidar ", env!("CARGO_PKG_VERSION"));
    let out = McapWriter::new(BufWriter::new(file), library).map_err(io_error(path))?;
    let mut writer = Writer { dataset, out, path, channels: Vec::new() };
    let (truth, trajectory) =
        (dataset.ground_truth.as_ref(), dataset.external_trajectory.as_ref().map(|t| &t.trajectory));
    let mut facts = Facts::of(dataset);
    facts.truth_topic = truth.map(|_| "/ground_truth".into());
    facts.trajectory_topic = trajectory.map(|_| "/trajectory".into());
    let raw_depth = dataset.depth_sensor.as_ref().filter(|s| s.distorted.is_none());
    facts.depth_units_per_metre = raw_depth.map(|s| s.units_per_metre);
    writer.out.metadata(NAME, &facts.to_map()).map_err(io_error(path))?;
    writer.transforms()?;
    let mut order: Vec<(Timestamp, Item)> = Vec::new();
    order.extend(dataset.imu.iter().enumerate().map(|(i, s)| (s.time, Item::Imu(i))));
    order.extend(poses(truth).iter().enumerate().map(|(i, p)| (p.time, Item::Truth(i))));
    order.extend(poses(trajectory).iter().enumerate().map(|(i, p)| (p.time, Item::Trajectory(i))));
    order.extend(dataset.depths.iter().enumerate().map(|(i, d)| (d.time, Item::Depth(i))));
    order.extend(dataset.images.iter().enumerate().map(|(i, e)| (e.time, Item::Image(i))));
    order.sort_unstable();
    let mut done = Converted::default();
    for (_, item) in order {
        match item {
            Item::Imu(i) => {
                let s = &dataset.imu[i];
                let (gyro, accel) = (s.gyro.0.into(), s.accel.0.into());
                let header = header(s.time, IMU);
                let sample = ImuMessage { header, angular_velocity: gyro, linear_acceleration: accel };
                writer.send("/imu0", s.time, &Message::Imu(sample))?;
                done.imu_samples += 1;
            }
            Item::Truth(i) => done.truth_poses += writer.pose("/ground_truth", truth, i)?,
            Item::Trajectory(i) => done.trajectory_poses += writer.pose("/trajectory", trajectory, i)?,
            Item::Depth(i) => {
                writer.depth(&dataset.depths[i])?;
                done.depths += 1;
            }
            Item::Image(i) => {
                writer.image(&dataset.images[i])?;
                done.images += 1;
                if !progress(done.images, dataset.images.len()) {
                    return Err(interrupted(path));
                }
            }
        }
    }
    writer.out.finish().map_err(io_error(path))?;
    if dataset.reference_cloud.is_some() {
        let message = "the reference cloud is not written; give it with --reference";
        done.warnings.push(Warning::new("convert-cloud", message));
    }
    Ok(done)
}

fn poses(trajectory: Option<&Trajectory>) -> &[StampedPose] {
    trajectory.map_or(&[], |t| t.poses())
}

fn header(stamp: Timestamp, frame: &str) -> Header {
    Header { stamp, frame: frame.to_string() }
}

fn pose_of(motion: &Se3) -> Pose {
    Pose { position: motion.translation.into(), orientation: motion.rotation.quaternion_xyzw() }
}

impl Writer<'_> {
    fn send(&mut self, topic: &str, time: Timestamp, message: &Message) -> Result<(), DatasetError> {
        let invalid = |reason: String| {
            std::io::Error::new(std::io::ErrorKind::InvalidData, format!("{topic}: {reason}"))
        };
        let (message_type, bytes) = encode(message).map_err(|e| io_error(self.path)(invalid(e)))?;
        let known = self.channels.iter().find(|(name, _)| name == topic).map(|(_, id)| *id);
        let channel = match known {
            Some(id) => id,
            None => {
                let id = self.out.channel(topic, message_type).map_err(io_error(self.path))?;
                self.channels.push((topic.to_string(), id));
                id
            }
        };
        self.out.write(channel, time, &bytes).map_err(io_error(self.path))
    }

    /// Where the cameras are on the body, once, at the time of the first image.
    fn transforms(&mut self) -> Result<(), DatasetError> {
        let dataset = self.dataset;
        let Some(time) = dataset.images.first().map(|i| i.time) else { return Ok(()) };
        let Some(camera) = dataset.rig.camera(dataset.camera) else { return Ok(()) };
        let mut transforms = Vec::new();
        let mut add = |parent: &str, child: &str, parent_from_child: &Se3| {
            let (parent, pose) = (header(time, parent), pose_of(parent_from_child));
            transforms.push(FrameTransform { parent, child: child.into(), pose });
        };
        if !dataset.imu.is_empty() {
            add(IMU, CAMERA, &camera.body_from_camera);
        }
        if let Some(sensor) = &dataset.depth_sensor {
            add(CAMERA, DEPTH, &sensor.color_from_depth);
        }
        if transforms.is_empty() {
            return Ok(());
        }
        self.send("/tf_static", time, &Message::Transforms(transforms))
    }

    fn pose(
        &mut self,
        topic: &str,
        trajectory: Option<&Trajectory>,
        index: usize,
    ) -> Result<usize, DatasetError> {
        let Some(trajectory) = trajectory else { return Ok(0) };
        let pose = &trajectory.poses()[index];
        // Poses of another camera, or of a body that is neither, keep their name and no relation to the rest.
        let child = match trajectory.body() {
            BodyFrame::Imu if self.dataset.imu.is_empty() => CAMERA.to_string(),
            BodyFrame::Imu => IMU.to_string(),
            BodyFrame::Camera(id) if id == self.dataset.camera => CAMERA.to_string(),
            BodyFrame::Camera(id) => format!("camera{id}"),
            BodyFrame::Other => "tracked_object".to_string(),
        };
        let message =
            FramePose { header: header(pose.time, WORLD), child, pose: pose_of(&pose.world_from_body) };
        self.send(topic, pose.time, &Message::Poses(vec![message]))?;
        Ok(1)
    }

    fn image(&mut self, entry: &ImageEntry) -> Result<(), DatasetError> {
        let image = raw_image(header(entry.time, CAMERA), &self.dataset.load_image(entry)?);
        self.send("/cam0/image_raw", entry.time, &Message::Image(image))?;
        let camera = self.dataset.rig.camera(self.dataset.camera);
        let model =
            camera.map(|c| &c.model).filter(|_| self.dataset.calibration != CalibrationSource::Guessed);
        match model.and_then(|m| camera_info(m, header(entry.time, CAMERA))) {
            Some(info) => self.send("/cam0/camera_info", entry.time, &Message::CameraInfo(Box::new(info))),
            None => Ok(()),
        }
    }

    /// Depth as it is stored, in its unit; without distortion in metres where its camera has some.
    fn depth(&mut self, entry: &DepthEntry) -> Result<(), DatasetError> {
        let Some(sensor) = &self.dataset.depth_sensor else { return Ok(()) };
        let at = header(entry.time, DEPTH);
        let stored = self.dataset.media.depth(&entry.location)?;
        let image = match stored {
            StoredDepth::Units(raw) if sensor.distorted.is_none() => {
                let data =
                    raw.data().iter().flat_map(|v| without_invalid(*v, sensor).to_le_bytes()).collect();
                raw_bytes(at, "16UC1", raw.width(), raw.height(), data)
            }
            _ => {
                let metres = self.dataset.load_depth(entry)?;
                let metres = metres.image();
                let data = metres.data().iter().flat_map(|v| v.to_le_bytes()).collect();
                raw_bytes(at, "32FC1", metres.width(), metres.height(), data)
            }
        };
        self.send("/depth0/image_raw", entry.time, &Message::Image(image))?;
        let info = camera_info(&CameraModel::Pinhole(sensor.intrinsics), header(entry.time, DEPTH));
        info.map_or(Ok(()), |info| {
            self.send("/depth0/camera_info", entry.time, &Message::CameraInfo(Box::new(info)))
        })
    }
}

/// Every value that means "no depth" as 0, which readers agree on.
pub(super) fn without_invalid(value: u16, sensor: &DepthSensor) -> u16 {
    if sensor.invalid.contains(&value) { 0 } else { value }
}

fn raw_bytes(header: Header, encoding: &str, width: usize, height: usize, data: Vec<u8>) -> RawImage {
    let row_bytes = data.len().checked_div(height).unwrap_or(0) as u32;
    let (width, height, encoding) = (width as u32, height as u32, encoding.to_string());
    RawImage { header, width, height, encoding, row_bytes, is_big_endian: false, data }
}

fn raw_image(header: Header, image: &FrameImage) -> RawImage {
    let (width, height) = (image.width(), image.height());
    let (encoding, data) = match image {
        FrameImage::Gray8(i) => ("mono8", i.data().to_vec()),
        FrameImage::Gray16(i) => ("mono16", i.data().iter().flat_map(|v| v.to_le_bytes()).collect()),
        FrameImage::Rgb8(i) => ("rgb8", i.data().iter().flatten().copied().collect()),
    };
    raw_bytes(header, encoding, width, height, data)
}

/// The calibration as ROS states it; `None` for models that it does not know.
fn camera_info(model: &CameraModel, header: Header) -> Option<CameraInfo> {
    let Pinhole { fx, fy, cx, cy, width, height, .. } = *model.intrinsics();
    let parameters = model.parameters();
    let rest = parameters.get(4..).unwrap_or_default();
    let (distortion_model, distortion) = match model {
        CameraModel::Pinhole(_) => ("plumb_bob", vec![0.0; 5]),
        CameraModel::RadTan(_) => {
            // k1, k2, p1, p2, and k3 where it is not zero.
            let mut five = rest.to_vec();
            five.resize(5, 0.0);
            ("plumb_bob", five)
        }
        CameraModel::Equidistant(_) => ("equidistant", rest.to_vec()),
        CameraModel::DoubleSphere(_) | CameraModel::Fov(_) => return None,
    };
    Some(CameraInfo {
        header,
        width: width as u32,
        height: height as u32,
        distortion_model: distortion_model.into(),
        distortion,
        k: [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p: [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    })
}
