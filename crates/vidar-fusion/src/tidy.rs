//! Dropping what a mesh does not need: small pieces and vertices without triangle.

use vidar_core::TriangleMesh;

/// The mesh without connected pieces of fewer than `min_triangles` triangles and without unused vertices.
pub(crate) fn tidy(mesh: TriangleMesh, min_triangles: usize) -> TriangleMesh {
    let mut triangles = mesh.triangles;
    if min_triangles > 1 {
        let mut pieces = Pieces::new(mesh.positions.len());
        for t in &triangles {
            pieces.join(t[0], t[1]);
            pieces.join(t[1], t[2]);
        }
        let mut sizes = vec![0usize; mesh.positions.len()];
        for t in &triangles {
            sizes[pieces.root(t[0]) as usize] += 1;
        }
        triangles.retain(|t| sizes[pieces.root(t[0]) as usize] >= min_triangles);
    }
    const UNUSED: u32 = u32::MAX;
    let mut renamed = vec![UNUSED; mesh.positions.len()];
    for &v in triangles.iter().flatten() {
        renamed[v as usize] = 0;
    }
    for (name, used) in (0u32..).zip(renamed.iter_mut().filter(|n| **n != UNUSED)) {
        *used = name;
    }
    for v in triangles.iter_mut().flatten() {
        *v = renamed[*v as usize];
    }
    TriangleMesh {
        positions: keep(mesh.positions, &renamed, UNUSED),
        normals: keep(mesh.normals, &renamed, UNUSED),
        colors: keep(mesh.colors, &renamed, UNUSED),
        confidences: keep(mesh.confidences, &renamed, UNUSED),
        triangles,
    }
}

/// The attributes whose new name is not `unused`; an empty list stays empty.
fn keep<T>(attributes: Vec<T>, renamed: &[u32], unused: u32) -> Vec<T> {
    attributes.into_iter().zip(renamed).filter(|(_, name)| **name != unused).map(|(a, _)| a).collect()
}

/// Connected vertices: a forest in which the root of a piece is its smallest vertex.
struct Pieces {
    parent: Vec<u32>,
}

impl Pieces {
    fn new(vertices: usize) -> Self {
        Self { parent: (0..vertices as u32).collect() }
    }

    fn root(&mut self, mut v: u32) -> u32 {
        while self.parent[v as usize] != v {
            // Path halving keeps the trees flat.
            let above = self.parent[self.parent[v as usize] as usize];
            self.parent[v as usize] = above;
            v = above;
        }
        v
    }

    fn join(&mut self, a: u32, b: u32) {
        let (a, b) = (self.root(a), self.root(b));
        self.parent[a.max(b) as usize] = a.min(b);
    }
}
