//! Removal of small connected components and of unused vertices from a mesh.

use vidar_core::TriangleMesh;

/// The mesh without connected components of fewer than `min_triangles` triangles and without unused vertices.
pub(crate) fn remove_small_components(mesh: TriangleMesh, min_triangles: usize) -> TriangleMesh {
    let mut triangles = mesh.triangles;
    if min_triangles > 1 {
        let mut components = UnionFind::new(mesh.positions.len());
        for t in &triangles {
            components.union(t[0], t[1]);
            components.union(t[1], t[2]);
        }
        let mut sizes = vec![0u32; mesh.positions.len()];
        for t in &triangles {
            sizes[components.find(t[0]) as usize] += 1;
        }
        triangles.retain(|t| sizes[components.find(t[0]) as usize] as usize >= min_triangles);
    }
    const UNUSED: u32 = u32::MAX;
    let mut new_index = vec![UNUSED; mesh.positions.len()];
    for &v in triangles.iter().flatten() {
        new_index[v as usize] = 0;
    }
    for (index, used) in (0u32..).zip(new_index.iter_mut().filter(|n| **n != UNUSED)) {
        *used = index;
    }
    for v in triangles.iter_mut().flatten() {
        *v = new_index[*v as usize];
    }
    TriangleMesh {
        positions: keep(mesh.positions, &new_index, UNUSED),
        normals: keep(mesh.normals, &new_index, UNUSED),
        colors: keep(mesh.colors, &new_index, UNUSED),
        confidences: keep(mesh.confidences, &new_index, UNUSED),
        triangles,
    }
}

/// The attributes whose new index is not `unused`; an empty list stays empty.
fn keep<T>(attributes: Vec<T>, new_index: &[u32], unused: u32) -> Vec<T> {
    attributes.into_iter().zip(new_index).filter(|(_, index)| **index != unused).map(|(a, _)| a).collect()
}

/// Disjoint sets of vertices (union-find): the root of a set is its smallest vertex.
struct UnionFind {
    parent: Vec<u32>,
}

impl UnionFind {
    fn new(vertices: usize) -> Self {
        Self { parent: (0..vertices as u32).collect() }
    }

    fn find(&mut self, mut v: u32) -> u32 {
        while self.parent[v as usize] != v {
            // Path halving keeps the trees flat.
            let above = self.parent[self.parent[v as usize] as usize];
            self.parent[v as usize] = above;
            v = above;
        }
        v
    }

    fn union(&mut self, a: u32, b: u32) {
        let (a, b) = (self.find(a), self.find(b));
        self.parent[a.max(b) as usize] = a.min(b);
    }
}
