//! A mesh with a texture: one node, one mesh of two primitives, one buffer that holds the texture, too.

use super::write::{
    ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER, asset, bounds, material, root_matrix, write_glb_mesh, write_words,
};
use super::{
    CHUNK_BIN, CHUNK_JSON, FLOAT, FORMAT, MAGIC, MODE_TRIANGLES, UNSIGNED_INT, UNSIGNED_SHORT, VERSION,
    linear_from_srgb,
};
use crate::error::{ExportError, write_error};
use crate::vertices::{Vertices, check_triangles};
use image::codecs::jpeg::JpegEncoder;
use serde_json::{Map, Value, json};
use std::io::{self, BufWriter, Write};
use vidar_core::{Image, TexturedMesh, TriangleMesh};

/// Quality of the JPEG, 1 to 100: its errors lie below the noise of a camera, at a tenth of the size of a PNG.
const JPEG_QUALITY: u8 = 92;
/// Longest edge that JPEG can state, pixels.
const MAX_JPEG_PX: usize = 65_535;
/// Filters and wrapping of glTF: linear, linear between levels, and no repetition.
const LINEAR: u32 = 9729;
const LINEAR_MIPMAP_LINEAR: u32 = 9987;
const CLAMP_TO_EDGE: u32 = 33071;

/// Writes a textured mesh; `comments` (the source, the run) are kept in `asset.extras`.
///
/// # Errors
/// Lists that do not fit each other, values that are not finite, a texture beyond JPEG's size, more than 4 GiB, and those of `w`.
pub fn write_glb_textured(
    w: impl Write,
    mesh: &TexturedMesh,
    comments: &[String],
) -> Result<(), ExportError> {
    check(mesh)?;
    if mesh.textured.triangles.is_empty() {
        return write_glb_mesh(w, &mesh.rest, comments);
    }
    let mut file = File::default();
    let mut primitives = vec![file.textured(mesh)];
    if !mesh.rest.triangles.is_empty() {
        primitives.push(file.colored(&mesh.rest));
    }
    let texture = file.section(&jpeg(&mesh.texture)?, None);
    let mut document = file.document(primitives, texture, comments).to_string().into_bytes();
    // Chunks are padded to four bytes, JSON with blanks.
    document.resize(document.len().next_multiple_of(4), b' ');
    let total = 12 + 8 + document.len() + 8 + file.binary.len();
    let Ok(total) = u32::try_from(total) else {
        let what = format!("{} textured triangles", mesh.textured.triangles.len());
        return Err(ExportError::unwritable(FORMAT, what, "its lengths end at 4 GiB"));
    };
    let write = || -> io::Result<()> {
        let mut w = BufWriter::new(w);
        // Both lengths below are smaller than `total`, which fits.
        write_words(&mut w, &[MAGIC, VERSION, total, document.len() as u32, CHUNK_JSON])?;
        w.write_all(&document)?;
        write_words(&mut w, &[file.binary.len() as u32, CHUNK_BIN])?;
        w.write_all(&file.binary)?;
        w.flush()
    };
    write().map_err(write_error(FORMAT))
}

fn check(mesh: &TexturedMesh) -> Result<(), ExportError> {
    for part in [&mesh.textured, &mesh.rest] {
        Vertices::of_mesh(part).check(FORMAT)?;
        check_triangles(FORMAT, &part.triangles, part.positions.len())?;
    }
    let (uvs, vertices) = (mesh.uvs.len(), mesh.textured.positions.len());
    if uvs != vertices {
        let why = format!("{uvs} of them for {vertices} vertices");
        return Err(ExportError::unwritable(FORMAT, "texture coordinates", why));
    }
    if let Some(at) = mesh.uvs.iter().position(|uv| !uv.iter().all(|c| c.is_finite())) {
        let what = format!("the texture coordinate of vertex {at}");
        return Err(ExportError::unwritable(FORMAT, what, "it is not finite"));
    }
    Ok(())
}

fn jpeg(texture: &Image<[u8; 3]>) -> Result<Vec<u8>, ExportError> {
    let (width, height) = (texture.width(), texture.height());
    let refused =
        |why: String| ExportError::unwritable(FORMAT, format!("a texture of {width}x{height} pixels"), why);
    if width.max(height) > MAX_JPEG_PX {
        return Err(refused(format!("a JPEG has at most {MAX_JPEG_PX} along an edge")));
    }
    let mut bytes = Vec::new();
    let mut encoder = JpegEncoder::new_with_quality(&mut bytes, JPEG_QUALITY);
    let data = texture.data().as_flattened();
    let encoded = encoder.encode(data, width as u32, height as u32, image::ExtendedColorType::Rgb8);
    encoded.map_err(|e| refused(e.to_string()))?;
    Ok(bytes)
}

/// The parts of the file so far.
#[derive(Default)]
struct File {
    binary: Vec<u8>,
    views: Vec<Value>,
    accessors: Vec<Value>,
}

