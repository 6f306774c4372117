//! Messages as JSON: Foxglove's schemas, and IMU samples with the field names of ROS. Bytes are base64.

use super::{
    CameraInfo, CompressedImage, FramePose, FrameTransform, Header, ImuMessage, Message, Pose, RawImage,
    stamp,
};
use base64::Engine;
use serde_json::Value;

type Read<T> = Result<T, String>;

pub(super) fn decode(message_type: &str, bytes: &[u8]) -> Read<Message> {
    // The parser bounds its own recursion at 128 levels.
    let value: Value = serde_json::from_slice(bytes).map_err(|e| format!("no JSON: {e}"))?;
    let v = &value;
    Ok(match message_type {
        "foxglove.RawImage" => Message::Image(RawImage {
            header: header(v),
            width: whole(v, "width")?,
            height: whole(v, "height")?,
            encoding: text(v, "encoding"),
            row_bytes: whole(v, "step")?,
            is_big_endian: false,
            data: data(v)?,
        }),
        "foxglove.CompressedImage" => Message::CompressedImage(compressed(v)?),
        "foxglove.CompressedVideo" => Message::CompressedVideo(compressed(v)?),
        "foxglove.CameraCalibration" => Message::CameraInfo(Box::new(CameraInfo {
            header: header(v),
            width: whole(v, "width")?,
            height: whole(v, "height")?,
            distortion_model: text(v, "distortion_model"),
            distortion: numbers(v, "D")?,
            k: fixed(numbers(v, "K")?, "K")?,
            r: fixed(numbers(v, "R")?, "R").unwrap_or([1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
            p: fixed(numbers(v, "P")?, "P").unwrap_or_default(),
        })),
        "foxglove.FrameTransform" => Message::Transforms(vec![transform(v)?]),
        "foxglove.FrameTransforms" => {
            Message::Transforms(list(v, "transforms").iter().map(transform).collect::<Read<_>>()?)
        }
        "foxglove.PoseInFrame" => {
            let pose = pose(v.get("pose").unwrap_or(&Value::Null), "position", "orientation")?;
            Message::Poses(vec![FramePose { header: header(v), child: String::new(), pose }])
        }
        "foxglove.PosesInFrame" => {
            let one = |v: &Value, p: &Value| {
                let pose = pose(p, "position", "orientation")?;
                Ok(FramePose { header: header(v), child: String::new(), pose })
            };
            Message::Poses(list(v, "poses").iter().map(|p| one(v, p)).collect::<Read<_>>()?)
        }
        "sensor_msgs/Imu" => Message::Imu(ImuMessage {
            header: header(v.get("header").unwrap_or(&Value::Null)),
            angular_velocity: vector(v.get("angular_velocity"), ["x", "y", "z"], "angular_velocity")?,
            linear_acceleration: vector(
                v.get("linear_acceleration"),
                ["x", "y", "z"],
                "linear_acceleration",
            )?,
        }),
        _ => return Err("messages of this type are not read from JSON".into()),
    })
}

fn compressed(v: &Value) -> Read<CompressedImage> {
    Ok(CompressedImage { header: header(v), format: text(v, "format"), data: data(v)? })
}

fn header(v: &Value) -> Header {
    let time = v.get("timestamp").or_else(|| v.get("stamp")).unwrap_or(&Value::Null);
    let part = |names: [&str; 2]| names.iter().find_map(|n| time.get(n)?.as_i64()).unwrap_or(0);
    let frame = v.get("frame_id").or_else(|| v.get("parent_frame_id")).and_then(Value::as_str);
    Header {
        stamp: stamp(part(["sec", "secs"]), part(["nsec", "nanosec"])),
        frame: frame.unwrap_or_default().to_string(),
    }
}

fn text(v: &Value, name: &str) -> String {
    v.get(name).and_then(Value::as_str).unwrap_or_default().to_string()
}

fn whole(v: &Value, name: &str) -> Read<u32> {
    let number = v.get(name).and_then(Value::as_u64).and_then(|n| u32::try_from(n).ok());
    number.ok_or_else(|| format!("no whole number {name:?}"))
}

fn data(v: &Value) -> Read<Vec<u8>> {
    let text = v.get("data").and_then(Value::as_str).ok_or("no text \"data\"")?;
    base64::engine::general_purpose::STANDARD.decode(text).map_err(|e| format!("\"data\" is no base64: {e}"))
}

fn list<'a>(v: &'a Value, name: &str) -> &'a [Value] {
    v.get(name).and_then(Value::as_array).map_or(&[], Vec::as_slice)
}

fn numbers(v: &Value, name: &str) -> Read<Vec<f64>> {
    list(v, name)
        .iter()
        .map(|n| n.as_f64().ok_or_else(|| format!("{name} holds what is no number")))
        .collect()
}

fn fixed<const N: usize>(list: Vec<f64>, what: &str) -> Read<[f64; N]> {
    let found = list.len();
    list.try_into().map_err(|_| format!("{what} has {found} numbers instead of {N}"))
}

fn vector<const N: usize>(v: Option<&Value>, names: [&str; N], what: &str) -> Read<[f64; N]> {
    let mut values = [0.0; N];
    for (value, name) in values.iter_mut().zip(names) {
        let number = v.and_then(|v| v.get(name)).and_then(Value::as_f64);
        *value = number.ok_or_else(|| format!("no number {what}.{name}"))?;
    }
    Ok(values)
}

fn pose(v: &Value, position: &str, orientation: &str) -> Read<Pose> {
    Ok(Pose {
        position: vector(v.get(position), ["x", "y", "z"], position)?,
        orientation: vector(v.get(orientation), ["x", "y", "z", "w"], orientation)?,
    })
}

fn transform(v: &Value) -> Read<FrameTransform> {
    Ok(FrameTransform {
        parent: header(v),
        child: text(v, "child_frame_id"),
        pose: pose(v, "translation", "rotation")?,
    })
}
