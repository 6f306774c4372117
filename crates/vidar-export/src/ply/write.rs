//! Binary little-endian PLY.

use super::FORMAT;
use crate::error::{ExportError, write_error};
use crate::vertices::{Vertices, check_triangles};
use std::io::{self, BufWriter, Write};
use vidar_core::{PointCloud, TriangleMesh};

/// Comment of every file. Frame and unit of the positions are the caller's to state: not every map is levelled, or metric.
const VALUES_COMMENT: &str = "normals unit; colours sRGB; confidence 0..1";

/// Writes a point cloud; `comments` (frame, unit, the run) follow the one on the values.
///
/// A comment's line breaks become blanks. Errors: a value that is not finite, attribute lists of another length,
/// the writer's own.
pub fn write_ply_cloud(w: impl Write, cloud: &PointCloud, comments: &[String]) -> Result<(), ExportError> {
    let vertices = Vertices::of_cloud(cloud);
    vertices.check(FORMAT)?;
    write(w, vertices, None, comments).map_err(write_error(FORMAT))
}

/// Writes a mesh as [`write_ply_cloud`] does, with its faces.
pub fn write_ply_mesh(w: impl Write, mesh: &TriangleMesh, comments: &[String]) -> Result<(), ExportError> {
    let vertices = Vertices::of_mesh(mesh);
    vertices.check(FORMAT)?;
    check_triangles(FORMAT, &mesh.triangles, mesh.positions.len())?;
    // The face list holds `int`, the type every reader supports.
    if mesh.positions.len() > i32::MAX as usize {
        let reason = "its indices are signed 32-bit";
        return Err(ExportError::unwritable(FORMAT, format!("{} vertices", mesh.positions.len()), reason));
    }
    write(w, vertices, Some(&mesh.triangles), comments).map_err(write_error(FORMAT))
}

fn write(
    w: impl Write,
    vertices: Vertices<'_>,
    triangles: Option<&[[u32; 3]]>,
    comments: &[String],
) -> io::Result<()> {
    let mut w = BufWriter::new(w);
    write_header(&mut w, vertices, triangles.map(<[_]>::len), comments)?;
    for i in 0..vertices.positions.len() {
        write_floats(&mut w, &vertices.positions[i])?;
        if let Some(normal) = vertices.normals.get(i) {
            write_floats(&mut w, normal)?;
        }
        if let Some(color) = vertices.colors.get(i) {
            w.write_all(color)?;
        }
        if let Some(confidence) = vertices.confidences.get(i) {
            write_floats(&mut w, &[*confidence])?;
        }
    }
    for triangle in triangles.unwrap_or_default() {
        w.write_all(&[3])?;
        for index in triangle {
            w.write_all(&index.to_le_bytes())?;
        }
    }
    w.flush()
}

fn write_header(
    w: &mut impl Write,
    vertices: Vertices<'_>,
    triangles: Option<usize>,
    comments: &[String],
) -> io::Result<()> {
    w.write_all(b"ply\nformat binary_little_endian 1.0\n")?;
    for comment in std::iter::once(VALUES_COMMENT).chain(comments.iter().map(String::as_str)) {
        let line: String = comment.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
        writeln!(w, "comment {}", line.trim())?;
    }
    writeln!(w, "element vertex {}", vertices.positions.len())?;
    w.write_all(b"property float x\nproperty float y\nproperty float z\n")?;
    if !vertices.normals.is_empty() {
        w.write_all(b"property float nx\nproperty float ny\nproperty float nz\n")?;
    }
    if !vertices.colors.is_empty() {
        w.write_all(b"property uchar red\nproperty uchar green\nproperty uchar blue\n")?;
    }
    if !vertices.confidences.is_empty() {
        w.write_all(b"property float confidence\n")?;
    }
    if let Some(count) = triangles {
        writeln!(w, "element face {count}\nproperty list uchar int vertex_indices")?;
    }
    w.write_all(b"end_header\n")
}

fn write_floats(w: &mut impl Write, values: &[f32]) -> io::Result<()> {
    for value in values {
        w.write_all(&value.to_le_bytes())?;
    }
    Ok(())
}
