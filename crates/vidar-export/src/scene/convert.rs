//! Values as Foxglove's messages.

use super::{FORMAT, LogLevel, WORLD};
use crate::error::ExportError;
use crate::patches::{SurfaceChange, SurfacePatch};
use foxglove::Decode;
use foxglove::messages::{
    CameraCalibration, Color, FrameTransform, LinePrimitive, Log, PackedElementField, Point3, PointCloud,
    Pose, Quaternion, RawImage, SceneEntity, SceneEntityDeletion, SceneUpdate, TriangleListPrimitive,
    Vector3, line_primitive, log, packed_element_field::NumericType, scene_entity_deletion,
};
use image::ImageEncoder;
use image::codecs::jpeg::JpegEncoder;
use vidar_core::{CameraModel, Image, LieGroup, Pinhole, Se3, Timestamp, TriangleMesh};

/// Quality of the JPEGs: differences from the original are not seen, at a tenth of its size.
const JPEG_QUALITY: u8 = 85;
/// Depth of a frustum's far plane, m.
const FRUSTUM_M: f64 = 0.15;

/// A time as the format counts it; it has none before 1970.
pub(super) fn clock(time: Timestamp) -> u64 {
    time.nanos().max(0) as u64
}

pub(super) fn stamp(nanos: u64) -> foxglove::messages::Timestamp {
    let sec = u32::try_from(nanos / 1_000_000_000).unwrap_or(u32::MAX);
    foxglove::messages::Timestamp::new(sec, (nanos % 1_000_000_000) as u32)
}

fn vector(v: &nalgebra::Vector3<f64>) -> Vector3 {
    Vector3 { x: v.x, y: v.y, z: v.z }
}

fn quaternion(rotation: &vidar_core::So3) -> Quaternion {
    let [x, y, z, w] = rotation.quaternion_xyzw();
    Quaternion { x, y, z, w }
}

pub(super) fn pose(a_from_b: &Se3) -> Pose {
    Pose { position: Some(vector(&a_from_b.translation)), orientation: Some(quaternion(&a_from_b.rotation)) }
}

pub(super) fn transform(at: u64, child: &str, world_from_child: &Se3) -> FrameTransform {
    FrameTransform {
        timestamp: Some(stamp(at)),
        parent_frame_id: WORLD.into(),
        child_frame_id: child.into(),
        translation: Some(vector(&world_from_child.translation)),
        rotation: Some(quaternion(&world_from_child.rotation)),
    }
}

