//! A surface as patches, so that of one that grows only what changed is told: to viewers (MCAP) and to ROS 2.

use std::collections::BTreeMap;
use std::hash::{DefaultHasher, Hash, Hasher};
use vidar_core::{PointCloud, TriangleMesh};

/// Edge of the cube that a patch lies in, metres: at voxels of 2 cm some thousand triangles.
const EDGE_M: f32 = 1.0;
/// After so many surfaces every patch is told again: whoever came later, or lost a message, has the whole map by then.
const WHOLE_EVERY: u32 = 10;

/// A part of a surface under a number that it keeps.
#[derive(Clone, Debug, PartialEq)]
pub struct SurfacePatch {
    /// The same for the same cube of the world.
    pub id: u32,
    /// Vertices in the world, m; without triangles where the cube is empty now.
    pub mesh: TriangleMesh,
}

/// What must be told of a surface to who knows what was told before.
#[derive(Clone, Debug, PartialEq)]
pub struct SurfaceChange {
    /// All of the surface is told; what was told before is void.
    pub is_whole: bool,
    /// The patches that changed, by number.
    pub patches: Vec<SurfacePatch>,
}

/// What was told of each patch.
#[derive(Clone, Debug, Default)]
pub struct SurfacePatches {
    told: BTreeMap<[i32; 3], Told>,
    surfaces: u32,
}

#[derive(Clone, Debug)]
struct Told {
    id: u32,
    /// Of its triangles; none once it is known to be empty.
    content: Option<u64>,
}

impl SurfacePatches {
    /// The change to this surface; the whole of a final one, of the first and of every tenth.
    pub fn change(&mut self, mesh: &TriangleMesh, is_final: bool) -> SurfaceChange {
        let is_whole = is_final || self.surfaces.is_multiple_of(WHOLE_EVERY);
        self.surfaces = self.surfaces.wrapping_add(1);
        let present = split(mesh);
        let mut patches = Vec::new();
        for (cube, told) in &mut self.told {
            if told.content.is_some() && !present.contains_key(cube) {
                told.content = None;
                patches.push(SurfacePatch { id: told.id, mesh: TriangleMesh::default() });
            }
        }
        for (cube, part) in present {
            let content = Some(fingerprint(&part));
            let next = self.told.len() as u32;
            let told = self.told.entry(cube).or_insert(Told { id: next, content: None });
            if is_whole || told.content != content {
                told.content = content;
                patches.push(SurfacePatch { id: told.id, mesh: part });
            }
        }
        patches.sort_by_key(|patch| patch.id);
        SurfaceChange { is_whole, patches }
    }
}

/// At most `most` vertices of a mesh, evenly chosen; grey where it has no colours.
pub fn thinned_vertices(mesh: &TriangleMesh, most: usize) -> PointCloud {
    let step = mesh.positions.len().div_ceil(most.max(1)).max(1);
    PointCloud {
        positions: mesh.positions.iter().step_by(step).copied().collect(),
        colors: (0..mesh.positions.len()).step_by(step).map(|i| color(mesh, i)).collect(),
        ..PointCloud::default()
    }
}

fn color(mesh: &TriangleMesh, i: usize) -> [u8; 3] {
    mesh.colors.get(i).copied().unwrap_or([128; 3])
}

/// The triangles by the cube that their first vertex lies in, each part with vertices of its own. Normals and confidences are left out.
fn split(mesh: &TriangleMesh) -> BTreeMap<[i32; 3], TriangleMesh> {
    let mut triangles: BTreeMap<[i32; 3], Vec<[u32; 3]>> = BTreeMap::new();
    for triangle in &mesh.triangles {
        let cube = mesh.positions[triangle[0] as usize].map(|v| (v / EDGE_M).floor() as i32);
        triangles.entry(cube).or_default().push(*triangle);
    }
    // Number of a vertex within its part; of the parts one after the other.
    let mut numbers = vec![u32::MAX; mesh.positions.len()];
    let mut part_of = |triangles: Vec<[u32; 3]>| {
        let mut part = TriangleMesh::default();
        let mut vertices = Vec::new();
        for triangle in triangles {
            part.triangles.push(triangle.map(|v| {
                let number = &mut numbers[v as usize];
                if *number == u32::MAX {
                    *number = vertices.len() as u32;
                    vertices.push(v as usize);
                }
                *number
            }));
        }
        part.positions = vertices.iter().map(|v| mesh.positions[*v]).collect();
        part.colors = vertices.iter().map(|v| color(mesh, *v)).collect();
        vertices.iter().for_each(|v| numbers[*v] = u32::MAX);
        part
    };
    triangles.into_iter().map(|(cube, triangles)| (cube, part_of(triangles))).collect()
}

