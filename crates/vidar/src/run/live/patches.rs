//! A surface as patches, so that of a surface that grows only what changed is told.

use std::collections::BTreeMap;
use std::hash::{DefaultHasher, Hash, Hasher};
use vidar_core::TriangleMesh;
use vidar_link::ros::{CloudPoint, MeshMarker};

/// Edge of the cube that a patch lies in, metres: at voxels of 2 cm some thousand triangles.
const EDGE_M: f32 = 1.0;
/// After so many surfaces every patch is told again: whoever came later, or lost a message, has the whole map by then.
const WHOLE_EVERY: u32 = 10;

/// What was told of each patch.
#[derive(Default)]
pub(super) struct Patches {
    told: BTreeMap<[i32; 3], Told>,
    surfaces: u32,
    next: i32,
}

struct Told {
    id: i32,
    /// Of its triangles; none once it was deleted.
    content: Option<u64>,
}

impl Patches {
    /// What must be told for who knows what was told before to have this surface; everything for a final one.
    pub fn changes(&mut self, mesh: &TriangleMesh, is_final: bool) -> Vec<MeshMarker> {
        let is_whole = is_final || self.surfaces.is_multiple_of(WHOLE_EVERY);
        self.surfaces = self.surfaces.wrapping_add(1);
        let patches = split(mesh);
        let mut changes = Vec::new();
        for (cell, told) in &mut self.told {
            if told.content.is_some() && !patches.contains_key(cell) {
                told.content = None;
                changes.push(MeshMarker { id: told.id, triangles: Vec::new() });
            }
        }
        for (cell, triangles) in patches {
            let content = Some(fingerprint(&triangles));
            let told = self.told.entry(cell).or_insert_with(|| {
                self.next += 1;
                Told { id: self.next - 1, content: None }
            });
            if is_whole || told.content != content {
                told.content = content;
                changes.push(MeshMarker { id: told.id, triangles });
            }
        }
        changes
    }
}

/// Position and colour of a vertex; grey where the mesh has no colours.
pub(super) fn vertex(mesh: &TriangleMesh, i: usize) -> CloudPoint {
    (mesh.positions[i], mesh.colors.get(i).copied().unwrap_or([128; 3]))
}

/// The triangles by the cube that their first vertex lies in.
fn split(mesh: &TriangleMesh) -> BTreeMap<[i32; 3], Vec<[CloudPoint; 3]>> {
    let mut patches: BTreeMap<[i32; 3], Vec<[CloudPoint; 3]>> = BTreeMap::new();
    for triangle in &mesh.triangles {
        let corners = triangle.map(|i| vertex(mesh, i as usize));
        let cell = corners[0].0.map(|v| (v / EDGE_M).floor() as i32);
        patches.entry(cell).or_default().push(corners);
    }
    patches
}

/// Of positions and colours. Nobody chooses them to collide.
fn fingerprint(triangles: &[[CloudPoint; 3]]) -> u64 {
    let mut hasher = DefaultHasher::new();
    for (position, color) in triangles.as_flattened() {
        position.map(f32::to_bits).hash(&mut hasher);
        color.hash(&mut hasher);
    }
    hasher.finish()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A triangle at each place, metres along x.
    fn mesh(at: &[f32]) -> TriangleMesh {
        let positions = at.iter().flat_map(|x| [[*x, 0.2, 0.2], [x + 0.1, 0.2, 0.2], [*x, 0.3, 0.2]]);
        TriangleMesh {
            positions: positions.collect(),
            triangles: (0..at.len() as u32).map(|i| [3 * i, 3 * i + 1, 3 * i + 2]).collect(),
            ..TriangleMesh::default()
        }
    }

    /// Identifier and number of triangles.
    fn told(markers: &[MeshMarker]) -> Vec<(i32, usize)> {
        markers.iter().map(|m| (m.id, m.triangles.len())).collect()
    }

    #[test]
    fn only_what_changed_is_told_and_what_is_gone_is_deleted() {
        let mut patches = Patches::default();
        assert_eq!(told(&patches.changes(&mesh(&[0.2, 0.5, 5.2]), false)), [(0, 2), (1, 1)]);
        assert_eq!(told(&patches.changes(&mesh(&[0.2, 0.5, 5.2]), false)), []);
        assert_eq!(told(&patches.changes(&mesh(&[0.2, 0.5, 5.3, -0.5]), false)), [(2, 1), (1, 1)]);
        assert_eq!(told(&patches.changes(&mesh(&[0.2, 0.5, -0.5]), false)), [(1, 0)]);
        assert_eq!(told(&patches.changes(&mesh(&[0.2, 0.5, -0.5]), false)), [], "deleted once");
        let again = patches.changes(&mesh(&[0.2, 0.5, -0.5, 5.3]), false);
        assert_eq!(told(&again), [(1, 1)], "the same place has the same name");
        assert_eq!(told(&patches.changes(&mesh(&[0.2, 0.5]), true)), [(2, 0), (1, 0), (0, 2)]);
    }

    #[test]
    fn whoever_comes_later_is_told_everything_in_time() {
        let mut patches = Patches::default();
        let counts: Vec<usize> = (0..21).map(|_| patches.changes(&mesh(&[0.2, 5.2]), false).len()).collect();
        assert_eq!((counts[0], counts[10], counts[20], counts.iter().sum::<usize>()), (2, 2, 2, 6));
    }
}
