//! Fewer triangles by vertex clustering with quadric placement (Lindstrom, "Out-of-core simplification of large polygonal
//! models", SIGGRAPH 2000).
//!
//! Vertices in one cell of a grid that face the same way become one vertex, placed where the squared distance to the planes of
//! their triangles is smallest, so that edges and corners of rooms stay sharp. The cell is found so that the wanted number of
//! triangles is met. One pass over vertices and triangles in their order: the same mesh gives the same bytes.

use super::grid::{ATTEMPTS, Cell, NEAR_ENOUGH, cell_of};
use nalgebra::{Matrix3, SymmetricEigen, Vector3};
use std::collections::{HashMap, HashSet};
use vidar_core::TriangleMesh;

/// Eigenvalues below this share of the largest are those of directions in which planes do not fix the vertex (Lindstrom's bound).
const RANK_BOUND: f64 = 1e-3;
/// A vertex of no cluster.
const NONE: u32 = u32::MAX;

/// A mesh with at most `most` triangles, and the side of its cells, metres. A mesh within the limit keeps its vertices.
pub(super) fn simplified(mesh: &TriangleMesh, most: usize) -> (TriangleMesh, f64) {
    let finite = |i: u32| mesh.positions[i as usize].iter().all(|v| v.is_finite());
    let triangles: Vec<[u32; 3]> =
        mesh.triangles.iter().copied().filter(|t| t.iter().all(|&i| finite(i))).collect();
    let normals = vertex_normals(mesh, &triangles);
    let area: f64 = triangles.iter().map(|t| cross(mesh, t).norm() / 2.0).sum();
    if triangles.len() <= most {
        let side = (2.0 * area / triangles.len().max(1) as f64).sqrt();
        return (TriangleMesh { normals, triangles, ..mesh.clone() }, side.max(1e-6));
    }
    // Two triangles per cell that the surface crosses, and an oblique surface crosses half as many again.
    let mut side = (3.0 * area / most.max(1) as f64).sqrt().max(1e-6);
    let mut best: Option<Clustering> = None;
    for _ in 0..ATTEMPTS {
        let clustering = Clustering::new(mesh, &normals, &triangles, side);
        let count = clustering.triangles.len();
        let share = count as f64 / most.max(1) as f64;
        if share <= 1.0 && best.as_ref().is_none_or(|b| count > b.triangles.len()) {
            best = Some(clustering);
        }
        if (NEAR_ENOUGH..=1.0).contains(&share) {
            break;
        }
        side *= (share / 0.93).sqrt().clamp(0.1, 10.0);
    }
    let Some(best) = best else { return (TriangleMesh::default(), side) };
    let side = best.side_m;
    (placed(mesh, &normals, &triangles, best), side)
}

/// Vertices grouped by cells of a grid.
struct Clustering {
    /// The cluster of each vertex.
    cluster_of: Vec<u32>,
    /// Number of clusters.
    clusters: usize,
    /// Triangles between clusters.
    triangles: Vec<[u32; 3]>,
    side_m: f64,
}

impl Clustering {
    fn new(mesh: &TriangleMesh, normals: &[[f32; 3]], triangles: &[[u32; 3]], side_m: f64) -> Self {
        let (cluster_of, clusters) = clustered(mesh, normals, side_m);
        let triangles = merged(triangles, &cluster_of);
        Self { cluster_of, clusters, triangles, side_m }
    }
}

/// The cluster of each vertex, numbered in the order of the vertices, and their number.
///
/// Vertices of one cell are kept apart by the axis and sign of their normal: the two faces of a thin wall must not become one.
fn clustered(mesh: &TriangleMesh, normals: &[[f32; 3]], side_m: f64) -> (Vec<u32>, usize) {
    let mut numbers = HashMap::<(Cell, u8), u32>::new();
    let cluster = |(p, n): (&[f32; 3], &[f32; 3])| {
        let Some(cell) = cell_of(p, side_m) else { return NONE };
        let next = numbers.len() as u32;
        *numbers.entry((cell, facing(n))).or_insert(next)
    };
    let cluster_of = mesh.positions.iter().zip(normals).map(cluster).collect();
    (cluster_of, numbers.len())
}

/// Which of the six faces of a cube a normal points through.
fn facing(normal: &[f32; 3]) -> u8 {
    let axis = (0..3).fold(0, |best, i| if normal[i].abs() > normal[best].abs() { i } else { best });
    2 * axis as u8 + u8::from(normal[axis] < 0.0)
}

/// Triangles between three clusters, each once.
fn merged(triangles: &[[u32; 3]], cluster_of: &[u32]) -> Vec<[u32; 3]> {
    let mut seen = HashSet::with_capacity(triangles.len() / 4);
    triangles
        .iter()
        .map(|t| t.map(|i| cluster_of[i as usize]))
        .filter(|&[a, b, c]| a != b && b != c && c != a && ![a, b, c].contains(&NONE))
        .filter(|t| {
            // The same three in the same turn are the same triangle; in the other turn they are its back.
            let first = (0..3).fold(0, |best, i| if t[i] < t[best] { i } else { best });
            seen.insert([t[first], t[(first + 1) % 3], t[(first + 2) % 3]])
        })
        .collect()
}