/// Of positions, colours and triangles. Nobody chooses them to collide.
fn fingerprint(mesh: &TriangleMesh) -> u64 {
    let mut hasher = DefaultHasher::new();
    for (position, color) in mesh.positions.iter().zip(&mesh.colors) {
        position.map(f32::to_bits).hash(&mut hasher);
        color.hash(&mut hasher);
    }
    mesh.triangles.hash(&mut hasher);
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

    /// Number and triangles of each patch.
    fn told(change: &SurfaceChange) -> Vec<(u32, usize)> {
        change.patches.iter().map(|patch| (patch.id, patch.mesh.triangles.len())).collect()
    }

    #[test]
    fn only_what_changed_is_told_and_what_is_gone_is_empty() {
        let mut patches = SurfacePatches::default();
        let mut change = |at: &[f32], is_final| patches.change(&mesh(at), is_final);
        let first = change(&[0.2, 0.5, 5.2], false);
        assert!(first.is_whole);
        assert_eq!(told(&first), [(0, 2), (1, 1)]);
        let same = change(&[0.2, 0.5, 5.2], false);
        assert!(!same.is_whole);
        assert_eq!(told(&same), []);
        assert_eq!(told(&change(&[0.2, 0.5, 5.3, -0.5], false)), [(1, 1), (2, 1)]);
        assert_eq!(told(&change(&[0.2, 0.5, -0.5], false)), [(1, 0)]);
        assert_eq!(told(&change(&[0.2, 0.5, -0.5], false)), [], "told to be empty once");
        assert_eq!(told(&change(&[0.2, 0.5, -0.5, 5.3], false)), [(1, 1)], "the same place, the same number");
        let last = change(&[0.2, 0.5], true);
        assert!(last.is_whole);
        assert_eq!(told(&last), [(0, 2), (1, 0), (2, 0)]);
    }

    #[test]
    fn whoever_comes_later_is_told_everything_in_time() {
        let mut patches = SurfacePatches::default();
        let counts: Vec<_> =
            (0..21).map(|_| patches.change(&mesh(&[0.2, 5.2]), false).patches.len()).collect();
        assert_eq!((counts[0], counts[10], counts[20], counts.iter().sum::<usize>()), (2, 2, 2, 6));
    }

    #[test]
    fn the_patches_together_are_the_surface() {
        // Two triangles on either side of a border share an edge.
        let shared = TriangleMesh {
            positions: vec![[0.9, 0.0, 0.0], [1.1, 0.0, 0.0], [1.1, 0.5, 0.0], [0.9, 0.5, 0.0]],
            colors: vec![[1, 0, 0], [2, 0, 0], [3, 0, 0], [4, 0, 0]],
            triangles: vec![[0, 1, 2], [2, 3, 0]],
            ..TriangleMesh::default()
        };
        let change = SurfacePatches::default().change(&shared, true);
        let corners = |mesh: &TriangleMesh| {
            let corner = |v: u32| (mesh.positions[v as usize], mesh.colors[v as usize]);
            mesh.triangles.iter().map(|t| t.map(corner)).collect::<Vec<_>>()
        };
        let together: Vec<_> = change.patches.iter().flat_map(|patch| corners(&patch.mesh)).collect();
        assert_eq!(together, corners(&shared));
        assert_eq!(change.patches.len(), 2);
        assert_eq!(change.patches[0].mesh.positions.len(), 3);
    }
}
