//! ASCII and binary PLY into a cloud and triangles.

use super::FORMAT;
use super::header::{self, Element, Property, PropertyKind};
use super::scalar::{Body, ScalarType};
use crate::error::ExportError;
use vidar_core::{PointCloud, TriangleMesh};

/// The supported content of a PLY file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Ply {
    /// The vertices.
    pub cloud: PointCloud,
    /// Vertex indices of each triangle; empty for a cloud. Every index names a vertex.
    pub triangles: Vec<[u32; 3]>,
    /// The comment lines of the header, in order.
    pub comments: Vec<String>,
}

impl Ply {
    /// The same as a mesh.
    pub fn into_mesh(self) -> TriangleMesh {
        let PointCloud { positions, normals, colors, confidences } = self.cloud;
        TriangleMesh { positions, normals, colors, confidences, triangles: self.triangles }
    }
}

/// Reads a PLY file; see the [module](super) for the supported part.
///
/// Errors name the header line or the byte and the element. A file without a `vertex` element is an error; bytes
/// after the last element are one too. Memory stays within a small multiple of `bytes.len()`.
pub fn read_ply(bytes: &[u8]) -> Result<Ply, ExportError> {
    let header = header::parse(bytes)?;
    let mut body = Body::new(header.encoding, bytes, header.body);
    let mut ply = Ply { comments: header.comments, ..Ply::default() };
    let mut has_vertices = false;
    for element in &header.elements {
        check_count(element, &body)?;
        match element.name.as_str() {
            "vertex" => {
                ply.cloud = read_vertices(element, &mut body)?;
                has_vertices = true;
            }
            "face" => ply.triangles = read_faces(element, &mut body)?,
            _ => skip(element, &mut body)?,
        }
    }
    if !has_vertices {
        return Err(ExportError::malformed(FORMAT, "header", "an element named vertex", "none"));
    }
    body.skip_trailing_blanks();
    if body.remaining() > 0 {
        let found = format!("{} more bytes", body.remaining());
        return Err(body.error("after the last element", "the end of the file", found));
    }
    check_indices(&ply)?;
    Ok(ply)
}

/// Checks the count in the header against the file size, before memory is allocated.
fn check_count(element: &Element, body: &Body<'_>) -> Result<(), ExportError> {
    let least = body.least_bytes(element.count, element.properties.iter().map(Property::least));
    let name = &element.name;
    if element.properties.is_empty() && element.count > 0 {
        return Err(body.error(
            &format!("element {name}"),
            "properties",
            format!("none, but {} items", element.count),
        ));
    }
    if least > body.remaining() {
        return Err(body.error(
            &format!("element {name}"),
            &format!("at least {least} bytes for {} items", element.count),
            format!("{} bytes", body.remaining()),
        ));
    }
    Ok(())
}

/// The target of a vertex property.
#[derive(Clone, Copy)]
enum Slot {
    Position(usize),
    Normal(usize),
    Color(usize, f64),
    Confidence,
}

fn slot(property: &Property) -> Option<Slot> {
    let PropertyKind::Scalar(kind) = property.kind else { return None };
    // Factor from the declared type's range to 0…255.
    let to_byte = match kind {
        ScalarType::F32 | ScalarType::F64 => 255.0,
        ScalarType::U16 => 1.0 / 257.0,
        _ => 1.0,
    };
    Some(match property.name.as_str() {
        "x" => Slot::Position(0),
        "y" => Slot::Position(1),
        "z" => Slot::Position(2),
        "nx" => Slot::Normal(0),
        "ny" => Slot::Normal(1),
        "nz" => Slot::Normal(2),
        "red" | "r" | "diffuse_red" => Slot::Color(0, to_byte),
        "green" | "g" | "diffuse_green" => Slot::Color(1, to_byte),
        "blue" | "b" | "diffuse_blue" => Slot::Color(2, to_byte),
        "confidence" | "quality" => Slot::Confidence,
        _ => return None,
    })
}

