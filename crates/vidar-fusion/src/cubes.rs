//! The triangles of marching cubes (Lorensen & Cline, SIGGRAPH 1987), derived instead of copied.
//!
//! A cube has corner `c` at offset (c & 1, c >> 1 & 1, c >> 2 & 1) and is described by the set of corners that are
//! *inside* (negative). On each face, the boundary of every run of inside corners is one directed segment between
//! two cut edges, so two diagonal inside corners are always kept apart: a rule that reads only the face, hence two
//! cubes that share it agree and no hole opens. A cut edge ends one segment and starts another, so segments chain
//! into loops, counter-clockwise seen from the positive side. Loops are cut into triangles by diagonals that never
//! lie in a face, because the neighbour could draw the same one there and four triangles would meet in it.

use std::sync::LazyLock;

/// Edges of a cube: `axis · 4 + position of the other two coordinates`.
pub(crate) const EDGES: usize = 12;

/// Triangles of one case, as edges of the cube.
pub(crate) type Triangles = Vec<[u8; 3]>;

/// The triangles of all 256 cases; bit `c` of the case is set when corner `c` is inside.
pub(crate) fn triangle_table() -> &'static [Triangles; 256] {
    static TABLE: LazyLock<[Triangles; 256]> = LazyLock::new(|| {
        std::array::from_fn(|case| loops(case).iter().flat_map(|l| triangulate(l)).collect())
    });
    &TABLE
}

/// The edge along `axis` that starts at corner `base` (whose bit `axis` is 0).
fn edge(base: usize, axis: usize) -> u8 {
    let (b, c) = ((axis + 1) % 3, (axis + 2) % 3);
    (axis * 4 + (base >> b & 1) + 2 * (base >> c & 1)) as u8
}

/// Corner at which an edge starts, and its axis.
pub(crate) fn edge_start(edge: u8) -> (usize, usize) {
    let (axis, position) = (edge as usize / 4, edge as usize % 4);
    let (b, c) = ((axis + 1) % 3, (axis + 2) % 3);
    ((position & 1) << b | (position >> 1) << c, axis)
}

fn edge_between(one: usize, other: usize) -> u8 {
    edge(one & other, (one ^ other).trailing_zeros() as usize)
}

/// The corners of a face, counter-clockwise seen from outside the cube.
fn face_corners(axis: usize, side: usize) -> [usize; 4] {
    let (b, c) = (1 << ((axis + 1) % 3), 1 << ((axis + 2) % 3));
    let base = side << axis;
    if side == 1 {
        [base, base | b, base | b | c, base | c]
    } else {
        [base, base | c, base | b | c, base | b]
    }
}

/// The directed segments that the surface draws on a face.
fn face_segments(case: usize, axis: usize, side: usize) -> Vec<[u8; 2]> {
    let corners = face_corners(axis, side);
    let inside = |i: usize| case >> corners[i % 4] & 1 == 1;
    let mut segments = Vec::new();
    for first in (0..4).filter(|&i| inside(i) && !inside(i + 3)) {
        let mut last = first;
        while inside(last + 1) {
            last += 1;
        }
        let enter = edge_between(corners[(first + 3) % 4], corners[first]);
        let leave = edge_between(corners[last % 4], corners[(last + 1) % 4]);
        segments.push([enter, leave]);
    }
    segments
}

fn loops(case: usize) -> Vec<Vec<u8>> {
    let mut next = [None; EDGES];
    for (axis, side) in FACES {
        for [from, to] in face_segments(case, axis, side) {
            next[from as usize] = Some(to);
        }
    }
    let mut loops = Vec::new();
    for start in 0..EDGES {
        let mut chain = Vec::new();
        let mut at = start;
        while let Some(to) = next[at].take() {
            chain.push(at as u8);
            at = to as usize;
        }
        if !chain.is_empty() {
            loops.push(chain);
        }
    }
    loops
}

const FACES: [(usize, usize); 6] = [(0, 0), (0, 1), (1, 0), (1, 1), (2, 0), (2, 1)];

/// Whether two edges lie in a common face.
fn share_face(one: u8, other: u8) -> bool {
    let on = |e: u8, axis: usize, side: usize| {
        let (start, along) = edge_start(e);
        along != axis && start >> axis & 1 == side
    };
    FACES.iter().any(|&(axis, side)| on(one, axis, side) && on(other, axis, side))
}

