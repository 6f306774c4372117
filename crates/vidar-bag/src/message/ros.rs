//! Messages of ROS 1 and ROS 2: the same fields in the same order, packed differently.
//!
//! ROS 1 packs little-endian without padding. ROS 2 aligns every number to its own size, counted from behind the four bytes of
//! encapsulation (OMG DDSI-RTPS 2.5, 10.2; XTypes 1.3, 7.4), and ends a string with a zero that its length counts.

use super::{
    CameraInfo, CompressedImage, FramePose, FrameTransform, Header, ImuMessage, Message, Pose, RawImage,
    stamp,
};

/// How numbers lie in the bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Packing {
    Ros1,
    Cdr { is_big_endian: bool, largest_alignment: usize },
}

/// A position in a message. Every read fails where the bytes end before the value does.
pub(super) struct Wire<'a> {
    bytes: &'a [u8],
    at: usize,
    packing: Packing,
}

type Read<T> = Result<T, String>;

impl<'a> Wire<'a> {
    pub(super) fn ros1(bytes: &'a [u8]) -> Self {
        Self { bytes, at: 0, packing: Packing::Ros1 }
    }

    pub(super) fn cdr(bytes: &'a [u8]) -> Read<Self> {
        let head = bytes.get(..4).ok_or("no encapsulation header: fewer than 4 bytes")?;
        let (is_big_endian, largest_alignment) = match [head[0], head[1]] {
            [0, 0] => (true, 8),
            [0, 1] => (false, 8),
            [0, 6] => (true, 4),
            [0, 7] => (false, 4),
            other => {
                return Err(format!(
                    "encapsulation {other:02x?}; plain CDR (00 00, 00 01, 00 06, 00 07) is read"
                ));
            }
        };
        let packing = Packing::Cdr { is_big_endian, largest_alignment };
        Ok(Self { bytes: &bytes[4..], at: 0, packing })
    }

    fn take(&mut self, length: usize, what: &str) -> Read<&'a [u8]> {
        let taken = self.at.checked_add(length).and_then(|end| self.bytes.get(self.at..end));
        let taken = taken.ok_or_else(|| {
            format!("it ends at byte {} inside {what} ({length} bytes at byte {})", self.bytes.len(), self.at)
        })?;
        self.at += length;
        Ok(taken)
    }

    /// A number of `N` bytes, little-endian, after its padding.
    fn number<const N: usize>(&mut self, what: &str) -> Read<[u8; N]> {
        if let Packing::Cdr { largest_alignment, .. } = self.packing {
            let alignment = N.min(largest_alignment);
            self.at = self.at.next_multiple_of(alignment);
        }
        let mut number = [0; N];
        number.copy_from_slice(self.take(N, what)?);
        if matches!(self.packing, Packing::Cdr { is_big_endian: true, .. }) {
            number.reverse();
        }
        Ok(number)
    }

    fn u8(&mut self, what: &str) -> Read<u8> {
        self.take(1, what).map(|b| b[0])
    }

    fn u32(&mut self, what: &str) -> Read<u32> {
        self.number(what).map(u32::from_le_bytes)
    }

    fn f64(&mut self, what: &str) -> Read<f64> {
        self.number(what).map(f64::from_le_bytes)
    }

    fn f64s<const N: usize>(&mut self, what: &str) -> Read<[f64; N]> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.f64(what)?;
        }
        Ok(values)
    }

    fn f64_list(&mut self, what: &str) -> Read<Vec<f64>> {
        let count = self.u32(what)? as usize;
        // A count that the rest of the message cannot hold allocates nothing.
        if count > (self.bytes.len() - self.at.min(self.bytes.len())) / 8 {
            return Err(format!("{count} numbers announced for {what}, more than it holds"));
        }
        (0..count).map(|_| self.f64(what)).collect()
    }

    fn byte_list(&mut self, what: &str) -> Read<Vec<u8>> {
        let count = self.u32(what)? as usize;
        self.take(count, what).map(<[u8]>::to_vec)
    }

    fn text(&mut self, what: &str) -> Read<String> {
        let count = self.u32(what)? as usize;
        let bytes = self.take(count, what)?;
        let bytes = match self.packing {
            Packing::Cdr { .. } => bytes.strip_suffix(b"\0").unwrap_or(bytes),
            Packing::Ros1 => bytes,
        };
        Ok(String::from_utf8_lossy(bytes).into_owned())
    }

    fn time(&mut self) -> Read<vidar_core::Timestamp> {
        let secs = self.u32("the seconds of its stamp")?;
        let nanos = self.u32("the nanoseconds of its stamp")?;
        // ROS 1 counts seconds without sign, ROS 2 with one.
        let secs = match self.packing {
            Packing::Ros1 => i64::from(secs),
            Packing::Cdr { .. } => i64::from(secs as i32),
        };
        Ok(stamp(secs, i64::from(nanos)))
    }

    pub(super) fn header(&mut self) -> Read<Header> {
        if self.packing == Packing::Ros1 {
            self.u32("its sequence number")?;
        }
        self.time_and_frame()
    }

    pub(super) fn time_and_frame(&mut self) -> Read<Header> {
        Ok(Header { stamp: self.time()?, frame: self.text("its frame_id")? })
    }

    fn pose(&mut self) -> Read<Pose> {
        Ok(Pose { position: self.f64s("its position")?, orientation: self.f64s("its orientation")? })
    }

    fn transform(&mut self) -> Read<FrameTransform> {
        Ok(FrameTransform {
            parent: self.header()?,
            child: self.text("its child_frame_id")?,
            pose: self.pose()?,
        })
    }

    /// A list of messages that each take at least `smallest` bytes.
    fn list<T>(&mut self, smallest: usize, what: &str, read: impl Fn(&mut Self) -> Read<T>) -> Read<Vec<T>> {
        let count = self.u32(what)? as usize;
        if count > (self.bytes.len() - self.at.min(self.bytes.len())) / smallest {
            return Err(format!("{count} {what} announced, more than it holds"));
        }
        (0..count).map(|_| read(self)).collect()
    }
}

