//! The surface of the volume: marching cubes with shared vertices.
//!
//! A vertex belongs to an edge of the lattice, and an edge to the block of its first node. First every block places
//! its vertices, then every block connects them, looking up those of its neighbours; both in parallel, in the order
//! of keys. A cube is used when all of its corners are observed, so the mesh ends where observation does.

use crate::components::remove_small_components;
use crate::cubes::{Triangles, edge_start, triangle_table};
use crate::field::{Field, Neighbourhood};
use crate::grid::{EDGE, NODES, node_of};
use crate::volume::TsdfVolume;
use rayon::prelude::*;
use vidar_core::TriangleMesh;

/// Vertices keep this share of an edge away from its ends, so that no two of them coincide.
const END_MARGIN: f32 = 0.002;

/// Vertices of one block in the order of their edges (node · 3 + axis), and which edges those are.
struct BlockVertices {
    edges: EdgeSet,
    vertices: Vec<Vertex>,
}

/// Edges of a block as bits, with the number of those before each word: a list of all edges would take ten times as much, and a mesh has
/// tens of thousands of blocks.
#[derive(Default)]
struct EdgeSet {
    words: [u64; EDGE_WORDS],
    before: [u16; EDGE_WORDS],
}

const EDGE_WORDS: usize = NODES * 3 / 64;

impl EdgeSet {
    /// Adds an edge, in ascending order.
    fn push(&mut self, edge: usize) {
        self.words[edge / 64] |= 1 << (edge % 64);
        self.before[edge / 64 + 1..].iter_mut().for_each(|n| *n += 1);
    }

    /// How many edges of the set come before this one; `None` where it is not in the set.
    fn rank(&self, edge: usize) -> Option<u32> {
        let (word, bit) = (self.words[edge / 64], 1u64 << (edge % 64));
        (word & bit != 0).then(|| u32::from(self.before[edge / 64]) + (word & (bit - 1)).count_ones())
    }
}

struct Vertex {
    position: [f32; 3],
    normal: [f32; 3],
    color: [u8; 3],
    confidence: f32,
}

impl TsdfVolume {
    /// The zero level of the distance as a mesh: vertices shared by all triangles around them, counter-clockwise
    /// as seen by the cameras, with unit normals toward them, colours (when any view had one) and confidences.
    ///
    /// Closed wherever all eight corners of a cube were observed. The same bits for any order of the views and any
    /// number of threads.
    pub fn extract_mesh(&self) -> TriangleMesh {
        let field = Field::new(self);
        let colored = self.blocks.iter().any(|b| b.color.is_some());
        let vertices: Vec<Option<BlockVertices>> = (0..field.len())
            .into_par_iter()
            .with_min_len(8)
            .map(|at| place_vertices(&field, at, self.config().voxel_size_m))
            .collect();
        let mut next = 0u32;
        let first: Vec<u32> = vertices
            .iter()
            .map(|p| {
                let first = next;
                next += p.as_ref().map_or(0, |p| p.vertices.len() as u32);
                first
            })
            .collect();
        let table = triangle_table();
        let triangles: Vec<Vec<[u32; 3]>> = (0..field.len())
            .into_par_iter()
            .with_min_len(8)
            .map(|at| connect_vertices(&field, at, &vertices, &first, table))
            .collect();
        drop(field);
        let mut mesh = TriangleMesh { triangles: triangles.concat(), ..TriangleMesh::default() };
        drop(triangles);
        let count = next as usize;
        mesh.positions.reserve_exact(count);
        mesh.normals.reserve_exact(count);
        mesh.confidences.reserve_exact(count);
        mesh.colors.reserve_exact(if colored { count } else { 0 });
        for vertex in vertices.iter().flatten().flat_map(|p| &p.vertices) {
            mesh.positions.push(vertex.position);
            mesh.normals.push(vertex.normal);
            mesh.confidences.push(vertex.confidence);
            if colored {
                mesh.colors.push(vertex.color);
            }
        }
        drop(vertices);
        remove_small_components(mesh, self.config().min_component_triangles as usize)
    }
}

