//! Common view of the vertices of a cloud or a mesh, for the writers.

use crate::error::ExportError;
use vidar_core::{PointCloud, TriangleMesh};

/// Borrowed vertex attributes; a list is empty or as long as `positions`.
#[derive(Clone, Copy)]
pub(crate) struct Vertices<'a> {
    pub positions: &'a [[f32; 3]],
    pub normals: &'a [[f32; 3]],
    pub colors: &'a [[u8; 3]],
    pub confidences: &'a [f32],
}

impl<'a> Vertices<'a> {
    pub fn of_cloud(cloud: &'a PointCloud) -> Self {
        Self {
            positions: &cloud.positions,
            normals: &cloud.normals,
            colors: &cloud.colors,
            confidences: &cloud.confidences,
        }
    }

    pub fn of_mesh(mesh: &'a TriangleMesh) -> Self {
        Self {
            positions: &mesh.positions,
            normals: &mesh.normals,
            colors: &mesh.colors,
            confidences: &mesh.confidences,
        }
    }

    /// Refuses attribute lists of other lengths and values that are not finite.
    ///
    /// Viewers handle NaN differently (from a missing point to an infinite bounding box), so it is never
    /// written; the caller must remove such points.
    pub fn check(&self, format: &'static str) -> Result<(), ExportError> {
        let n = self.positions.len();
        let lengths = [
            ("normals", self.normals.len()),
            ("colors", self.colors.len()),
            ("confidences", self.confidences.len()),
        ];
        for (what, len) in lengths {
            if len != 0 && len != n {
                return Err(ExportError::unwritable(format, what, format!("{len} of them for {n} vertices")));
            }
        }
        let finite = |p: &[f32; 3]| p.iter().all(|v| v.is_finite());
        let bad = [
            ("position", self.positions.iter().position(|p| !finite(p))),
            ("normal", self.normals.iter().position(|p| !finite(p))),
            ("confidence", self.confidences.iter().position(|c| !c.is_finite())),
        ];
        match bad.into_iter().find_map(|(what, index)| Some((what, index?))) {
            Some((what, index)) => Err(ExportError::unwritable(
                format,
                format!("the {what} of vertex {index}"),
                "it is not finite",
            )),
            None => Ok(()),
        }
    }
}

/// Refuses triangles with indices out of range.
pub(crate) fn check_triangles(
    format: &'static str,
    triangles: &[[u32; 3]],
    vertices: usize,
) -> Result<(), ExportError> {
    match triangles.iter().position(|t| t.iter().any(|&i| i as usize >= vertices)) {
        Some(index) => Err(ExportError::unwritable(
            format,
            format!("triangle {index} ({:?})", triangles[index]),
            format!("there are only {vertices} vertices"),
        )),
        None => Ok(()),
    }
}
