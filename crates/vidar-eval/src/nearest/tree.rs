//! A balanced tree of tight boxes over points.
//!
//! Each node holds the bounding box of its own points, without the empty space beside them that the cells of a k-d tree
//! have. A query far from a surface therefore visits only the parts of it that are nearly as close as the nearest point. Squared distances are
//! `f32`, `(dx² + dy²) + dz²` without fused operations; rounding is monotonic, so that a box is never farther by them
//! than a point in it, and the search is exact with respect to these numbers on every processor.

/// Points of a leaf: one wide instruction, or two, for each step of its distances.
const LEAF: usize = 16;

/// Points below which a part of the tree is built by one task.
const PARALLEL_POINTS: usize = 1 << 14;

/// Levels below the root at most: 2³² points in leaves of sixteen, and the root.
const MAX_DEPTH: usize = 32;

/// A point and its index in the list it comes from.
pub(super) type Item = ([f32; 3], u32);

/// A node: in the order in which a walk meets them, the first child directly behind its parent.
#[derive(Clone, Copy, Debug)]
struct Node {
    min: [f32; 3],
    max: [f32; 3],
    /// The second child, or 0 in a leaf.
    second: u32,
    /// The first leaf below this node, itself included.
    leaf: u32,
}

/// Coordinates side by side; places without a point are infinitely far.
#[derive(Clone, Debug)]
struct Leaf {
    coordinates: [[f32; LEAF]; 3],
}

/// See the module's head.
#[derive(Debug)]
pub(super) struct Tree {
    nodes: Vec<Node>,
    leaves: Vec<Leaf>,
    /// The given index of the point in each place of the leaves.
    ids: Vec<u32>,
}

/// The nearest point of a query, as its place in the leaves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Found {
    pub place: u32,
    pub squared: f32,
}

impl Tree {
    /// Builds the tree over finite points with their indices; `None` without points.
    pub(super) fn new(mut items: Vec<Item>) -> Option<Self> {
        if items.is_empty() {
            return None;
        }
        let leaves = items.len().div_ceil(LEAF);
        let mut nodes = vec![Node { min: [0.0; 3], max: [0.0; 3], second: 0, leaf: 0 }; 2 * leaves - 1];
        split(&mut items, &mut nodes, (0, 0));
        let empty = Leaf { coordinates: [[f32::INFINITY; LEAF]; 3] };
        let filled = |chunk: &[Item]| {
            let mut leaf = empty.clone();
            for (place, (p, _)) in chunk.iter().enumerate() {
                (0..3).for_each(|k| leaf.coordinates[k][place] = p[k]);
            }
            leaf
        };
        let leaves = items.chunks(LEAF).map(filled).collect();
        Some(Self { nodes, leaves, ids: items.iter().map(|(_, id)| *id).collect() })
    }

    /// Index of the point in `place` among those given.
    pub(super) fn id(&self, place: u32) -> u32 {
        self.ids[place as usize]
    }

    /// Number of points.
    pub(super) fn len(&self) -> usize {
        self.ids.len()
    }

    /// Smallest and largest coordinates.
    pub(super) fn bounds(&self) -> ([f32; 3], [f32; 3]) {
        (self.nodes[0].min, self.nodes[0].max)
    }

    /// The point in `place`.
    pub(super) fn position(&self, place: u32) -> [f32; 3] {
        let leaf = &self.leaves[place as usize / LEAF];
        [0, 1, 2].map(|k| leaf.coordinates[k][place as usize % LEAF])
    }

    /// Squared distance from `query` to the point in `place`.
    pub(super) fn squared_to(&self, query: &[f32; 3], place: u32) -> f32 {
        let p = self.position(place);
        squares(query, &p)
    }

    /// The nearest point strictly nearer than `start.squared`, else `start`.
    pub(super) fn nearest(&self, query: &[f32; 3], start: Found) -> Found {
        let mut best = start;
        self.walk(query, |leaf, visited| {
            if let Some(visited) = visited {
                best = nearer(best, leaf, visited);
            }
            best.squared
        });
        best
    }

    /// The nearest point, as [`nearest`](Self::nearest) from `start`, and a squared distance that no other point is below.
    pub(super) fn nearest_two(&self, query: &[f32; 3], start: Found) -> (Found, f32) {
        let (mut best, mut second) = (start, f32::INFINITY);
        self.walk(query, |leaf, visited| {
            if let Some(squared) = visited {
                for (place, &squared) in (leaf * LEAF as u32..).zip(squared) {
                    if squared < best.squared {
                        if place != best.place {
                            second = best.squared;
                        }
                        best = Found { place, squared };
                    } else if squared < second && place != best.place {
                        second = squared;
                    }
                }
            }
            second
        });
        (best, second)
    }

