//! Messages of the types that a map needs, decoded from any of the encodings.

mod json;
mod pixels;
mod protobuf;
mod ros;

pub use pixels::Pixels;

use crate::index::Encoding;
use vidar_core::Timestamp;

/// A decoded message.
#[derive(Clone, Debug, PartialEq)]
pub enum Message {
    /// `sensor_msgs/Image`, `foxglove.RawImage`.
    Image(RawImage),
    /// `sensor_msgs/CompressedImage`, `foxglove.CompressedImage`.
    CompressedImage(CompressedImage),
    /// `foxglove.CompressedVideo`: one access unit of a video.
    CompressedVideo(CompressedImage),
    /// `sensor_msgs/Imu`.
    Imu(ImuMessage),
    /// `sensor_msgs/CameraInfo`, `foxglove.CameraCalibration`.
    CameraInfo(Box<CameraInfo>),
    /// `tf2_msgs/TFMessage`, `geometry_msgs/TransformStamped`, `foxglove.FrameTransform(s)`.
    Transforms(Vec<FrameTransform>),
    /// `nav_msgs/Odometry`, `geometry_msgs/PoseStamped`, `PoseWithCovarianceStamped`, `nav_msgs/Path`, `foxglove.PoseInFrame`,
    /// `foxglove.PosesInFrame`.
    Poses(Vec<FramePose>),
}

/// Stamp and frame of a message.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Header {
    /// When it was measured, in the sensor's clock; zero where the writer left it out.
    pub stamp: Timestamp,
    /// Name of the frame in which it is expressed.
    pub frame: String,
}

/// An image without compression.
#[derive(Clone, Debug, PartialEq)]
pub struct RawImage {
    /// Stamp, and the camera's frame.
    pub header: Header,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Name of the pixel format, such as `mono8` or `bayer_rggb8`.
    pub encoding: String,
    /// Bytes from one row to the next.
    pub row_bytes: u32,
    /// Whether pixels of 16 bits have the high byte first.
    pub is_big_endian: bool,
    /// The rows.
    pub data: Vec<u8>,
}

/// An image as a file format keeps it.
#[derive(Clone, Debug, PartialEq)]
pub struct CompressedImage {
    /// Stamp, and the camera's frame.
    pub header: Header,
    /// Name of the format, such as `jpeg`, `png`, `16UC1; compressedDepth png`, `h264`.
    pub format: String,
    /// The bytes of the file.
    pub data: Vec<u8>,
}

/// A sample of an IMU, in its own frame.
#[derive(Clone, Debug, PartialEq)]
pub struct ImuMessage {
    /// Stamp, and the IMU's frame.
    pub header: Header,
    /// rad/s.
    pub angular_velocity: [f64; 3],
    /// m/s².
    pub linear_acceleration: [f64; 3],
}

/// A camera's calibration.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraInfo {
    /// Stamp, and the camera's frame.
    pub header: Header,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Name of the distortion, such as `plumb_bob`.
    pub distortion_model: String,
    /// Its parameters.
    pub distortion: Vec<f64>,
    /// Intrinsics of the raw image, row by row.
    pub k: [f64; 9],
    /// Rotation from the camera to the rectified camera, row by row.
    pub r: [f64; 9],
    /// Projection of the rectified image, row by row.
    pub p: [f64; 12],
}

/// The pose of frame `child` in frame `parent`: maps points in the child to the parent.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameTransform {
    /// Stamp, and the parent's frame.
    pub parent: Header,
    /// The child's frame.
    pub child: String,
    /// The pose.
    pub pose: Pose,
}

/// A pose of some body.
#[derive(Clone, Debug, PartialEq)]
pub struct FramePose {
    /// Stamp, and the frame in which the pose is expressed.
    pub header: Header,
    /// The body's frame; empty where the message does not say it.
    pub child: String,
    /// The pose.
    pub pose: Pose,
}