/// Sums over the vertices and triangles of a cluster.
#[derive(Clone)]
struct Cluster {
    count: f64,
    position: Vector3<f64>,
    normal: Vector3<f64>,
    color: [f64; 3],
    confidence: f64,
    /// Σ n nᵀ and Σ n (n · p) over planes: area vectors n of triangles and those of borders; p is a point of the plane.
    planes: Matrix3<f64>,
    offsets: Vector3<f64>,
}

/// The vertices of clusters, with the means of their attributes.
fn placed(
    mesh: &TriangleMesh,
    normals: &[[f32; 3]],
    triangles: &[[u32; 3]],
    clustering: Clustering,
) -> TriangleMesh {
    let Clustering { cluster_of, clusters, triangles: kept, side_m } = clustering;
    let empty = Cluster {
        count: 0.0,
        position: Vector3::zeros(),
        normal: Vector3::zeros(),
        color: [0.0; 3],
        confidence: 0.0,
        planes: Matrix3::zeros(),
        offsets: Vector3::zeros(),
    };
    let mut sums = vec![empty; clusters];
    for (i, &number) in cluster_of.iter().enumerate().filter(|(_, n)| **n != NONE) {
        let sum = &mut sums[number as usize];
        sum.count += 1.0;
        sum.position += Vector3::from(mesh.positions[i].map(f64::from));
        sum.normal += Vector3::from(normals[i].map(f64::from));
        for (total, c) in sum.color.iter_mut().zip(mesh.colors.get(i).copied().unwrap_or_default()) {
            *total += f64::from(c);
        }
        sum.confidence += f64::from(mesh.confidences.get(i).copied().unwrap_or_default());
    }
    let mut add_plane = |vertices: &[u32], n: Vector3<f64>| {
        let p = Vector3::from(mesh.positions[vertices[0] as usize].map(f64::from));
        for number in vertices.iter().map(|&i| cluster_of[i as usize]).filter(|n| *n != NONE) {
            let sum = &mut sums[number as usize];
            sum.planes += n * n.transpose();
            sum.offsets += n * n.dot(&p);
        }
    };
    for t in triangles {
        add_plane(t, cross(mesh, t));
    }
    // The border of a surface is held by planes across it, else every hole would grow by half a cell.
    for (edge, normal) in borders(mesh, triangles) {
        add_plane(&edge, normal);
    }
    let has = |list: usize| list == mesh.positions.len();
    TriangleMesh {
        positions: sums.iter().map(|s| s.place(side_m)).collect(),
        normals: sums
            .iter()
            .map(|s| s.normal.try_normalize(1e-12).unwrap_or_else(Vector3::z))
            .map(|n| [n.x as f32, n.y as f32, n.z as f32])
            .collect(),
        colors: match has(mesh.colors.len()) {
            true => sums.iter().map(|s| s.color.map(|c| (c / s.count).round() as u8)).collect(),
            false => Vec::new(),
        },
        confidences: match has(mesh.confidences.len()) {
            true => sums.iter().map(|s| (s.confidence / s.count) as f32).collect(),
            false => Vec::new(),
        },
        triangles: kept,
    }
}

/// Edges of one triangle only, each with a vector in the triangle's plane across the edge, as long as the square of the edge:
/// the unit of the triangles' area vectors.
fn borders(mesh: &TriangleMesh, triangles: &[[u32; 3]]) -> Vec<([u32; 2], Vector3<f64>)> {
    let key = |a: u32, b: u32| (u64::from(a.min(b)) << 32) | u64::from(a.max(b));
    let mut edges: Vec<(u64, u32)> = (0_u32..)
        .zip(triangles)
        .flat_map(|(t, &[a, b, c])| [(key(a, b), t), (key(b, c), t), (key(c, a), t)])
        .collect();
    edges.sort_unstable();
    edges
        .chunk_by(|a, b| a.0 == b.0)
        .filter(|same| same.len() == 1)
        .map(|same| {
            let edge = [(same[0].0 >> 32) as u32, same[0].0 as u32];
            let [a, b] = edge.map(|i| Vector3::from(mesh.positions[i as usize].map(f64::from)));
            let normal = cross(mesh, &triangles[same[0].1 as usize]);
            let across = (b - a).cross(&normal.try_normalize(1e-18).unwrap_or_else(Vector3::zeros));
            (edge, across * (b - a).norm())
        })
        .collect()
}