fn read_vertices(element: &Element, body: &mut Body<'_>) -> Result<PointCloud, ExportError> {
    let slots: Vec<Option<Slot>> = element.properties.iter().map(slot).collect();
    let has = |wanted: fn(&Slot) -> Option<usize>| {
        (0..3).all(|axis| slots.iter().flatten().any(|s| wanted(s) == Some(axis)))
    };
    let has_position = has(|s| if let Slot::Position(i) = s { Some(*i) } else { None });
    let has_normal = has(|s| if let Slot::Normal(i) = s { Some(*i) } else { None });
    let has_color = has(|s| if let Slot::Color(i, _) = s { Some(*i) } else { None });
    let has_confidence = slots.iter().flatten().any(|s| matches!(s, Slot::Confidence));
    if !has_position {
        return Err(ExportError::malformed(
            FORMAT,
            "header, element vertex",
            "properties x, y and z",
            "not all of them",
        ));
    }
    let n = element.count;
    let reserve = |wanted: bool| if wanted { n } else { 0 };
    let mut cloud = PointCloud {
        positions: Vec::with_capacity(n),
        normals: Vec::with_capacity(reserve(has_normal)),
        colors: Vec::with_capacity(reserve(has_color)),
        confidences: Vec::with_capacity(reserve(has_confidence)),
    };
    for index in 0..n {
        let (mut position, mut normal, mut color, mut confidence) = ([0.0; 3], [0.0; 3], [0; 3], 0.0);
        for (property, slot) in element.properties.iter().zip(&slots) {
            let value = read_property(element, property, index, body, &mut |_| Ok(()))?;
            match slot {
                Some(Slot::Position(axis)) => position[*axis] = value as f32,
                Some(Slot::Normal(axis)) => normal[*axis] = value as f32,
                Some(Slot::Color(channel, to_byte)) => {
                    // Rounds and saturates; NaN becomes 0.
                    color[*channel] = (value * to_byte).round() as u8;
                }
                Some(Slot::Confidence) => confidence = value as f32,
                None => {}
            }
        }
        if !position.iter().all(|v: &f32| v.is_finite()) {
            let context = format!("vertex {index}");
            return Err(body.error(&context, "a finite position", format!("{position:?}")));
        }
        cloud.positions.push(position);
        if has_normal {
            cloud.normals.push(if normal.iter().all(|v: &f32| v.is_finite()) { normal } else { [0.0; 3] });
        }
        if has_color {
            cloud.colors.push(color);
        }
        if has_confidence {
            cloud.confidences.push(if confidence.is_finite() { confidence } else { 0.0 });
        }
    }
    Ok(cloud)
}

fn read_faces(element: &Element, body: &mut Body<'_>) -> Result<Vec<[u32; 3]>, ExportError> {
    let is_indices = |p: &Property| matches!(p.name.as_str(), "vertex_indices" | "vertex_index");
    let indices_at = element.properties.iter().position(|p| {
        is_indices(p) && matches!(p.kind, PropertyKind::List { item, .. } if item.is_integer())
    });
    if indices_at.is_none() && element.count > 0 {
        let expected = "an integer list named vertex_indices";
        return Err(ExportError::malformed(FORMAT, "header, element face", expected, "none"));
    }
    let mut triangles = Vec::with_capacity(element.count);
    let mut polygon: Vec<u32> = Vec::new();
    for index in 0..element.count {
        polygon.clear();
        for (at, property) in element.properties.iter().enumerate() {
            if Some(at) == indices_at {
                read_property(element, property, index, body, &mut |value| {
                    // A negative index cannot name a vertex; the largest one never does either.
                    polygon.push(if value < 0.0 { u32::MAX } else { value as u32 });
                    Ok(())
                })?;
            } else {
                read_property(element, property, index, body, &mut |_| Ok(()))?;
            }
        }
        let [first, rest @ ..] = &polygon[..] else {
            return Err(body.error(&format!("face {index}"), "at least 3 corners", "none"));
        };
        if rest.len() < 2 {
            return Err(body.error(
                &format!("face {index}"),
                "at least 3 corners",
                polygon.len().to_string(),
            ));
        }
        triangles.extend(rest.windows(2).map(|w| [*first, w[0], w[1]]));
    }
    Ok(triangles)
}

fn skip(element: &Element, body: &mut Body<'_>) -> Result<(), ExportError> {
    for index in 0..element.count {
        for property in &element.properties {
            read_property(element, property, index, body, &mut |_| Ok(()))?;
        }
    }
    Ok(())
}

/// Reads one property of one item: a scalar's value is returned, a list's values are passed to `each`.
#[inline]
fn read_property(
    element: &Element,
    property: &Property,
    index: usize,
    body: &mut Body<'_>,
    each: &mut dyn FnMut(f64) -> Result<(), ExportError>,
) -> Result<f64, ExportError> {
    let context = || format!("{} {index}, property {}", element.name, property.name);
    match property.kind {
        PropertyKind::Scalar(kind) => body.next(kind, context),
        PropertyKind::List { count, item } => {
            let length = body.next(count, context)?;
            // Negative lengths saturate to 0 by the cast, so they are refused explicitly.
            if length < 0.0 {
                return Err(body.error(&context(), "a list length of 0 or more", length.to_string()));
            }
            let length = length as usize;
            let least = body.least_bytes(length, std::iter::once(item));
            if least > body.remaining() {
                let expected = format!("at least {least} bytes for a list of {length}");
                return Err(body.error(&context(), &expected, format!("{} bytes", body.remaining())));
            }
            for _ in 0..length {
                each(body.next(item, context)?)?;
            }
            Ok(0.0)
        }
    }
}

fn check_indices(ply: &Ply) -> Result<(), ExportError> {
    let n = ply.cloud.len();
    match ply.triangles.iter().find(|t| t.iter().any(|&i| i as usize >= n)) {
        Some(triangle) => Err(ExportError::malformed(
            FORMAT,
            "element face",
            format!("indices below {n}"),
            format!("a triangle {triangle:?}"),
        )),
        None => Ok(()),
    }
}
