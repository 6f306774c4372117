//! The default scene of a GLB as one mesh in VIDAR's world.

use super::accessor::{Accessors, bad, unsupported};
use super::json::{Document, Node, Primitive};
use super::{CHUNK_BIN, CHUNK_JSON, COMMENTS_KEY, FORMAT, MAGIC, MODE_POINTS, MODE_TRIANGLES, VERSION};
use crate::axes::y_up_from_z_up;
use crate::bytes::Cursor;
use crate::error::{ExportError, quoted};
use nalgebra::{Matrix3, Matrix4, Vector3};
use vidar_core::{So3, TriangleMesh};

/// Deepest node tree read; bounds the recursion.
const MAX_DEPTH: usize = 64;

/// The supported content of a GLB, in VIDAR's world (z up), metres.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Glb {
    /// All primitives of the default scene; without triangles it is a cloud.
    pub mesh: TriangleMesh,
    /// The comments that VIDAR's writer put into `asset.extras`.
    pub comments: Vec<String>,
}

/// Reads a GLB file; see the [module](super) for the supported part.
///
/// An attribute is returned when every primitive has it. A file whose nodes repeat its meshes so often that there are
/// more vertices than bytes is refused, so memory stays within a multiple of `bytes.len()`.
pub fn read_glb(bytes: &[u8]) -> Result<Glb, ExportError> {
    let (document, binary) = chunks(bytes)?;
    let document: Document = crate::json::parse(FORMAT, document)?;
    if document.asset.version != "2.0" {
        return Err(bad("asset.version", "2.0", quoted(&document.asset.version)));
    }
    if let Some(extension) = document.extensions_required.iter().find(|e| e.as_str() != "KHR_materials_unlit")
    {
        return Err(unsupported("extensionsRequired", format!("extension {}", quoted(extension))));
    }
    let comments = comments(&document);
    let mut reader = SceneReader {
        visited: vec![false; document.nodes.len()],
        document: &document,
        file: Accessors::new(&document, binary, bytes.len()),
        parts: Parts::default(),
    };
    let z_up_from_y_up = y_up_from_z_up().transpose().to_homogeneous();
    match document.scenes.get(document.scene.unwrap_or(0)) {
        Some(scene) => {
            for &node in &scene.nodes {
                reader.visit(node, &z_up_from_y_up, 0)?;
            }
        }
        None if document.scene.is_none() && document.scenes.is_empty() => {
            return Err(bad("scenes", "at least one scene", "none".to_owned()));
        }
        None => return Err(bad("scene", "the number of a scene", format!("{:?}", document.scene))),
    }
    Ok(Glb { mesh: reader.parts.into_mesh(), comments })
}

/// The JSON chunk and the binary chunk (empty if there is none); chunks of other kinds are skipped.
fn chunks(bytes: &[u8]) -> Result<(&[u8], &[u8]), ExportError> {
    let mut cursor = Cursor::new(FORMAT, bytes);
    let magic = cursor.u32("magic")?;
    if magic != MAGIC {
        return Err(bad("byte 0", "\"glTF\"", format!("{magic:#010x}")));
    }
    let version = cursor.u32("version")?;
    if version != VERSION {
        return Err(bad("byte 4", "version 2", version.to_string()));
    }
    let length = cursor.u32("length")?;
    if length as usize != bytes.len() {
        return Err(bad("byte 8", &format!("the file's length {}", bytes.len()), length.to_string()));
    }
    let length = cursor.u32("length of the JSON chunk")?;
    let kind = cursor.u32("kind of the first chunk")?;
    if kind != CHUNK_JSON {
        return Err(bad("byte 16", "a JSON chunk", format!("{kind:#010x}")));
    }
    let document = cursor.take(length as usize, "JSON chunk")?;
    let mut binary: &[u8] = &[];
    while cursor.remaining() > 0 {
        let length = cursor.u32("length of a chunk")?;
        let kind = cursor.u32("kind of a chunk")?;
        let chunk = cursor.take(length as usize, "chunk")?;
        if kind == CHUNK_BIN && binary.is_empty() {
            binary = chunk;
        }
    }
    Ok((document, binary))
}