/// Position and orientation as a message states them; the quaternion may be anything.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Pose {
    /// m.
    pub position: [f64; 3],
    /// x, y, z, w.
    pub orientation: [f64; 4],
}

/// What a topic's messages can be used as.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// Images, raw or compressed.
    Image,
    /// Access units of a video.
    Video,
    /// Samples of gyroscope and accelerometer.
    Imu,
    /// A camera's calibration.
    CameraInfo,
    /// Poses of frames in other frames.
    Transforms,
    /// Poses of a body.
    Poses,
}

/// What the messages of a type can be used as; `None` for types that are not read.
pub fn role_of(message_type: &str, encoding: Encoding) -> Option<Role> {
    if encoding == Encoding::Other {
        return None;
    }
    Some(match message_type {
        "sensor_msgs/Image" | "sensor_msgs/CompressedImage" => Role::Image,
        "foxglove.RawImage" | "foxglove_msgs/RawImage" => Role::Image,
        "foxglove.CompressedImage" | "foxglove_msgs/CompressedImage" => Role::Image,
        "foxglove.CompressedVideo" | "foxglove_msgs/CompressedVideo" => Role::Video,
        "sensor_msgs/Imu" => Role::Imu,
        "sensor_msgs/CameraInfo" | "foxglove.CameraCalibration" | "foxglove_msgs/CameraCalibration" => {
            Role::CameraInfo
        }
        "tf2_msgs/TFMessage" | "tf/tfMessage" | "foxglove.FrameTransforms" | "foxglove.FrameTransform" => {
            Role::Transforms
        }
        "geometry_msgs/TransformStamped" => Role::Transforms,
        "nav_msgs/Odometry" | "nav_msgs/Path" => Role::Poses,
        "geometry_msgs/PoseStamped" | "geometry_msgs/PoseWithCovarianceStamped" => Role::Poses,
        "foxglove.PoseInFrame" | "foxglove.PosesInFrame" => Role::Poses,
        _ => return None,
    })
}

/// Decodes a message; the error is the reason as text.
pub fn decode(message_type: &str, encoding: Encoding, bytes: &[u8]) -> Result<Message, String> {
    match encoding {
        Encoding::Ros1 => ros::decode(ros::Wire::ros1(bytes), message_type),
        Encoding::Cdr => ros::decode(ros::Wire::cdr(bytes)?, message_type),
        Encoding::Protobuf => protobuf::decode(message_type, bytes),
        Encoding::Json => json::decode(message_type, bytes),
        Encoding::Other => Err("its encoding is not known".into()),
    }
}

impl Message {
    /// Its stamp and frame; of several transforms or poses the first one's.
    pub fn header(self) -> Header {
        match self {
            Self::Image(m) => m.header,
            Self::CompressedImage(m) | Self::CompressedVideo(m) => m.header,
            Self::Imu(m) => m.header,
            Self::CameraInfo(m) => m.header,
            Self::Transforms(m) => m.into_iter().next().map(|t| t.parent).unwrap_or_default(),
            Self::Poses(m) => m.into_iter().next().map(|p| p.header).unwrap_or_default(),
        }
    }
}

/// Stamp and frame at the beginning of a message of ROS; the error is the reason as text.
pub(crate) fn header(encoding: Encoding, message_type: &str, head: &[u8]) -> Result<Header, String> {
    let mut wire = if encoding == Encoding::Ros1 { ros::Wire::ros1(head) } else { ros::Wire::cdr(head)? };
    // Foxglove's messages begin with time and frame as ROS 2's header does, also in ROS 1.
    if message_type.starts_with("foxglove") { wire.time_and_frame() } else { wire.header() }
}

/// A time of seconds and nanoseconds; what does not fit is as good as no stamp.
fn stamp(secs: i64, nanos: i64) -> Timestamp {
    let total = secs.checked_mul(1_000_000_000).and_then(|s| s.checked_add(nanos)).unwrap_or(0);
    Timestamp::from_nanos(total)
}
