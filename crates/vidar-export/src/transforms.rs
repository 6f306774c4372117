//! nerfstudio's `transforms.json`, also read by brush, instant-ngp and gsplat.
//!
//! - `transform_matrix` is `world_from_camera` with OpenGL camera axes (x right, y up, z back), metres, world z up.
//! - Pixels count from the image's corner: 0.5 is added to the principal point on export, subtracted on import.
//! - `camera_model` is OPENCV with zero distortion, which every reader supports. Equal intrinsics are written once at the
//!   top, others in each frame.
//! - `applied_transform` is the identity: the world is neither re-centred, rotated nor rescaled.
//! - `frame_id` and `timestamp_ns` in each frame are VIDAR's; other readers ignore them.
//! - NaN is refused in both directions (JSON has none).

use crate::axes::opencv_to_opengl_camera;
use crate::error::{ExportError, write_error};
use crate::view::{
    ExportView, ImportedView, check_views, corner_origin_principal_point, pinhole_from_corner_origin,
};
use nalgebra::Matrix4;
use serde::Deserialize;
use serde_json::{Map, Value, json};
use std::io::{self, Write};
use vidar_core::{FrameId, Pinhole, Se3, Timestamp};

const FORMAT: &str = "transforms.json";

/// Upper three rows of a homogeneous matrix that changes nothing.
const IDENTITY_3X4: [[f64; 4]; 3] = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];

/// Largest difference from a fixed entry (0, 1) that is still rounding of printed digits.
const ENTRY_TOLERANCE: f64 = 1e-6;

/// The supported content of a `transforms.json`.
#[derive(Clone, Debug, PartialEq)]
pub struct Transforms {
    /// The posed images, in the order of the file, in the file's world.
    pub views: Vec<ImportedView>,
    /// The cloud to start a radiance field from, relative to the file.
    pub ply_path: Option<String>,
    /// Transform of the original world before the file was written; VIDAR writes the identity.
    pub applied_transform: [[f64; 4]; 3],
}

/// The document, as far as it is read; other keys are ignored.
#[derive(Debug, Deserialize)]
struct RawFile {
    camera_model: Option<String>,
    #[serde(flatten)]
    intrinsics: RawIntrinsics,
    ply_file_path: Option<String>,
    applied_transform: Option<Vec<[f64; 4]>>,
    frames: Vec<RawFrame>,
}

#[derive(Debug, Deserialize)]
struct RawFrame {
    file_path: String,
    transform_matrix: [[f64; 4]; 4],
    camera_model: Option<String>,
    #[serde(flatten)]
    intrinsics: RawIntrinsics,
    frame_id: Option<FrameId>,
    timestamp_ns: Option<Timestamp>,
}

/// Camera parameters as the file spells them, at the top or in a frame.
#[derive(Clone, Copy, Debug, Default, Deserialize)]
struct RawIntrinsics {
    fl_x: Option<f64>,
    fl_y: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    w: Option<f64>,
    h: Option<f64>,
    k1: Option<f64>,
    k2: Option<f64>,
    k3: Option<f64>,
    k4: Option<f64>,
    p1: Option<f64>,
    p2: Option<f64>,
}

/// Writes the views; image names are relative to the file (usually `images/…` for nerfstudio), and so is `ply_path`.
pub fn write_transforms_json(
    mut w: impl Write,
    views: &[ExportView],
    ply_path: Option<&str>,
) -> Result<(), ExportError> {
    check_views(FORMAT, views)?;
    let shared = shared_intrinsics(views);
    let mut file = Map::new();
    file.insert("camera_model".to_owned(), json!("OPENCV"));
    if let Some(intrinsics) = shared {
        insert_intrinsics(&mut file, &intrinsics);
    }
    file.insert("applied_transform".to_owned(), json!(IDENTITY_3X4));
    if let Some(path) = ply_path {
        file.insert("ply_file_path".to_owned(), json!(path));
    }
    let frames: Vec<Value> = views.iter().map(|view| frame(view, shared.is_none())).collect();
    file.insert("frames".to_owned(), Value::Array(frames));
    serde_json::to_writer_pretty(&mut w, &file)
        .map_err(io::Error::from)
        .and_then(|()| writeln!(w))
        .and_then(|()| w.flush())
        .map_err(write_error(FORMAT))
}

fn shared_intrinsics(views: &[ExportView]) -> Option<Pinhole> {
    let first = views.first()?.intrinsics;
    views.iter().all(|view| view.intrinsics == first).then_some(first)
}

fn insert_intrinsics(map: &mut Map<String, Value>, intrinsics: &Pinhole) {
    let (cx, cy) = corner_origin_principal_point(intrinsics);
    for (key, value) in [("fl_x", intrinsics.fx), ("fl_y", intrinsics.fy), ("cx", cx), ("cy", cy)] {
        map.insert(key.to_owned(), json!(value));
    }
    for (key, value) in [("w", intrinsics.width), ("h", intrinsics.height)] {
        map.insert(key.to_owned(), json!(value));
    }
    for key in ["k1", "k2", "p1", "p2"] {
        map.insert(key.to_owned(), json!(0.0));
    }
}

fn frame(view: &ExportView, own_intrinsics: bool) -> Value {
    let mut frame = Map::new();
    frame.insert("file_path".to_owned(), json!(view.image_name));
    let matrix = opencv_to_opengl_camera(view.world_from_camera.matrix());
    let rows: Vec<Vec<f64>> =
        (0..4).map(|row| (0..4).map(|column| matrix[(row, column)]).collect()).collect();
    frame.insert("transform_matrix".to_owned(), json!(rows));
    if own_intrinsics {
        insert_intrinsics(&mut frame, &view.intrinsics);
    }
    frame.insert("frame_id".to_owned(), json!(view.frame_id));
    frame.insert("timestamp_ns".to_owned(), json!(view.time));
    Value::Object(frame)
}

