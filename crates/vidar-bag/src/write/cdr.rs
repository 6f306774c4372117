//! Messages of ROS 2 in CDR, little-endian: each number is aligned to its own size, counted from behind the four bytes of
//! encapsulation, and a string ends with a zero that its length counts (OMG DDSI-RTPS 2.5, 10.2; XTypes 1.3, 7.4).

use crate::message::{CameraInfo, FramePose, FrameTransform, Header, ImuMessage, Message, Pose, RawImage};

/// Bytes of the encapsulation: plain CDR, little-endian.
const ENCAPSULATION: [u8; 4] = [0, 1, 0, 0];

/// A message as bytes, and the name of its type; the error says what does not fit into the format.
///
/// Images, IMU samples, calibrations, transforms and poses are written, poses as `nav_msgs/Odometry`.
pub fn encode(message: &Message) -> Result<(&'static str, Vec<u8>), String> {
    let mut out = Cdr { bytes: ENCAPSULATION.to_vec() };
    let name = match message {
        Message::Image(image) => {
            out.image(image)?;
            "sensor_msgs/msg/Image"
        }
        Message::Imu(sample) => {
            out.imu(sample)?;
            "sensor_msgs/msg/Imu"
        }
        Message::CameraInfo(info) => {
            out.camera_info(info)?;
            "sensor_msgs/msg/CameraInfo"
        }
        Message::Transforms(transforms) => {
            out.count(transforms.len())?;
            transforms.iter().try_for_each(|t| out.transform(t))?;
            "tf2_msgs/msg/TFMessage"
        }
        Message::Poses(poses) => match poses.as_slice() {
            [pose] => {
                out.odometry(pose)?;
                "nav_msgs/msg/Odometry"
            }
            all => return Err(format!("{} poses in one message; one is written", all.len())),
        },
        Message::CompressedImage(_) | Message::CompressedVideo(_) => {
            return Err("compressed images are not written".into());
        }
    };
    Ok((name, out.bytes))
}

struct Cdr {
    bytes: Vec<u8>,
}

impl Cdr {
    fn align(&mut self, to: usize) {
        let at = self.bytes.len() - ENCAPSULATION.len();
        self.bytes.resize(ENCAPSULATION.len() + at.next_multiple_of(to), 0);
    }

    fn u32(&mut self, value: u32) {
        self.align(4);
        self.bytes.extend(value.to_le_bytes());
    }

    fn f64s(&mut self, values: &[f64]) {
        for value in values {
            self.align(8);
            self.bytes.extend(value.to_le_bytes());
        }
    }

    fn count(&mut self, count: usize) -> Result<(), String> {
        self.u32(u32::try_from(count).map_err(|_| format!("a list of {count} elements"))?);
        Ok(())
    }

    fn text(&mut self, text: &str) -> Result<(), String> {
        self.count(text.len() + 1)?;
        self.bytes.extend(text.as_bytes());
        self.bytes.push(0);
        Ok(())
    }

    fn list(&mut self, bytes: &[u8]) -> Result<(), String> {
        self.count(bytes.len())?;
        self.bytes.extend(bytes);
        Ok(())
    }

    fn header(&mut self, header: &Header) -> Result<(), String> {
        let nanos = header.stamp.nanos();
        let secs = i32::try_from(nanos.div_euclid(1_000_000_000))
            .map_err(|_| format!("a stamp of {} s; ROS 2 counts seconds in 32 bits", header.stamp))?;
        self.u32(secs as u32);
        self.u32(nanos.rem_euclid(1_000_000_000) as u32);
        self.text(&header.frame)
    }

    fn image(&mut self, image: &RawImage) -> Result<(), String> {
        self.header(&image.header)?;
        self.u32(image.height);
        self.u32(image.width);
        self.text(&image.encoding)?;
        self.bytes.push(u8::from(image.is_big_endian));
        self.u32(image.row_bytes);
        self.list(&image.data)
    }

