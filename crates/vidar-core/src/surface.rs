//! Point clouds and triangle meshes, in metres, in the world frame: outputs of fusion, inputs of export and evaluation.

use crate::Image;

/// Points with optional attributes; an attribute list is either empty or as long as `positions`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PointCloud {
    /// Positions in the world, metres.
    pub positions: Vec<[f32; 3]>,
    /// Unit normals in the world, facing the observer.
    pub normals: Vec<[f32; 3]>,
    /// sRGB colours.
    pub colors: Vec<[u8; 3]>,
    /// Confidence in 0…1.
    pub confidences: Vec<f32>,
}

impl PointCloud {
    /// Points without attributes.
    pub fn from_positions(positions: Vec<[f32; 3]>) -> Self {
        Self { positions, ..Self::default() }
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Whether there is no point.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }

    /// Whether every attribute list is empty or as long as `positions`.
    pub fn is_consistent(&self) -> bool {
        let n = self.positions.len();
        [self.normals.len(), self.colors.len(), self.confidences.len()]
            .iter()
            .all(|&len| len == 0 || len == n)
    }
}

/// A triangle mesh with shared vertices; triangles are counter-clockwise from the observed side.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TriangleMesh {
    /// Vertex positions in the world, metres.
    pub positions: Vec<[f32; 3]>,
    /// Unit vertex normals, or empty.
    pub normals: Vec<[f32; 3]>,
    /// sRGB vertex colours, or empty.
    pub colors: Vec<[u8; 3]>,
    /// Confidence in 0…1 per vertex, or empty.
    pub confidences: Vec<f32>,
    /// Vertex indices of each triangle.
    pub triangles: Vec<[u32; 3]>,
}

/// A mesh whose colours are those of a texture.
#[derive(Clone, Debug, PartialEq)]
pub struct TexturedMesh {
    /// The triangles that the texture shows. Vertices at its seams are repeated.
    pub textured: TriangleMesh,
    /// Where each of their vertices lies in the texture, 0…1 of its width and height; (0, 0) is its top-left corner.
    pub uvs: Vec<[f32; 2]>,
    /// The texture, sRGB.
    pub texture: Image<[u8; 3]>,
    /// The triangles that no image shows, with the colours of their vertices.
    pub rest: TriangleMesh,
}

impl TriangleMesh {
    /// Whether attributes fit the vertices and every index is that of a vertex.
    pub fn is_consistent(&self) -> bool {
        let n = self.positions.len();
        [self.normals.len(), self.colors.len(), self.confidences.len()]
            .iter()
            .all(|&len| len == 0 || len == n)
            && self.triangles.iter().flatten().all(|&i| (i as usize) < n)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn attributes_are_absent_or_one_per_point() {
        let mut cloud = PointCloud::from_positions(vec![[0.0; 3]; 3]);
        assert!(cloud.is_consistent() && cloud.len() == 3 && !cloud.is_empty());
        cloud.confidences = vec![1.0; 3];
        assert!(cloud.is_consistent());
        cloud.normals = vec![[0.0, 0.0, 1.0]; 2];
        assert!(!cloud.is_consistent());
        assert!(PointCloud::default().is_consistent() && PointCloud::default().is_empty());
    }

    #[test]
    fn triangles_name_vertices_that_exist() {
        let positions = vec![[0.0; 3]; 3];
        let mesh = TriangleMesh { positions, triangles: vec![[0, 1, 2]], ..TriangleMesh::default() };
        assert!(mesh.is_consistent());
        assert!(!TriangleMesh { triangles: vec![[0, 1, 3]], ..mesh.clone() }.is_consistent());
        assert!(!TriangleMesh { colors: vec![[0; 3]], ..mesh }.is_consistent());
    }
}
