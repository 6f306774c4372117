//! Foxglove's schemas as protocol buffers (<https://protobuf.dev/programming-guides/encoding>,
//! <https://docs.foxglove.dev/docs/visualization/message-schemas/introduction>).

use super::{CameraInfo, CompressedImage, FramePose, FrameTransform, Header, Message, Pose, RawImage, stamp};

/// One field of a message.
#[derive(Clone, Copy)]
enum Field<'a> {
    /// Variable length or fixed, as unsigned.
    Number(u64),
    Bytes(&'a [u8]),
}

type Read<T> = Result<T, String>;

/// Visits every field of a message with its number. Messages are nested four deep at most by the calls below, so there is no
/// recursion to bound.
fn fields<'a>(mut bytes: &'a [u8], mut visit: impl FnMut(u64, Field<'a>) -> Read<()>) -> Read<()> {
    let cut = || "it ends inside a field".to_string();
    while !bytes.is_empty() {
        let key = varint(&mut bytes).ok_or_else(cut)?;
        let field = match key & 7 {
            0 => Field::Number(varint(&mut bytes).ok_or_else(cut)?),
            1 => Field::Number(u64::from_le_bytes(
                *bytes.split_off(..8).ok_or_else(cut)?.first_chunk().ok_or_else(cut)?,
            )),
            5 => {
                let four = bytes.split_off(..4).and_then(|b| b.first_chunk()).ok_or_else(cut)?;
                Field::Number(u64::from(u32::from_le_bytes(*four)))
            }
            2 => {
                let length = usize::try_from(varint(&mut bytes).ok_or_else(cut)?).map_err(|_| cut())?;
                Field::Bytes(bytes.split_off(..length).ok_or_else(cut)?)
            }
            other => return Err(format!("a field of wire type {other}")),
        };
        visit(key >> 3, field)?;
    }
    Ok(())
}

fn varint(bytes: &mut &[u8]) -> Option<u64> {
    let mut value = 0u64;
    for shift in (0..64).step_by(7) {
        let byte = *bytes.split_off_first()?;
        value |= u64::from(byte & 0x7f) << shift;
        if byte & 0x80 == 0 {
            return Some(value);
        }
    }
    None
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// `google.protobuf.Timestamp`.
fn time(bytes: &[u8]) -> Read<vidar_core::Timestamp> {
    let (mut secs, mut nanos) = (0i64, 0i64);
    fields(bytes, |number, field| {
        match (number, field) {
            (1, Field::Number(n)) => secs = n as i64,
            (2, Field::Number(n)) => nanos = n as i64,
            _ => {}
        }
        Ok(())
    })?;
    Ok(stamp(secs, nanos))
}

/// The first `N` fields of a message of numbers (`Vector3`, `Quaternion`).
fn numbers<const N: usize>(bytes: &[u8]) -> Read<[f64; N]> {
    let mut values = [0.0; N];
    fields(bytes, |number, field| {
        if let (Some(value), Field::Number(n)) = (values.get_mut((number as usize).wrapping_sub(1)), field) {
            *value = f64::from_bits(n);
        }
        Ok(())
    })?;
    Ok(values)
}

/// A repeated number, packed or one by one.
fn push_numbers(list: &mut Vec<f64>, field: Field<'_>) {
    match field {
        Field::Number(n) => list.push(f64::from_bits(n)),
        Field::Bytes(bytes) => list.extend(bytes.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b))),
    }
}

fn fixed<const N: usize>(list: &[f64], what: &str) -> Read<[f64; N]> {
    list.try_into().map_err(|_| format!("{what} has {} numbers instead of {N}", list.len()))
}

/// `foxglove.Pose`.
fn pose(bytes: &[u8]) -> Read<Pose> {
    let mut pose = Pose::default();
    fields(bytes, |number, field| {
        match (number, field) {
            (1, Field::Bytes(b)) => pose.position = numbers(b)?,
            (2, Field::Bytes(b)) => pose.orientation = numbers(b)?,
            _ => {}
        }
        Ok(())
    })?;
    Ok(pose)
}