fn comments(document: &Document) -> Vec<String> {
    let list = document.asset.extras.get(COMMENTS_KEY).and_then(|v| v.as_array());
    list.into_iter().flatten().filter_map(|v| v.as_str().map(str::to_owned)).collect()
}

/// The data read so far; an attribute list is dropped at the end unless every vertex has it.
#[derive(Default)]
struct Parts {
    mesh: TriangleMesh,
}

impl Parts {
    fn into_mesh(mut self) -> TriangleMesh {
        let n = self.mesh.positions.len();
        if self.mesh.normals.len() != n {
            self.mesh.normals.clear();
        }
        if self.mesh.colors.len() != n {
            self.mesh.colors.clear();
        }
        if self.mesh.confidences.len() != n {
            self.mesh.confidences.clear();
        }
        self.mesh
    }
}

struct SceneReader<'a> {
    document: &'a Document,
    file: Accessors<'a>,
    visited: Vec<bool>,
    parts: Parts,
}

impl SceneReader<'_> {
    fn visit(
        &mut self,
        index: usize,
        world_from_parent: &Matrix4<f64>,
        depth: usize,
    ) -> Result<(), ExportError> {
        let document = self.document;
        let place = format!("nodes[{index}]");
        let (Some(node), Some(visited)) = (document.nodes.get(index), self.visited.get_mut(index)) else {
            return Err(bad(&place, &format!("a node below {}", document.nodes.len()), "none".to_owned()));
        };
        if std::mem::replace(visited, true) {
            return Err(bad(&place, "a node with one parent", "a node reached twice".to_owned()));
        }
        if depth > MAX_DEPTH {
            return Err(bad(
                &place,
                &format!("a tree of at most {MAX_DEPTH} levels"),
                "a deeper one".to_owned(),
            ));
        }
        let world_from_node = world_from_parent * parent_from_node(node, &place)?;
        if let Some(mesh_index) = node.mesh {
            let Some(mesh) = document.meshes.get(mesh_index) else {
                return Err(bad(&place, "a mesh of the file", format!("mesh {mesh_index}")));
            };
            for (i, primitive) in mesh.primitives.iter().enumerate() {
                let place = format!("meshes[{mesh_index}].primitives[{i}]");
                self.primitive(primitive, &world_from_node, &place)?;
            }
        }
        for &child in &node.children {
            self.visit(child, &world_from_node, depth + 1)?;
        }
        Ok(())
    }

    fn primitive(
        &mut self,
        primitive: &Primitive,
        world_from_node: &Matrix4<f64>,
        place: &str,
    ) -> Result<(), ExportError> {
        if !matches!(primitive.mode, MODE_POINTS | MODE_TRIANGLES) {
            return Err(unsupported(place, format!("primitive mode {}", primitive.mode)));
        }
        let attribute = |name: &str| primitive.attributes.get(name).copied();
        let Some(position) = attribute("POSITION") else {
            return Err(bad(place, "a POSITION attribute", "none".to_owned()));
        };
        let positions = self.file.reals::<3>(position, place)?;
        let n = positions.len();
        let base = self.parts.mesh.positions.len();
        for p in &positions {
            let world = world_from_node.transform_point(&Vector3::from(*p).into());
            let world = [world.x as f32, world.y as f32, world.z as f32];
            if !world.iter().all(|v| v.is_finite()) {
                return Err(bad(place, "finite positions", format!("{p:?}")));
            }
            self.parts.mesh.positions.push(world);
        }
        if let Some(accessor) = attribute("NORMAL") {
            let normals = self.file.reals::<3>(accessor, place)?;
            same_count(n, normals.len(), place)?;
            let linear: Matrix3<f64> = world_from_node.fixed_view::<3, 3>(0, 0).into_owned();
            let turned = transformed_normals(&normals, &linear, place)?;
            self.parts.mesh.normals.extend(turned);
        }
        if let Some(accessor) = attribute("COLOR_0") {
            let colors = self.file.colors(accessor, place)?;
            same_count(n, colors.len(), place)?;
            self.parts.mesh.colors.extend(colors);
        }
        if let Some(accessor) = attribute("_CONFIDENCE") {
            let confidences = self.file.reals::<1>(accessor, place)?;
            same_count(n, confidences.len(), place)?;
            if confidences.iter().any(|[c]| !c.is_finite()) {
                return Err(bad(place, "finite confidences", "others".to_owned()));
            }
            self.parts.mesh.confidences.extend(confidences.iter().map(|[c]| *c as f32));
        }
        if primitive.mode == MODE_TRIANGLES {
            let mirrored = world_from_node.fixed_view::<3, 3>(0, 0).into_owned().determinant() < 0.0;
            self.triangles(primitive.indices, (base, n), mirrored, place)?;
        }
        Ok(())
    }

    fn triangles(
        &mut self,
        indices: Option<usize>,
        (base, n): (usize, usize),
        mirrored: bool,
        place: &str,
    ) -> Result<(), ExportError> {
        let local: Vec<u32> = match indices {
            Some(accessor) => self.file.indices(accessor, place)?,
            // Positions come out of a file of at most 4 GiB, so their number fits.
            None => (0..n as u32).collect(),
        };
        if !local.len().is_multiple_of(3) {
            return Err(bad(place, "three indices a triangle", local.len().to_string()));
        }
        if let Some(index) = local.iter().find(|&&i| i as usize >= n) {
            return Err(bad(place, &format!("indices below {n}"), index.to_string()));
        }
        let base = base as u32;
        self.parts.mesh.triangles.extend(local.chunks_exact(3).map(|t| {
            // Mirroring inverts the orientation; swapping two corners restores it.
            let (b, c) = if mirrored { (t[2], t[1]) } else { (t[1], t[2]) };
            [base + t[0], base + b, base + c]
        }));
        Ok(())
    }
}