/// Smallest stamped pose or transform: stamp, an empty frame, seven numbers.
const SMALLEST_POSE_BYTES: usize = 8 + 4 + 56;

pub(super) fn decode(mut wire: Wire<'_>, message_type: &str) -> Read<Message> {
    let w = &mut wire;
    Ok(match message_type {
        "sensor_msgs/Image" => Message::Image(image(w)?),
        "sensor_msgs/CompressedImage" => {
            let header = w.header()?;
            Message::CompressedImage(CompressedImage {
                header,
                format: w.text("its format")?,
                data: w.byte_list("its data")?,
            })
        }
        "sensor_msgs/Imu" => {
            let header = w.header()?;
            w.f64s::<13>("its orientation")?;
            let angular_velocity = w.f64s("its angular velocity")?;
            w.f64s::<9>("its covariance")?;
            let linear_acceleration = w.f64s("its linear acceleration")?;
            Message::Imu(ImuMessage { header, angular_velocity, linear_acceleration })
        }
        "sensor_msgs/CameraInfo" => {
            let header = w.header()?;
            let (height, width) = (w.u32("its height")?, w.u32("its width")?);
            Message::CameraInfo(Box::new(CameraInfo {
                header,
                width,
                height,
                distortion_model: w.text("its distortion model")?,
                distortion: w.f64_list("its distortion")?,
                k: w.f64s("K")?,
                r: w.f64s("R")?,
                p: w.f64s("P")?,
            }))
        }
        "tf2_msgs/TFMessage" | "tf/tfMessage" => {
            Message::Transforms(w.list(SMALLEST_POSE_BYTES, "transforms", Wire::transform)?)
        }
        "geometry_msgs/TransformStamped" => Message::Transforms(vec![w.transform()?]),
        "nav_msgs/Odometry" => {
            let (header, child) = (w.header()?, w.text("its child_frame_id")?);
            Message::Poses(vec![FramePose { header, child, pose: w.pose()? }])
        }
        "geometry_msgs/PoseStamped" | "geometry_msgs/PoseWithCovarianceStamped" => {
            Message::Poses(vec![stamped_pose(w)?])
        }
        "nav_msgs/Path" => {
            w.header()?;
            Message::Poses(w.list(SMALLEST_POSE_BYTES, "poses", stamped_pose)?)
        }
        "foxglove_msgs/RawImage" => {
            let (header, width, height) = (w.time_and_frame()?, w.u32("its width")?, w.u32("its height")?);
            let (encoding, row_bytes) = (w.text("its encoding")?, w.u32("its step")?);
            let data = w.byte_list("its data")?;
            Message::Image(RawImage {
                header,
                width,
                height,
                encoding,
                row_bytes,
                is_big_endian: false,
                data,
            })
        }
        "foxglove_msgs/CompressedImage" | "foxglove_msgs/CompressedVideo" => {
            let (header, data) = (w.time_and_frame()?, w.byte_list("its data")?);
            let image = CompressedImage { header, data, format: w.text("its format")? };
            if message_type.ends_with("Video") {
                Message::CompressedVideo(image)
            } else {
                Message::CompressedImage(image)
            }
        }
        _ => return Err("messages of this type are not read".into()),
    })
}

fn image(w: &mut Wire<'_>) -> Read<RawImage> {
    let header = w.header()?;
    let (height, width) = (w.u32("its height")?, w.u32("its width")?);
    let encoding = w.text("its encoding")?;
    let is_big_endian = w.u8("is_bigendian")? != 0;
    let (row_bytes, data) = (w.u32("its step")?, w.byte_list("its data")?);
    Ok(RawImage { header, width, height, encoding, row_bytes, is_big_endian, data })
}

fn stamped_pose(w: &mut Wire<'_>) -> Read<FramePose> {
    Ok(FramePose { header: w.header()?, child: String::new(), pose: w.pose()? })
}