/// Reads a `transforms.json` of undistorted pinhole images; intrinsics at the top or in each frame.
///
/// Poses are those of the file: an `applied_transform` is returned, not undone. Errors: distortion, fisheye models,
/// missing intrinsics, matrices that are no rigid motions.
pub fn read_transforms_json(bytes: &[u8]) -> Result<Transforms, ExportError> {
    let file: RawFile = crate::json::parse(FORMAT, bytes)?;
    check_model(file.camera_model.as_deref(), "top level")?;
    let views = file
        .frames
        .into_iter()
        .enumerate()
        .map(|(index, frame)| imported(index, frame, &file.intrinsics))
        .collect::<Result<_, _>>()?;
    Ok(Transforms {
        views,
        ply_path: file.ply_file_path,
        applied_transform: applied_transform(file.applied_transform)?,
    })
}

fn check_model(model: Option<&str>, place: &str) -> Result<(), ExportError> {
    match model {
        None | Some("OPENCV" | "PINHOLE" | "SIMPLE_PINHOLE" | "SIMPLE_RADIAL" | "RADIAL") => Ok(()),
        Some(other) => Err(unsupported(place, format!("camera model {}", crate::error::quoted(other)))),
    }
}

fn unsupported(place: &str, feature: String) -> ExportError {
    let hint = "undistort the images first, so that the camera is a pinhole";
    ExportError::Unsupported { format: FORMAT, place: place.to_owned(), feature, hint }
}

fn imported(index: usize, frame: RawFrame, shared: &RawIntrinsics) -> Result<ImportedView, ExportError> {
    let place = format!("frames[{index}]");
    check_model(frame.camera_model.as_deref(), &place)?;
    let bad = |expected: &str, found: String| ExportError::malformed(FORMAT, place.clone(), expected, found);
    if frame.file_path.is_empty() {
        return Err(bad("a file_path", "none".to_owned()));
    }
    let rows = frame.transform_matrix;
    let matrix = opencv_to_opengl_camera(Matrix4::from_fn(|row, column| rows[row][column]));
    let last_row_is_fixed =
        rows[3].iter().zip([0.0, 0.0, 0.0, 1.0]).all(|(v, fixed)| (v - fixed).abs() < ENTRY_TOLERANCE);
    let world_from_camera = Se3::from_matrix(&matrix)
        .filter(|_| last_row_is_fixed)
        .ok_or_else(|| bad("a rigid transform_matrix", format!("{rows:?}")))?;
    Ok(ImportedView {
        frame_id: frame.frame_id,
        time: frame.timestamp_ns,
        image_name: frame.file_path,
        world_from_camera,
        intrinsics: pinhole(&frame.intrinsics, shared, &place)?,
    })
}

/// A frame's own parameters where it has them, else those at the top.
fn pinhole(own: &RawIntrinsics, shared: &RawIntrinsics, place: &str) -> Result<Pinhole, ExportError> {
    let missing =
        |key: &str| ExportError::malformed(FORMAT, place, format!("{key} here or at the top"), "none");
    let either = |own: Option<f64>, shared: Option<f64>, key| own.or(shared).ok_or_else(|| missing(key));
    let distortion = [
        (own.k1, shared.k1, "k1"),
        (own.k2, shared.k2, "k2"),
        (own.k3, shared.k3, "k3"),
        (own.k4, shared.k4, "k4"),
        (own.p1, shared.p1, "p1"),
        (own.p2, shared.p2, "p2"),
    ];
    for (own, shared, key) in distortion {
        let value = own.or(shared).unwrap_or(0.0);
        if value != 0.0 {
            return Err(unsupported(place, format!("distortion {key} = {value}")));
        }
    }
    let fx = either(own.fl_x, shared.fl_x, "fl_x")?;
    // fl_x without fl_y means square pixels.
    let fy = own.fl_y.or(own.fl_x).or(shared.fl_y).unwrap_or(fx);
    let (cx, cy) = (either(own.cx, shared.cx, "cx")?, either(own.cy, shared.cy, "cy")?);
    let side = |value: f64, key: &str| {
        // Some tools write sizes as 640.0.
        if value.fract() == 0.0 && (1.0..=65_535.0).contains(&value) {
            Ok(value as usize)
        } else {
            Err(ExportError::malformed(
                FORMAT,
                place,
                format!("{key} a whole number of pixels"),
                value.to_string(),
            ))
        }
    };
    let (width, height) =
        (side(either(own.w, shared.w, "w")?, "w")?, side(either(own.h, shared.h, "h")?, "h")?);
    pinhole_from_corner_origin((fx, fy), (cx, cy), (width, height))
        .map_err(|error| ExportError::malformed(FORMAT, place, "a pinhole camera", error.to_string()))
}

/// Three rows, or four with the last fixed; the identity when absent.
fn applied_transform(rows: Option<Vec<[f64; 4]>>) -> Result<[[f64; 4]; 3], ExportError> {
    match rows.as_deref() {
        None => Ok(IDENTITY_3X4),
        Some([a, b, c] | [a, b, c, [0.0, 0.0, 0.0, 1.0]]) => Ok([*a, *b, *c]),
        Some(other) => Err(ExportError::malformed(
            FORMAT,
            "applied_transform",
            "a 3x4 matrix",
            format!("{} rows", other.len()),
        )),
    }
}