fn same_count(positions: usize, found: usize, place: &str) -> Result<(), ExportError> {
    if positions == found {
        return Ok(());
    }
    Err(bad(place, &format!("attributes of {positions} vertices"), found.to_string()))
}

/// Normals follow the inverse transpose; the identity of rotations is kept exact by skipping the rescaling.
fn transformed_normals(
    normals: &[[f64; 3]],
    linear: &Matrix3<f64>,
    place: &str,
) -> Result<Vec<[f32; 3]>, ExportError> {
    let is_rotation = (linear.transpose() * linear - Matrix3::identity()).amax() < 1e-12;
    let turn = if is_rotation {
        *linear
    } else {
        let Some(inverse) = linear.try_inverse() else {
            return Err(bad(place, "a node that does not flatten its mesh", "a singular matrix".to_owned()));
        };
        inverse.transpose()
    };
    normals
        .iter()
        .map(|normal| {
            let turned = turn * Vector3::from(*normal);
            let length = turned.norm();
            // Lengths are corrected only where the node changed them.
            let unit = if is_rotation || !(length > 0.0) { turned } else { turned / length };
            if !unit.iter().all(|v| v.is_finite()) {
                return Err(bad(place, "finite normals", format!("{normal:?}")));
            }
            Ok([unit.x as f32, unit.y as f32, unit.z as f32])
        })
        .collect()
}

/// A node's matrix, or its translation, rotation and scale.
fn parent_from_node(node: &Node, place: &str) -> Result<Matrix4<f64>, ExportError> {
    let matrix = match node.matrix {
        Some(columns) => Matrix4::from_column_slice(&columns),
        None => {
            let [x, y, z, w] = node.rotation.unwrap_or([0.0, 0.0, 0.0, 1.0]);
            let rotation = So3::from_quaternion(x, y, z, w)
                .ok_or_else(|| bad(place, "a unit quaternion", format!("{:?}", node.rotation)))?;
            let scale = Vector3::from(node.scale.unwrap_or([1.0; 3]));
            let mut matrix = (rotation.matrix() * Matrix3::from_diagonal(&scale)).to_homogeneous();
            let translation = Vector3::from(node.translation.unwrap_or([0.0; 3]));
            matrix.fixed_view_mut::<3, 1>(0, 3).copy_from(&translation);
            matrix
        }
    };
    let is_affine = matrix.row(3).iter().zip([0.0, 0.0, 0.0, 1.0]).all(|(a, b)| *a == b);
    if is_affine && matrix.iter().all(|v| v.is_finite()) {
        return Ok(matrix);
    }
    Err(bad(place, "an affine transform of finite numbers", format!("{:?}", node.matrix)))
}
