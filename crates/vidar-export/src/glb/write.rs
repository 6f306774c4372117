//! One node, one mesh, one primitive, one buffer.

use super::{
    CHUNK_BIN, CHUNK_JSON, COMMENTS_KEY, FLOAT, FORMAT, MAGIC, MODE_POINTS, MODE_TRIANGLES, UNSIGNED_INT,
    UNSIGNED_SHORT, VERSION, linear_from_srgb,
};
use crate::axes::y_up_from_z_up;
use crate::error::{ExportError, write_error};
use crate::vertices::{Vertices, check_triangles};
use serde_json::{Map, Value, json};
use std::io::{self, BufWriter, Write};
use vidar_core::{PointCloud, TriangleMesh};

pub(super) const ARRAY_BUFFER: u32 = 34962;
pub(super) const ELEMENT_ARRAY_BUFFER: u32 = 34963;

/// Writes a mesh; `comments` (the source, the run) are kept in `asset.extras`.
pub fn write_glb_mesh(w: impl Write, mesh: &TriangleMesh, comments: &[String]) -> Result<(), ExportError> {
    check_triangles(FORMAT, &mesh.triangles, mesh.positions.len())?;
    write(w, Vertices::of_mesh(mesh), &mesh.triangles, comments)
}

/// Writes a point cloud as [`write_glb_mesh`] does.
pub fn write_glb_cloud(w: impl Write, cloud: &PointCloud, comments: &[String]) -> Result<(), ExportError> {
    write(w, Vertices::of_cloud(cloud), &[], comments)
}

fn write(
    w: impl Write,
    vertices: Vertices<'_>,
    triangles: &[[u32; 3]],
    comments: &[String],
) -> Result<(), ExportError> {
    vertices.check(FORMAT)?;
    let layout = Layout::new(vertices, triangles);
    let mut document = layout.document(vertices, triangles, comments).to_string().into_bytes();
    // Chunks are padded to four bytes, JSON with blanks.
    document.resize(document.len().next_multiple_of(4), b' ');
    let has_binary = layout.total > 0;
    let total = 12 + 8 + document.len() + if has_binary { 8 + layout.total } else { 0 };
    let Ok(total) = u32::try_from(total) else {
        let what = format!("{} vertices and {} triangles", vertices.positions.len(), triangles.len());
        return Err(ExportError::unwritable(FORMAT, what, "its lengths end at 4 GiB"));
    };
    let write = || -> io::Result<()> {
        let mut w = BufWriter::new(w);
        // Both lengths below are smaller than `total`, which fits.
        write_words(&mut w, &[MAGIC, VERSION, total, document.len() as u32, CHUNK_JSON])?;
        w.write_all(&document)?;
        if has_binary {
            write_words(&mut w, &[layout.total as u32, CHUNK_BIN])?;
            write_binary(&mut w, vertices, triangles)?;
        }
        w.flush()
    };
    write().map_err(write_error(FORMAT))
}

pub(super) fn write_words(w: &mut impl Write, words: &[u32]) -> io::Result<()> {
    words.iter().try_for_each(|word| w.write_all(&word.to_le_bytes()))
}

/// Every element is a multiple of four bytes long, so nothing needs padding.
fn write_binary(w: &mut impl Write, vertices: Vertices<'_>, triangles: &[[u32; 3]]) -> io::Result<()> {
    for value in vertices.positions.iter().chain(vertices.normals).flatten() {
        w.write_all(&value.to_le_bytes())?;
    }
    for &[r, g, b] in vertices.colors {
        for channel in [linear_from_srgb(r), linear_from_srgb(g), linear_from_srgb(b), u16::MAX] {
            w.write_all(&channel.to_le_bytes())?;
        }
    }
    for value in vertices.confidences {
        w.write_all(&value.to_le_bytes())?;
    }
    for index in triangles.iter().flatten() {
        w.write_all(&index.to_le_bytes())?;
    }
    Ok(())
}

/// One attribute (or the indices) in the buffer.
struct Section {
    /// `None`: the indices.
    attribute: Option<&'static str>,
    component: u32,
    kind: &'static str,
    normalized: bool,
    count: usize,
    offset: usize,
    bytes: usize,
}

/// Layout of the buffer.
struct Layout {
    sections: Vec<Section>,
    total: usize,
}

impl Layout {
    fn new(vertices: Vertices<'_>, triangles: &[[u32; 3]]) -> Self {
        let mut layout = Self { sections: Vec::new(), total: 0 };
        layout.push(Some("POSITION"), FLOAT, "VEC3", vertices.positions.len(), 12);
        layout.push(Some("NORMAL"), FLOAT, "VEC3", vertices.normals.len(), 12);
        layout.push(Some("COLOR_0"), UNSIGNED_SHORT, "VEC4", vertices.colors.len(), 8);
        layout.push(Some("_CONFIDENCE"), FLOAT, "SCALAR", vertices.confidences.len(), 4);
        layout.push(None, UNSIGNED_INT, "SCALAR", triangles.len() * 3, 4);
        layout
    }