/// Places a vertex on every edge of block `at` whose ends are observed on different sides of the surface.
fn place_vertices(field: &Field<'_>, at: usize, voxel_m: f64) -> Option<BlockVertices> {
    let around = field.neighbourhood(at)?;
    let mut edges = EdgeSet::default();
    let mut vertices = Vec::new();
    for node in 0..NODES {
        let node_index = [node % EDGE, node / EDGE % EDGE, node / (EDGE * EDGE)];
        let here = Neighbourhood::at(node_index[0], node_index[1], node_index[2]);
        for axis in 0..3 {
            let (a, b) = (around.value(here), around.value(here + Neighbourhood::STRIDE[axis]));
            // A NaN is on no side.
            if !((a < 0.0 && b > 0.0) || (a > 0.0 && b < 0.0)) {
                continue;
            }
            edges.push(node * 3 + axis);
            let t = (a / (a - b)).clamp(END_MARGIN, 1.0 - END_MARGIN);
            vertices.push(vertex(field, &around, [at, node, axis], t, voxel_m)?);
        }
    }
    vertices.shrink_to_fit();
    Some(BlockVertices { edges, vertices })
}

/// The vertex at share `t` of the edge [block, node, axis].
fn vertex(
    field: &Field<'_>,
    around: &Neighbourhood,
    [at, node, axis]: [usize; 3],
    t: f32,
    voxel_m: f64,
) -> Option<Vertex> {
    let mut node_index = [node % EDGE, node / EDGE % EDGE, node / (EDGE * EDGE)];
    let here = Neighbourhood::at(node_index[0], node_index[1], node_index[2]);
    node_index[axis] += 1;
    let (other_block, other_node) = around.owner(node_index)?;
    let ends = [(field.blocks[at], node), (field.blocks[other_block as usize], other_node)];
    let mix = |a: f32, b: f32| a + t * (b - a);

    let mut position = node_of(field.keys[at], node).map(f64::from);
    position[axis] += f64::from(t);
    let (g0, g1) = (around.gradient(here), around.gradient(here + Neighbourhood::STRIDE[axis]));
    let gradient = [0, 1, 2].map(|i| mix(g0[i], g1[i]));
    let norm = gradient.iter().map(|g| g * g).sum::<f32>().sqrt();
    // The distance changes sign along this edge, so its slope there is not zero and a normal can be had.
    let normal = if norm > 0.0 {
        gradient.map(|g| g / norm)
    } else {
        let sign = (around.value(here + Neighbourhood::STRIDE[axis]) - around.value(here)).signum();
        std::array::from_fn(|i| if i == axis { sign } else { 0.0 })
    };
    let confidences = ends.map(|(block, node)| block.mean_confidence(node));
    let color = match ends.map(|(block, node)| block.mean_color(node)) {
        [Some(a), Some(b)] => [0, 1, 2].map(|c| mix(a[c], b[c])),
        [Some(c), None] | [None, Some(c)] => c,
        [None, None] => [0.0; 3],
    };
    Some(Vertex {
        position: position.map(|p| (p * voxel_m) as f32),
        normal,
        color: color.map(|c| c.round() as u8),
        confidence: mix(confidences[0], confidences[1]),
    })
}

/// The triangles of the cubes that start in block `at`.
fn connect_vertices(
    field: &Field<'_>,
    at: usize,
    vertices: &[Option<BlockVertices>],
    first: &[u32],
    table: &[Triangles; 256],
) -> Vec<[u32; 3]> {
    let mut triangles = Vec::new();
    let Some(around) = field.neighbourhood(at) else { return triangles };
    for node in 0..NODES {
        let node_index = [node % EDGE, node / EDGE % EDGE, node / (EDGE * EDGE)];
        let Some(case) = cube_case(&around, node_index) else { continue };
        for triangle in &table[case] {
            let indices = triangle.map(|edge| {
                let (corner, axis) = edge_start(edge);
                let start = [0, 1, 2].map(|a| node_index[a] + (corner >> a & 1));
                let (block, node) = around.owner(start)?;
                let vertex = vertices[block as usize].as_ref()?.edges.rank(node * 3 + axis)?;
                Some(first[block as usize] + vertex)
            });
            if let [Some(a), Some(b), Some(c)] = indices {
                triangles.push([a, b, c]);
            } else {
                debug_assert!(false, "a cut edge of a fully observed cube has no vertex");
            }
        }
    }
    triangles
}

/// Which corners of the cube at `node_index` are behind the surface; `None` unless all are observed.
fn cube_case(around: &Neighbourhood, node_index: [usize; 3]) -> Option<usize> {
    let start = Neighbourhood::at(node_index[0], node_index[1], node_index[2]);
    let mut case = 0;
    for corner in 0..8 {
        let [sx, sy, sz] = Neighbourhood::STRIDE;
        let value = around.value(start + (corner & 1) * sx + (corner >> 1 & 1) * sy + (corner >> 2 & 1) * sz);
        if value.is_nan() {
            return None;
        }
        case |= usize::from(value < 0.0) << corner;
    }
    Some(case)
}