    /// Gives `visit` the leaves that are nearer than the squared limit that it returned last, nearest children first;
    /// at first without distances, for the limit alone.
    fn walk(&self, query: &[f32; 3], mut visit: impl FnMut(u32, Option<&[f32; LEAF]>) -> f32) {
        let mut limit = visit(0, None);
        let mut waiting = [(0_u32, 0_f32); MAX_DEPTH];
        let mut count = 0;
        let mut at = 0_u32;
        if !(squared_to_box(query, &self.nodes[0]) < limit) {
            return;
        }
        loop {
            let node = &self.nodes[at as usize];
            if node.second == 0 {
                limit = visit(node.leaf, Some(&squared_in(query, &self.leaves[node.leaf as usize])));
            } else {
                let first = (at + 1, squared_to_box(query, &self.nodes[at as usize + 1]));
                let second = (node.second, squared_to_box(query, &self.nodes[node.second as usize]));
                let (near, far) = if second.1 < first.1 { (second, first) } else { (first, second) };
                if far.1 < limit {
                    waiting[count] = far;
                    count += 1;
                }
                if near.1 < limit {
                    at = near.0;
                    continue;
                }
            }
            // The nearest that waits is not always the last, but the last is the one whose neighbours are in the cache.
            loop {
                if count == 0 {
                    return;
                }
                count -= 1;
                if waiting[count].1 < limit {
                    at = waiting[count].0;
                    break;
                }
            }
        }
    }
}

/// `best`, or the first of the nearest of a leaf where it is nearer.
fn nearer(best: Found, leaf: u32, squared: &[f32; LEAF]) -> Found {
    let least = squared.iter().fold(f32::INFINITY, |a, &b| if b < a { b } else { a });
    if !(least < best.squared) {
        return best;
    }
    let place = squared.iter().position(|&s| s == least).unwrap_or(0);
    Found { place: leaf * LEAF as u32 + place as u32, squared: least }
}

fn squares(a: &[f32; 3], b: &[f32; 3]) -> f32 {
    let [x, y, z] = [b[0] - a[0], b[1] - a[1], b[2] - a[2]];
    (x * x + y * y) + z * z
}

fn squared_in(query: &[f32; 3], leaf: &Leaf) -> [f32; LEAF] {
    let [xs, ys, zs] = &leaf.coordinates;
    std::array::from_fn(|i| squares(query, &[xs[i], ys[i], zs[i]]))
}

fn squared_to_box(query: &[f32; 3], node: &Node) -> f32 {
    let larger = |a: f32, b: f32| if a > b { a } else { b };
    let outside = |k: usize| larger(larger(node.min[k] - query[k], query[k] - node.max[k]), 0.0);
    let [x, y, z] = [outside(0), outside(1), outside(2)];
    (x * x + y * y) + z * z
}

/// Orders `items` for the leaves and fills `nodes`, which has one node for each leaf and one for each two parts. `first` is the
/// index of the first of these nodes and of the first of these leaves.
fn split(items: &mut [Item], nodes: &mut [Node], (node, leaf): (u32, u32)) {
    let (mut min, mut max) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
    for (p, _) in items.iter() {
        for k in 0..3 {
            min[k] = if p[k] < min[k] { p[k] } else { min[k] };
            max[k] = if p[k] > max[k] { p[k] } else { max[k] };
        }
    }
    let Some((own, below)) = nodes.split_first_mut() else { return };
    *own = Node { min, max, second: 0, leaf };
    let leaves = items.len().div_ceil(LEAF);
    if leaves < 2 {
        return;
    }
    // Full leaves on the left, so that only the last one of all has places without a point.
    let left = leaves / 2;
    let axis = (1..3).fold(0, |best, k| if max[k] - min[k] > max[best] - min[best] { k } else { best });
    // Equal coordinates are told apart by the index: the same tree on every machine.
    items.select_nth_unstable_by(left * LEAF, |a, b| {
        a.0[axis].total_cmp(&b.0[axis]).then_with(|| a.1.cmp(&b.1))
    });
    let nodes_left = 2 * left - 1;
    own.second = node + 1 + nodes_left as u32;
    let (items_left, items_right) = items.split_at_mut(left * LEAF);
    let (below_left, below_right) = below.split_at_mut(nodes_left);
    let places = ((node + 1, leaf), (own.second, leaf + left as u32));
    if items_left.len() < PARALLEL_POINTS {
        split(items_left, below_left, places.0);
        split(items_right, below_right, places.1);
    } else {
        rayon::join(|| split(items_left, below_left, places.0), || split(items_right, below_right, places.1));
    }
}