/// A camera; distortion where the schema has its model (`plumb_bob`, `kannala_brandt`), else the pinhole part alone.
pub(super) fn calibration(at: u64, frame: &str, camera: &CameraModel) -> CameraCalibration {
    let Pinhole { fx, fy, cx, cy, width, height } = *camera.intrinsics();
    let parameters = camera.parameters();
    let terms = &parameters[4.min(parameters.len())..];
    let (distortion_model, d) = match camera {
        CameraModel::RadTan(_) => ("plumb_bob", [terms, &[0.0]].concat()),
        CameraModel::Equidistant(_) => ("kannala_brandt", terms.to_vec()),
        _ => ("", Vec::new()),
    };
    CameraCalibration {
        timestamp: Some(stamp(at)),
        frame_id: frame.into(),
        width: width as u32,
        height: height as u32,
        distortion_model: distortion_model.into(),
        d,
        k: vec![fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        r: vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p: vec![fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    }
}

/// z-depth in millimetres; 0 where there is none, and beyond 65.5 m.
pub(super) fn depth(at: u64, frame: &str, depth: &Image<f32>) -> RawImage {
    let millimetres = |z: &f32| -> [u8; 2] {
        let mm = (1000.0 * z).round();
        (if mm > 0.0 && mm <= 65_535.0 { mm as u16 } else { 0 }).to_le_bytes()
    };
    RawImage {
        timestamp: Some(stamp(at)),
        frame_id: frame.into(),
        width: depth.width() as u32,
        height: depth.height() as u32,
        encoding: "16UC1".into(),
        step: 2 * depth.width() as u32,
        data: depth.data().iter().flat_map(millimetres).collect::<Vec<u8>>().into(),
    }
}

/// Edges of the pyramid that a camera sees.
pub(super) fn frustum(camera: &Pinhole, world_from_camera: &Se3) -> LinePrimitive {
    let (width, height) = (camera.width as f64 - 0.5, camera.height as f64 - 0.5);
    let corner = |u: f64, v: f64| {
        let ray = nalgebra::Vector3::new((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0);
        world_from_camera.act(&(ray * FRUSTUM_M))
    };
    let apex = world_from_camera.translation;
    let corners = [corner(-0.5, -0.5), corner(width, -0.5), corner(width, height), corner(-0.5, height)];
    let points = std::iter::once(&apex).chain(&corners).map(|p| Point3 { x: p.x, y: p.y, z: p.z }).collect();
    LinePrimitive {
        r#type: line_primitive::Type::LineList as i32,
        pose: Some(pose(&Se3::IDENTITY)),
        thickness: 1.0,
        scale_invariant: true,
        points,
        color: Some(Color { r: 0.1, g: 0.5, b: 0.9, a: 1.0 }),
        indices: vec![0, 1, 0, 2, 0, 3, 0, 4, 1, 2, 2, 3, 3, 4, 4, 1],
        ..LinePrimitive::default()
    }
}

/// Everything that was told on this topic is void.
pub(super) fn all(at: u64) -> SceneEntityDeletion {
    SceneEntityDeletion {
        timestamp: Some(stamp(at)),
        r#type: scene_entity_deletion::Type::All as i32,
        ..SceneEntityDeletion::default()
    }
}

/// Whether a message stands alone: it says first that what was told before is void.
pub(super) fn stands_alone(message: &[u8]) -> bool {
    let all = scene_entity_deletion::Type::All as i32;
    SceneUpdate::decode(message).is_ok_and(|update| update.deletions.iter().any(|d| d.r#type == all))
}

/// A changed surface.
pub(super) fn surface(at: u64, frame: &str, change: &SurfaceChange) -> SceneUpdate {
    let mut update = SceneUpdate::default();
    if change.is_whole {
        update.deletions.push(all(at));
    }
    for SurfacePatch { id, mesh } in &change.patches {
        let id = format!("surface {id}");
        if !mesh.triangles.is_empty() {
            let (frame_id, triangles) = (frame.into(), vec![triangles(mesh)]);
            let timestamp = Some(stamp(at));
            update.entities.push(SceneEntity {
                timestamp,
                frame_id,
                id,
                triangles,
                ..SceneEntity::default()
            });
        } else if !change.is_whole {
            let r#type = scene_entity_deletion::Type::MatchingId as i32;
            update.deletions.push(SceneEntityDeletion { timestamp: Some(stamp(at)), r#type, id });
        }
    }
    update
}

/// A mesh; grey where it has no colours.
fn triangles(mesh: &TriangleMesh) -> TriangleListPrimitive {
    let [x, y, z] = [0, 1, 2].map(|i| move |p: &[f32; 3]| f64::from(p[i]));
    let color = |c: &[u8; 3]| {
        let [r, g, b] = c.map(|v| f64::from(v) / 255.0);
        Color { r, g, b, a: 1.0 }
    };
    TriangleListPrimitive {
        pose: Some(pose(&Se3::IDENTITY)),
        points: mesh.positions.iter().map(|p| Point3 { x: x(p), y: y(p), z: z(p) }).collect(),
        color: Some(Color { r: 0.6, g: 0.6, b: 0.6, a: 1.0 }),
        colors: mesh.colors.iter().map(color).collect(),
        indices: mesh.triangles.as_flattened().to_vec(),
    }
}

/// Rows of four numbers as points.
pub(super) fn cloud(
    at: u64,
    frame: &str,
    names: [&str; 4],
    rows: impl Iterator<Item = [f32; 4]>,
) -> PointCloud {
    let field = |(k, name): (usize, &str)| PackedElementField {
        name: name.into(),
        offset: 4 * k as u32,
        r#type: NumericType::Float32 as i32,
    };
    PointCloud {
        timestamp: Some(stamp(at)),
        frame_id: frame.into(),
        pose: Some(pose(&Se3::IDENTITY)),
        point_stride: 16,
        fields: names.into_iter().enumerate().map(field).collect(),
        data: rows.flatten().flat_map(f32::to_le_bytes).collect::<Vec<u8>>().into(),
    }
}

/// Points with their colours, 16 bytes each.
pub(super) fn colored(at: u64, frame: &str, points: &vidar_core::PointCloud) -> PointCloud {
    let field = |name: &str, offset, r#type: NumericType| PackedElementField {
        name: name.into(),
        offset,
        r#type: r#type as i32,
    };
    let mut fields: Vec<_> =
        ["x", "y", "z"].into_iter().zip([0, 4, 8]).map(|(n, o)| field(n, o, NumericType::Float32)).collect();
    fields.extend(
        ["red", "green", "blue", "alpha"].into_iter().zip(12..).map(|(n, o)| field(n, o, NumericType::Uint8)),
    );
    let row = |(i, [x, y, z]): (usize, &[f32; 3])| {
        let [r, g, b] = points.colors.get(i).copied().unwrap_or([160; 3]);
        [x.to_le_bytes(), y.to_le_bytes(), z.to_le_bytes(), [r, g, b, 255]]
    };
    PointCloud {
        timestamp: Some(stamp(at)),
        frame_id: frame.into(),
        pose: Some(pose(&Se3::IDENTITY)),
        point_stride: 16,
        fields,
        data: points.positions.iter().enumerate().flat_map(row).flatten().collect::<Vec<u8>>().into(),
    }
}

pub(super) fn log(at: u64, level: LogLevel, name: &str, message: &str) -> Log {
    let level = match level {
        LogLevel::Info => log::Level::Info,
        LogLevel::Warning => log::Level::Warning,
    };
    Log {
        timestamp: Some(stamp(at)),
        level: level as i32,
        message: message.into(),
        name: name.into(),
        ..Log::default()
    }
}

pub(super) fn jpeg(image: &Image<[u8; 3]>) -> Result<Vec<u8>, ExportError> {
    let mut bytes = Vec::new();
    let encoder = JpegEncoder::new_with_quality(&mut bytes, JPEG_QUALITY);
    let written = encoder.write_image(
        image.data().as_flattened(),
        image.width() as u32,
        image.height() as u32,
        image::ExtendedColorType::Rgb8,
    );
    written.map_err(|e| ExportError::Unwritable {
        format: FORMAT,
        what: "an image".into(),
        reason: e.to_string(),
    })?;
    Ok(bytes)
}