pub(super) fn decode(message_type: &str, bytes: &[u8]) -> Read<Message> {
    Ok(match message_type {
        "foxglove.RawImage" => Message::Image(raw_image(bytes)?),
        "foxglove.CompressedImage" => Message::CompressedImage(compressed(bytes, [4, 2, 3])?),
        "foxglove.CompressedVideo" => Message::CompressedVideo(compressed(bytes, [2, 3, 4])?),
        "foxglove.CameraCalibration" => Message::CameraInfo(Box::new(calibration(bytes)?)),
        "foxglove.FrameTransform" => Message::Transforms(vec![transform(bytes)?]),
        "foxglove.FrameTransforms" => {
            let mut all = Vec::new();
            fields(bytes, |number, field| {
                if let (1, Field::Bytes(b)) = (number, field) {
                    all.push(transform(b)?);
                }
                Ok(())
            })?;
            Message::Transforms(all)
        }
        "foxglove.PoseInFrame" | "foxglove.PosesInFrame" => Message::Poses(poses(bytes)?),
        _ => return Err("messages of this type are not read".into()),
    })
}

fn raw_image(bytes: &[u8]) -> Read<RawImage> {
    let mut image = RawImage {
        header: Header::default(),
        width: 0,
        height: 0,
        encoding: String::new(),
        row_bytes: 0,
        is_big_endian: false,
        data: Vec::new(),
    };
    fields(bytes, |number, field| {
        match (number, field) {
            (1, Field::Bytes(b)) => image.header.stamp = time(b)?,
            (7, Field::Bytes(b)) => image.header.frame = text(b),
            (2, Field::Number(n)) => image.width = n as u32,
            (3, Field::Number(n)) => image.height = n as u32,
            (4, Field::Bytes(b)) => image.encoding = text(b),
            (5, Field::Number(n)) => image.row_bytes = n as u32,
            (6, Field::Bytes(b)) => image.data = b.to_vec(),
            _ => {}
        }
        Ok(())
    })?;
    Ok(image)
}

/// Image or video; `at` holds the numbers of frame, data and format.
fn compressed(bytes: &[u8], at: [u64; 3]) -> Read<CompressedImage> {
    let mut image = CompressedImage { header: Header::default(), format: String::new(), data: Vec::new() };
    fields(bytes, |number, field| {
        let Field::Bytes(b) = field else { return Ok(()) };
        match number {
            1 => image.header.stamp = time(b)?,
            n if n == at[0] => image.header.frame = text(b),
            n if n == at[1] => image.data = b.to_vec(),
            n if n == at[2] => image.format = text(b),
            _ => {}
        }
        Ok(())
    })?;
    Ok(image)
}

fn calibration(bytes: &[u8]) -> Read<CameraInfo> {
    let (mut header, mut size, mut distortion_model) = (Header::default(), [0u32; 2], String::new());
    let (mut d, mut k, mut r, mut p) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    fields(bytes, |number, field| {
        match (number, field) {
            (1, Field::Bytes(b)) => header.stamp = time(b)?,
            (9, Field::Bytes(b)) => header.frame = text(b),
            (2, Field::Number(n)) => size[0] = n as u32,
            (3, Field::Number(n)) => size[1] = n as u32,
            (4, Field::Bytes(b)) => distortion_model = text(b),
            (5, field) => push_numbers(&mut d, field),
            (6, field) => push_numbers(&mut k, field),
            (7, field) => push_numbers(&mut r, field),
            (8, field) => push_numbers(&mut p, field),
            _ => {}
        }
        Ok(())
    })?;
    // R and P may be left out for a camera that is not rectified.
    if r.is_empty() {
        r = vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
    }
    p.resize(if p.is_empty() { 12 } else { p.len() }, 0.0);
    let [width, height] = size;
    let (k, r, p) = (fixed(&k, "K")?, fixed(&r, "R")?, fixed(&p, "P")?);
    Ok(CameraInfo { header, width, height, distortion_model, distortion: d, k, r, p })
}

fn transform(bytes: &[u8]) -> Read<FrameTransform> {
    let (mut parent, mut child, mut pose) = (Header::default(), String::new(), Pose::default());
    fields(bytes, |number, field| {
        let Field::Bytes(b) = field else { return Ok(()) };
        match number {
            1 => parent.stamp = time(b)?,
            2 => parent.frame = text(b),
            3 => child = text(b),
            4 => pose.position = numbers(b)?,
            5 => pose.orientation = numbers(b)?,
            _ => {}
        }
        Ok(())
    })?;
    Ok(FrameTransform { parent, child, pose })
}

fn poses(bytes: &[u8]) -> Read<Vec<FramePose>> {
    let (mut header, mut all) = (Header::default(), Vec::new());
    fields(bytes, |number, field| {
        let Field::Bytes(b) = field else { return Ok(()) };
        match number {
            1 => header.stamp = time(b)?,
            2 => header.frame = text(b),
            3 => all.push(pose(b)?),
            _ => {}
        }
        Ok(())
    })?;
    Ok(all.into_iter().map(|pose| FramePose { header: header.clone(), child: String::new(), pose }).collect())
}
