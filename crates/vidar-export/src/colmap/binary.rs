//! COLMAP's binary files: little-endian, counts of 64 bits.

use super::{CAMERAS, IMAGES, POINTS, RawCamera, RawImage, TrackEntries, color_of, unsupported_model};
use crate::bytes::Cursor;
use crate::error::{ExportError, quoted, write_error};
use std::io::{self, Write};
use vidar_core::PointCloud;

const SIMPLE_PINHOLE: i32 = 0;
const PINHOLE: i32 = 1;
/// COLMAP's numbers of its other models, for the message that refuses them.
const OTHER_MODELS: [&str; 9] = [
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "OPENCV_FISHEYE",
    "FULL_OPENCV",
    "FOV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
];

/// Bytes of a camera with the fewest parameters (3).
const LEAST_CAMERA: usize = 4 + 4 + 8 + 8 + 3 * 8;
/// Bytes of an image with an empty name and no observations.
const LEAST_IMAGE: usize = 4 + 7 * 8 + 4 + 1 + 8;
const OBSERVATION: usize = 8 + 8 + 8;
/// Bytes of a point with an empty track.
const LEAST_POINT: usize = 8 + 3 * 8 + 3 + 8 + 8;
const TRACK_ENTRY: usize = 4 + 4;

pub(super) fn write_cameras(w: &mut dyn Write, cameras: &[RawCamera]) -> Result<(), ExportError> {
    let mut write = || -> io::Result<()> {
        w.write_all(&(cameras.len() as u64).to_le_bytes())?;
        for c in cameras {
            w.write_all(&c.id.to_le_bytes())?;
            w.write_all(&PINHOLE.to_le_bytes())?;
            w.write_all(&c.width.to_le_bytes())?;
            w.write_all(&c.height.to_le_bytes())?;
            write_reals(w, &[c.focal.0, c.focal.1, c.principal_point.0, c.principal_point.1])?;
        }
        Ok(())
    };
    write().map_err(write_error(CAMERAS))
}

pub(super) fn write_images(w: &mut dyn Write, images: &[RawImage]) -> Result<(), ExportError> {
    let mut write = || -> io::Result<()> {
        w.write_all(&(images.len() as u64).to_le_bytes())?;
        for image in images {
            w.write_all(&image.id.to_le_bytes())?;
            write_reals(w, &image.rotation_wxyz)?;
            write_reals(w, &image.translation)?;
            w.write_all(&image.camera_id.to_le_bytes())?;
            w.write_all(image.name.as_bytes())?;
            w.write_all(&[0])?;
            w.write_all(&(image.observations.len() as u64).to_le_bytes())?;
            for (pixel, point) in &image.observations {
                write_reals(w, pixel)?;
                w.write_all(&point.to_le_bytes())?;
            }
        }
        Ok(())
    };
    write().map_err(write_error(IMAGES))
}

pub(super) fn write_points(
    w: &mut dyn Write,
    points: &PointCloud,
    tracks: &[TrackEntries],
) -> Result<(), ExportError> {
    let mut write = || -> io::Result<()> {
        w.write_all(&(points.len() as u64).to_le_bytes())?;
        for (i, position) in points.positions.iter().enumerate() {
            w.write_all(&(i as u64 + 1).to_le_bytes())?;
            write_reals(w, &position.map(f64::from))?;
            w.write_all(&color_of(points, i))?;
            write_reals(w, &[-1.0])?;
            let track = tracks.get(i).map_or(&[][..], Vec::as_slice);
            w.write_all(&(track.len() as u64).to_le_bytes())?;
            for (image, index) in track {
                w.write_all(&image.to_le_bytes())?;
                w.write_all(&index.to_le_bytes())?;
            }
        }
        Ok(())
    };
    write().map_err(write_error(POINTS))
}

fn write_reals(w: &mut dyn Write, values: &[f64]) -> io::Result<()> {
    for value in values {
        w.write_all(&value.to_le_bytes())?;
    }
    Ok(())
}

pub(super) fn read_cameras(bytes: &[u8]) -> Result<Vec<RawCamera>, ExportError> {
    let mut cursor = Cursor::new(CAMERAS, bytes);
    let count = cursor.count(LEAST_CAMERA, "number of cameras")?;
    let mut cameras = Vec::with_capacity(count);
    for index in 0..count {
        let what = format!("camera {index}");
        let id = cursor.u32(&what)?;
        let model = cursor.i32(&what)?;
        let (width, height) = (cursor.u64(&what)?, cursor.u64(&what)?);
        let focal = match model {
            PINHOLE => (cursor.finite(&what)?, cursor.finite(&what)?),
            SIMPLE_PINHOLE => {
                let f = cursor.finite(&what)?;
                (f, f)
            }
            other => {
                let known = other
                    .checked_sub(2)
                    .and_then(|i| usize::try_from(i).ok())
                    .and_then(|i| OTHER_MODELS.get(i));
                let name = known.map_or_else(|| format!("number {other}"), |name| (*name).to_owned());
                return Err(unsupported_model(what, &name));
            }
        };
        let principal_point = (cursor.finite(&what)?, cursor.finite(&what)?);
        cameras.push(RawCamera { id, width, height, focal, principal_point });
    }
    cursor.end()?;
    Ok(cameras)
}

pub(super) fn read_images(bytes: &[u8]) -> Result<Vec<RawImage>, ExportError> {
    let mut cursor = Cursor::new(IMAGES, bytes);
    let count = cursor.count(LEAST_IMAGE, "number of images")?;
    let mut images = Vec::with_capacity(count);
    for index in 0..count {
        let what = format!("image {index}");
        let id = cursor.u32(&what)?;
        let (mut rotation_wxyz, mut translation) = ([0.0; 4], [0.0; 3]);
        for slot in rotation_wxyz.iter_mut().chain(&mut translation) {
            *slot = cursor.finite(&what)?;
        }
        let camera_id = cursor.u32(&what)?;
        let name = cursor.c_string(&what)?;
        if name.is_empty() {
            return Err(cursor.error(&what, "an image name", quoted(name)));
        }
        let observations = cursor.count(OBSERVATION, &what)?;
        cursor.take(observations * OBSERVATION, &what)?;
        images.push(RawImage {
            id,
            rotation_wxyz,
            translation,
            camera_id,
            name: name.to_owned(),
            observations: Vec::new(),
        });
    }
    cursor.end()?;
    Ok(images)
}

pub(super) fn read_points(bytes: &[u8]) -> Result<PointCloud, ExportError> {
    let mut cursor = Cursor::new(POINTS, bytes);
    let count = cursor.count(LEAST_POINT, "number of points")?;
    let mut points = PointCloud {
        positions: Vec::with_capacity(count),
        colors: Vec::with_capacity(count),
        ..PointCloud::default()
    };
    // One text for all points: building one for each would cost more than reading it.
    let what = "a point";
    for _ in 0..count {
        cursor.u64(what)?;
        let mut position = [0.0; 3];
        for slot in &mut position {
            *slot = cursor.finite(what)? as f32;
        }
        if !position.iter().all(|v: &f32| v.is_finite()) {
            return Err(cursor.error(what, "a position within 32-bit floats", format!("{position:?}")));
        }
        points.positions.push(position);
        points.colors.push([cursor.u8(what)?, cursor.u8(what)?, cursor.u8(what)?]);
        cursor.finite(what)?;
        let track = cursor.count(TRACK_ENTRY, what)?;
        cursor.take(track * TRACK_ENTRY, what)?;
    }
    cursor.end()?;
    Ok(points)
}