impl File {
    fn textured(&mut self, mesh: &TexturedMesh) -> Value {
        let mut attributes = self.geometry(&mesh.textured);
        let uvs: Vec<u8> = mesh.uvs.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
        let uvs = self.attribute(&uvs, FLOAT, "VEC2", mesh.uvs.len());
        attributes.insert("TEXCOORD_0".to_owned(), uvs);
        self.primitive(attributes, &mesh.textured, 0)
    }

    fn colored(&mut self, mesh: &TriangleMesh) -> Value {
        let mut attributes = self.geometry(mesh);
        if !mesh.colors.is_empty() {
            let linear = |&[r, g, b]: &[u8; 3]| {
                [linear_from_srgb(r), linear_from_srgb(g), linear_from_srgb(b), u16::MAX]
                    .map(u16::to_le_bytes)
            };
            let colors: Vec<u8> = mesh.colors.iter().flat_map(linear).flatten().collect();
            let colors = self.attribute(&colors, UNSIGNED_SHORT, "VEC4", mesh.colors.len());
            attributes.insert("COLOR_0".to_owned(), colors);
        }
        self.primitive(attributes, mesh, 1)
    }

    /// Positions, and normals and confidences where the mesh has them.
    fn geometry(&mut self, mesh: &TriangleMesh) -> Map<String, Value> {
        let bytes = |values: &[[f32; 3]]| -> Vec<u8> {
            values.iter().flatten().flat_map(|v| v.to_le_bytes()).collect()
        };
        let mut attributes = Map::new();
        let positions = self.attribute(&bytes(&mesh.positions), FLOAT, "VEC3", mesh.positions.len());
        let (min, max) = bounds(&mesh.positions);
        if let Some(accessor) = self.accessors.last_mut() {
            accessor["min"] = json!(min);
            accessor["max"] = json!(max);
        }
        attributes.insert("POSITION".to_owned(), positions);
        if !mesh.normals.is_empty() {
            let normals = self.attribute(&bytes(&mesh.normals), FLOAT, "VEC3", mesh.normals.len());
            attributes.insert("NORMAL".to_owned(), normals);
        }
        if !mesh.confidences.is_empty() {
            let confidences: Vec<u8> = mesh.confidences.iter().flat_map(|v| v.to_le_bytes()).collect();
            let confidences = self.attribute(&confidences, FLOAT, "SCALAR", mesh.confidences.len());
            attributes.insert("_CONFIDENCE".to_owned(), confidences);
        }
        attributes
    }

    fn primitive(&mut self, attributes: Map<String, Value>, mesh: &TriangleMesh, material: u32) -> Value {
        let indices: Vec<u8> = mesh.triangles.iter().flatten().flat_map(|v| v.to_le_bytes()).collect();
        let view = self.section(&indices, Some(ELEMENT_ARRAY_BUFFER));
        let indices = self.accessor(view, UNSIGNED_INT, "SCALAR", mesh.triangles.len() * 3);
        json!({ "attributes": attributes, "indices": indices, "material": material, "mode": MODE_TRIANGLES })
    }

    fn attribute(&mut self, bytes: &[u8], component: u32, kind: &str, count: usize) -> Value {
        let view = self.section(bytes, Some(ARRAY_BUFFER));
        json!(self.accessor(view, component, kind, count))
    }

    /// Appends bytes to the buffer; the number of their view.
    fn section(&mut self, bytes: &[u8], target: Option<u32>) -> usize {
        let mut view = json!({ "buffer": 0, "byteOffset": self.binary.len(), "byteLength": bytes.len() });
        if let Some(target) = target {
            view["target"] = json!(target);
        }
        self.binary.extend_from_slice(bytes);
        self.binary.resize(self.binary.len().next_multiple_of(4), 0);
        self.views.push(view);
        self.views.len() - 1
    }

    fn accessor(&mut self, view: usize, component: u32, kind: &str, count: usize) -> usize {
        let mut accessor =
            json!({ "bufferView": view, "componentType": component, "count": count, "type": kind });
        if component == UNSIGNED_SHORT {
            accessor["normalized"] = json!(true);
        }
        self.accessors.push(accessor);
        self.accessors.len() - 1
    }

    fn document(&self, primitives: Vec<Value>, texture: usize, comments: &[String]) -> Value {
        let mut textured = material(true);
        textured["pbrMetallicRoughness"]["baseColorTexture"] = json!({ "index": 0 });
        let mut materials = vec![textured];
        materials.extend((primitives.len() > 1).then(|| material(true)));
        json!({
            "asset": asset(comments),
            "extensionsUsed": ["KHR_materials_unlit"],
            "scene": 0,
            "scenes": [{ "nodes": [0] }],
            "nodes": [{ "name": "world", "matrix": root_matrix(), "mesh": 0 }],
            "meshes": [{ "primitives": primitives }],
            "materials": materials,
            "textures": [{ "source": 0, "sampler": 0 }],
            "samplers": [{
                "magFilter": LINEAR, "minFilter": LINEAR_MIPMAP_LINEAR, "wrapS": CLAMP_TO_EDGE, "wrapT": CLAMP_TO_EDGE,
            }],
            "images": [{ "bufferView": texture, "mimeType": "image/jpeg", "name": "texture" }],
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{ "byteLength": self.binary.len() }],
        })
    }
}