    fn push(
        &mut self,
        attribute: Option<&'static str>,
        component: u32,
        kind: &'static str,
        count: usize,
        element_bytes: usize,
    ) {
        if count == 0 {
            return;
        }
        let (offset, bytes) = (self.total, count * element_bytes);
        let normalized = component == UNSIGNED_SHORT;
        self.sections.push(Section { attribute, component, kind, normalized, count, offset, bytes });
        self.total += bytes;
    }

    fn document(&self, vertices: Vertices<'_>, triangles: &[[u32; 3]], comments: &[String]) -> Value {
        let mut document = Map::new();
        let mut put = |key: &str, value: Value| document.insert(key.to_owned(), value);
        put("asset", asset(comments));
        put("scene", json!(0));
        put("scenes", json!([{ "nodes": [0] }]));
        let matrix = root_matrix();
        if self.sections.is_empty() {
            put("nodes", json!([{ "name": "world", "matrix": matrix }]));
            return Value::Object(document);
        }
        put("nodes", json!([{ "name": "world", "matrix": matrix, "mesh": 0 }]));
        put("meshes", json!([{ "primitives": [self.primitive(triangles)] }]));
        let unlit = !vertices.colors.is_empty();
        put("materials", json!([material(unlit)]));
        if unlit {
            put("extensionsUsed", json!(["KHR_materials_unlit"]));
        }
        put("accessors", self.accessors(vertices));
        put("bufferViews", self.buffer_views());
        put("buffers", json!([{ "byteLength": self.total }]));
        Value::Object(document)
    }

    fn primitive(&self, triangles: &[[u32; 3]]) -> Value {
        let mut attributes = Map::new();
        let mut primitive = Map::new();
        for (index, section) in self.sections.iter().enumerate() {
            match section.attribute {
                Some(name) => attributes.insert(name.to_owned(), json!(index)),
                None => primitive.insert("indices".to_owned(), json!(index)),
            };
        }
        let mode = if triangles.is_empty() { MODE_POINTS } else { MODE_TRIANGLES };
        primitive.insert("attributes".to_owned(), Value::Object(attributes));
        primitive.insert("material".to_owned(), json!(0));
        primitive.insert("mode".to_owned(), json!(mode));
        Value::Object(primitive)
    }

    fn accessors(&self, vertices: Vertices<'_>) -> Value {
        let accessor = |(view, section): (usize, &Section)| {
            let mut accessor = Map::new();
            accessor.insert("bufferView".to_owned(), json!(view));
            accessor.insert("componentType".to_owned(), json!(section.component));
            accessor.insert("count".to_owned(), json!(section.count));
            accessor.insert("type".to_owned(), json!(section.kind));
            if section.normalized {
                accessor.insert("normalized".to_owned(), json!(true));
            }
            if section.attribute == Some("POSITION") {
                let (min, max) = bounds(vertices.positions);
                accessor.insert("min".to_owned(), json!(min));
                accessor.insert("max".to_owned(), json!(max));
            }
            Value::Object(accessor)
        };
        Value::Array(self.sections.iter().enumerate().map(accessor).collect())
    }

    fn buffer_views(&self) -> Value {
        let view = |section: &Section| {
            let target = if section.attribute.is_some() { ARRAY_BUFFER } else { ELEMENT_ARRAY_BUFFER };
            json!({ "buffer": 0, "byteOffset": section.offset, "byteLength": section.bytes, "target": target })
        };
        Value::Array(self.sections.iter().map(view).collect())
    }
}

pub(super) fn asset(comments: &[String]) -> Value {
    json!({
        "version": "2.0",
        "generator": "vidar",
        "extras": {
            "frame": "vertices as in the map's world; node \"world\" turns its z into y, glTF's up",
            COMMENTS_KEY: comments,
        },
    })
}

/// The rotation of the root node, column by column as glTF requires.
pub(super) fn root_matrix() -> [f64; 16] {
    let mut matrix = nalgebra::Matrix4::identity();
    matrix.fixed_view_mut::<3, 3>(0, 0).copy_from(&y_up_from_z_up());
    let mut columns = [0.0; 16];
    columns.copy_from_slice(matrix.as_slice());
    columns
}

pub(super) fn material(unlit: bool) -> Value {
    let surface =
        json!({ "baseColorFactor": [1.0, 1.0, 1.0, 1.0], "metallicFactor": 0.0, "roughnessFactor": 1.0 });
    // The inside of a room must be visible from outside, too.
    let mut material = json!({ "pbrMetallicRoughness": surface, "doubleSided": true });
    if unlit {
        material["extensions"] = json!({ "KHR_materials_unlit": {} });
    }
    material
}

/// Smallest and largest coordinates; `f64` holds them exactly, so their text is theirs.
pub(super) fn bounds(positions: &[[f32; 3]]) -> ([f64; 3], [f64; 3]) {
    let (mut min, mut max) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for position in positions {
        for axis in 0..3 {
            min[axis] = min[axis].min(f64::from(position[axis]));
            max[axis] = max[axis].max(f64::from(position[axis]));
        }
    }
    (min, max)
}