    fn imu(&mut self, sample: &ImuMessage) -> Result<(), String> {
        self.header(&sample.header)?;
        // No orientation is measured: the first element of its covariance is -1 (sensor_msgs/Imu).
        self.f64s(&[0.0, 0.0, 0.0, 1.0, -1.0]);
        self.f64s(&[0.0; 8]);
        self.f64s(&sample.angular_velocity);
        self.f64s(&[0.0; 9]);
        self.f64s(&sample.linear_acceleration);
        self.f64s(&[0.0; 9]);
        Ok(())
    }

    fn camera_info(&mut self, info: &CameraInfo) -> Result<(), String> {
        self.header(&info.header)?;
        self.u32(info.height);
        self.u32(info.width);
        self.text(&info.distortion_model)?;
        self.count(info.distortion.len())?;
        self.f64s(&info.distortion);
        self.f64s(&info.k);
        self.f64s(&info.r);
        self.f64s(&info.p);
        // Binning and region of interest: the whole image.
        (0..6).for_each(|_| self.u32(0));
        self.bytes.push(0);
        Ok(())
    }

    fn pose(&mut self, pose: &Pose) {
        self.f64s(&pose.position);
        self.f64s(&pose.orientation);
    }

    fn transform(&mut self, transform: &FrameTransform) -> Result<(), String> {
        self.header(&transform.parent)?;
        self.text(&transform.child)?;
        self.pose(&transform.pose);
        Ok(())
    }

    fn odometry(&mut self, pose: &FramePose) -> Result<(), String> {
        self.header(&pose.header)?;
        self.text(&pose.child)?;
        self.pose(&pose.pose);
        // Covariance of the pose, twist and its covariance: not known.
        self.f64s(&[0.0; 36 + 6 + 36]);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::index::Encoding;
    use crate::message::decode;
    use vidar_core::Timestamp;

    fn header(nanos: i64, frame: &str) -> Header {
        Header { stamp: Timestamp::from_nanos(nanos), frame: frame.into() }
    }

    #[test]
    fn messages_are_read_as_they_were_written() {
        let pose = Pose { position: [0.1, -2.0, 3.5], orientation: [0.0, 0.6, 0.0, 0.8] };
        // Frames of every length, so that what follows is padded in every way; the reader does not know this writer.
        for frame in ["", "a", "ab", "abc", "abcd", "abcde", "abcdef", "abcdefg"] {
            let at = header(1_403_636_579_763_555_584, frame);
            let all = [
                Message::Image(RawImage {
                    header: header(-1, frame),
                    width: 3,
                    height: 2,
                    encoding: "mono16".into(),
                    row_bytes: 6,
                    is_big_endian: false,
                    data: (0..12).collect(),
                }),
                Message::Imu(ImuMessage {
                    header: at.clone(),
                    angular_velocity: [1e-9, 2.0, -3.0],
                    linear_acceleration: [0.1, 9.81, f64::MIN_POSITIVE],
                }),
                Message::CameraInfo(Box::new(CameraInfo {
                    header: at.clone(),
                    width: 752,
                    height: 480,
                    distortion_model: "plumb_bob".into(),
                    distortion: vec![-0.28, 0.07, 2e-4, 1.8e-5, 0.0],
                    k: [458.654, 0.0, 367.215, 0.0, 457.296, 248.375, 0.0, 0.0, 1.0],
                    r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
                    p: [458.654, 0.0, 367.215, 0.0, 0.0, 457.296, 248.375, 0.0, 0.0, 0.0, 1.0, 0.0],
                })),
                Message::Transforms(vec![
                    FrameTransform { parent: at.clone(), child: "cam0".into(), pose };
                    2
                ]),
                Message::Poses(vec![FramePose { header: at.clone(), child: "imu0".into(), pose }]),
            ];
            for message in all {
                let (name, bytes) = encode(&message).unwrap();
                let plain = name.replace("/msg/", "/");
                assert_eq!(decode(&plain, Encoding::Cdr, &bytes).unwrap(), message, "{name} in {frame:?}");
            }
        }
        let late = header(i64::MAX, "x");
        let error = encode(&Message::Poses(vec![FramePose { header: late, child: String::new(), pose }]));
        assert!(error.unwrap_err().contains("32 bits"));
    }
}