/// Cuts a polygon into triangles without diagonals in a face; there is always a way (tested for all cases).
fn triangulate(polygon: &[u8]) -> Triangles {
    fn cut(polygon: &[u8], from: usize, to: usize, out: &mut Triangles) -> bool {
        if to - from < 2 {
            return true;
        }
        let drawable = |a: usize, b: usize| {
            let neighbours = b - a == 1 || (a == 0 && b == polygon.len() - 1);
            neighbours || !share_face(polygon[a], polygon[b])
        };
        for between in from + 1..to {
            let kept = out.len();
            if drawable(from, between)
                && drawable(between, to)
                && cut(polygon, from, between, out)
                && cut(polygon, between, to, out)
            {
                out.push([polygon[from], polygon[between], polygon[to]]);
                return true;
            }
            out.truncate(kept);
        }
        false
    }
    let mut triangles = Vec::new();
    let done = cut(polygon, 0, polygon.len() - 1, &mut triangles);
    debug_assert!(done, "polygon {polygon:?} needs a diagonal in a face");
    triangles
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashMap;

    fn directed_edges(case: usize) -> HashMap<[u8; 2], i32> {
        let mut count = HashMap::new();
        for t in &triangle_table()[case] {
            for i in 0..3 {
                *count.entry([t[i], t[(i + 1) % 3]]).or_insert(0) += 1;
            }
        }
        count
    }

    #[test]
    fn every_case_is_a_surface_bounded_exactly_by_its_face_segments() {
        for case in 0..256 {
            let edges = directed_edges(case);
            assert!(edges.values().all(|&n| n == 1), "case {case}: an edge is drawn twice in one direction");
            let mut border: Vec<[u8; 2]> =
                edges.keys().copied().filter(|[a, b]| !edges.contains_key(&[*b, *a])).collect();
            let mut segments: Vec<[u8; 2]> =
                FACES.iter().flat_map(|&(axis, side)| face_segments(case, axis, side)).collect();
            border.sort_unstable();
            segments.sort_unstable();
            assert_eq!(border, segments, "case {case}");
            // Diagonals lie inside the cube, never in a face.
            for [a, b] in edges.keys().filter(|e| !border.contains(e) && !border.contains(&[e[1], e[0]])) {
                assert!(!share_face(*a, *b), "case {case}: diagonal {a}-{b} lies in a face");
            }
        }
    }

    #[test]
    fn all_cut_edges_and_no_others_carry_vertices() {
        for case in 0..256usize {
            for e in 0..EDGES as u8 {
                let (start, axis) = edge_start(e);
                assert_eq!(edge(start, axis), e);
                let cut = (case >> start ^ case >> (start | 1 << axis)) & 1 == 1;
                let used = triangle_table()[case].iter().flatten().any(|&v| v == e);
                assert_eq!(cut, used, "case {case}, edge {e}");
            }
        }
    }

    #[test]
    fn all_cases_fit_all_their_possible_neighbours_on_every_face() {
        for axis in 0..3usize {
            for case in 0..256usize {
                // All neighbours across the face `side = 1`: their corners of side 0 are the case's of side 1.
                let shared = (0..8).filter(|c| c >> axis & 1 == 1 && case >> c & 1 == 1);
                let fixed = shared.fold(0, |bits, c: usize| bits | 1 << (c & !(1 << axis)));
                for free in 0..256usize {
                    let on_far_side = (0..8).all(|c| free >> c & 1 == 0 || c >> axis & 1 == 1);
                    if !on_far_side {
                        continue;
                    }
                    let neighbour = fixed | free;
                    // The same edge seen from the neighbour starts at a corner without the axis bit.
                    let seen_there = |e: u8| {
                        let (start, along) = edge_start(e);
                        edge(start & !(1 << axis), along)
                    };
                    let mut here: Vec<[u8; 2]> = face_segments(case, axis, 1)
                        .iter()
                        .map(|&[a, b]| [seen_there(b), seen_there(a)])
                        .collect();
                    let mut there = face_segments(neighbour, axis, 0);
                    here.sort_unstable();
                    there.sort_unstable();
                    assert_eq!(here, there, "case {case:08b} beside {neighbour:08b} across axis {axis}");
                }
            }
        }
    }

    #[test]
    fn a_single_inside_corner_is_cut_off_facing_away_from_it() {
        // Corner 0 inside: one triangle on the x, y and z edges, counter-clockwise from (+,+,+).
        let table = triangle_table();
        assert_eq!(table[1].len(), 1);
        let mut t = table[1][0];
        let first = t.iter().position(|&e| e == edge(0, 0)).unwrap();
        t.rotate_left(first);
        assert_eq!(t, [edge(0, 0), edge(0, 1), edge(0, 2)]);
        assert!(table[0].is_empty() && table[255].is_empty());
        // The complement is cut in the same place and turned over.
        let most = table.iter().map(Vec::len).max();
        assert!(most <= Some(6), "{most:?}");
    }
}
