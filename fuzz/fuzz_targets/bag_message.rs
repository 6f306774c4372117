//! Messages of recordings in every encoding; the first byte picks type and encoding.
#![no_main]

use libfuzzer_sys::fuzz_target;
use vidar_bag::Encoding;
use vidar_bag::message::{Message, decode};

const TYPES: [&str; 16] = [
    "sensor_msgs/Image",
    "sensor_msgs/CompressedImage",
    "sensor_msgs/Imu",
    "sensor_msgs/CameraInfo",
    "tf2_msgs/TFMessage",
    "nav_msgs/Odometry",
    "nav_msgs/Path",
    "geometry_msgs/PoseStamped",
    "geometry_msgs/TransformStamped",
    "foxglove.RawImage",
    "foxglove.CompressedImage",
    "foxglove.CameraCalibration",
    "foxglove.FrameTransforms",
    "foxglove.PoseInFrame",
    "foxglove.PosesInFrame",
    "foxglove_msgs/CompressedVideo",
];

fuzz_target!(|bytes: &[u8]| {
    let Some((selector, bytes)) = bytes.split_first() else { return };
    let encoding =
        [Encoding::Ros1, Encoding::Cdr, Encoding::Protobuf, Encoding::Json][usize::from(selector >> 4 & 3)];
    if let Ok(Message::Image(image)) = decode(TYPES[usize::from(selector & 15)], encoding, bytes)
        && let Ok(pixels) = image.pixels()
    {
        match pixels {
            vidar_bag::Pixels::Image(image) => assert!(image.width() > 0),
            vidar_bag::Pixels::Float(image) => assert!(!image.data().is_empty()),
        }
    }
});