impl Cluster {
    /// The place nearest to all planes, in the directions that planes fix, else the mean; never outside of the cell's reach.
    fn place(&self, side_m: f64) -> [f32; 3] {
        let mean = self.position / self.count;
        let eigen = SymmetricEigen::new(self.planes);
        let residual = self.offsets - self.planes * mean;
        let bound = RANK_BOUND * eigen.eigenvalues.max();
        let mut shift = Vector3::zeros();
        for (value, vector) in eigen.eigenvalues.iter().zip(eigen.eigenvectors.column_iter()) {
            if *value > bound {
                shift += vector * (vector.dot(&residual) / value);
            }
        }
        let is_near = shift.iter().all(|v| v.is_finite()) && shift.amax() <= side_m;
        let place = if is_near { mean + shift } else { mean };
        [place.x as f32, place.y as f32, place.z as f32]
    }
}

/// Twice the area of a triangle as a vector along its normal.
fn cross(mesh: &TriangleMesh, t: &[u32; 3]) -> Vector3<f64> {
    let [a, b, c] = t.map(|i| Vector3::from(mesh.positions[i as usize].map(f64::from)));
    (b - a).cross(&(c - a))
}

/// The mesh's normals, else area-weighted ones of its triangles.
fn vertex_normals(mesh: &TriangleMesh, triangles: &[[u32; 3]]) -> Vec<[f32; 3]> {
    if mesh.normals.len() == mesh.positions.len() {
        return mesh.normals.clone();
    }
    let mut sums = vec![Vector3::<f64>::zeros(); mesh.positions.len()];
    for t in triangles {
        let n = cross(mesh, t);
        t.iter().for_each(|&i| sums[i as usize] += n);
    }
    let unit = |s: &Vector3<f64>| s.try_normalize(1e-12).unwrap_or_else(Vector3::z);
    sums.iter().map(unit).map(|n| [n.x as f32, n.y as f32, n.z as f32]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The walls of a cube of 1 m, each of n × n quads, seen from inside; coloured by the axis of the wall.
    pub(crate) fn room(n: usize) -> TriangleMesh {
        let mut mesh = TriangleMesh::default();
        for axis in 0..3 {
            for side in [0.0, 1.0] {
                let first = mesh.positions.len() as u32;
                let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
                for i in 0..=n {
                    for j in 0..=n {
                        let mut p = [0.0; 3];
                        p[axis] = side;
                        p[u] = i as f32 / n as f32;
                        p[v] = j as f32 / n as f32;
                        mesh.positions.push(p);
                        let mut color = [40; 3];
                        color[axis] = 200;
                        mesh.colors.push(color);
                    }
                }
                let at = |i: usize, j: usize| first + (i * (n + 1) + j) as u32;
                for i in 0..n {
                    for j in 0..n {
                        let quad = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
                        let [a, b, c, d] =
                            if side == 0.0 { quad } else { [quad[0], quad[3], quad[2], quad[1]] };
                        mesh.triangles.extend([[a, b, c], [a, c, d]]);
                    }
                }
            }
        }
        mesh
    }

    #[test]
    fn a_room_keeps_its_shape_colours_and_sides() {
        let mesh = room(80);
        let (small, side) = simplified(&mesh, 4_000);
        assert!((3_000..=4_000).contains(&small.triangles.len()), "{}", small.triangles.len());
        assert!(small.is_consistent() && (0.02..0.1).contains(&side), "{side}");
        for (p, c) in small.positions.iter().zip(&small.colors) {
            let wall = (0..3).find(|&axis| c[axis] == 200).unwrap();
            assert!(p[wall] < 1e-4 || p[wall] > 1.0 - 1e-4, "{p:?} left its wall");
        }
        // Every triangle still faces the inside.
        for t in &small.triangles {
            let n = cross(&small, t);
            let center = Vector3::repeat(0.5);
            let p = Vector3::from(small.positions[t[0] as usize].map(f64::from));
            assert!(n.dot(&(center - p)) >= -1e-9, "{t:?}");
        }
        let area: f64 = small.triangles.iter().map(|t| cross(&small, t).norm() / 2.0).sum();
        assert!((5.95..6.001).contains(&area), "{area} of 6 m²");
    }

    #[test]
    fn both_faces_of_a_thin_wall_stay() {
        let mut fine = room(40);
        fine.positions.iter_mut().for_each(|p| p[2] *= 0.001);
        let (small, _) = simplified(&fine, 1_500);
        let up = |sign: f64| {
            let faces =
                small.triangles.iter().map(|t| cross(&small, t)).filter(|n| n.z * sign > n.norm() * 0.9);
            faces.map(|n| n.norm() / 2.0).sum::<f64>()
        };
        assert!(up(1.0) > 0.85 && up(-1.0) > 0.85, "{} {}", up(1.0), up(-1.0));
    }

    #[test]
    fn a_small_mesh_keeps_its_vertices_and_bad_ones_are_left_out() {
        let mut mesh = room(2);
        let (same, _) = simplified(&mesh, 1_000);
        assert_eq!(
            (same.positions.len(), same.triangles.len()),
            (mesh.positions.len(), mesh.triangles.len())
        );
        mesh.positions[0] = [f32::NAN; 3];
        assert!(simplified(&mesh, 1_000).0.triangles.len() < mesh.triangles.len());
        assert!(simplified(&TriangleMesh::default(), 10).0.triangles.is_empty());
    }
}
