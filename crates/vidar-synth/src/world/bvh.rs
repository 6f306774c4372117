//! A bounding-volume hierarchy over shapes, split at the median of the longest axis.

use super::shape::Shape;
use super::tile::Pyramid;
use crate::extent::Extent;
use nalgebra::Vector3;

/// Shapes per leaf at most.
const LEAF: usize = 2;

#[derive(Clone, Debug)]
struct Node {
    extent: Extent,
    /// First shape of a leaf, or index of the second child (the first follows its parent).
    start: u32,
    /// Shapes of a leaf; 0 for an inner node.
    count: u32,
    /// Axis of the split.
    axis: u8,
}

/// The hierarchy; `order` lists shapes leaf by leaf.
#[derive(Clone, Debug, Default)]
pub(crate) struct Bvh {
    nodes: Vec<Node>,
    order: Vec<u32>,
}

impl Bvh {
    pub(crate) fn new(shapes: &[Shape]) -> Self {
        let extents: Vec<Extent> = shapes.iter().map(Shape::extent).collect();
        let mut bvh = Self { nodes: Vec::new(), order: (0..shapes.len() as u32).collect() };
        if !shapes.is_empty() {
            bvh.split(&extents, 0, shapes.len());
        }
        bvh
    }

    fn split(&mut self, extents: &[Extent], from: usize, until: usize) {
        let of = |i: u32| extents[i as usize];
        let members = &mut self.order[from..until];
        let all = members.iter().skip(1).fold(of(members[0]), |e, &i| e.union(&of(i)));
        let centers: Vec<Vector3<f64>> = members.iter().map(|&i| of(i).center()).collect();
        let spread = Extent::around(&centers);
        let axis = (spread.max - spread.min).imax();
        let node = self.nodes.len();
        let (start, count) = (from as u32, (until - from) as u32);
        self.nodes.push(Node { extent: all, start, count, axis: axis as u8 });
        if until - from <= LEAF {
            return;
        }
        // Ties are broken by index, so that the order is the same everywhere.
        members.sort_by(|&a, &b| of(a).center()[axis].total_cmp(&of(b).center()[axis]).then(a.cmp(&b)));
        let middle = from + (until - from) / 2;
        self.split(extents, from, middle);
        self.nodes[node].start = self.nodes.len() as u32;
        self.nodes[node].count = 0;
        self.split(extents, middle, until);
    }

    /// Calls back with every shape of the leaves that a pyramid may meet.
    pub(super) fn within(&self, pyramid: &Pyramid, mut found: impl FnMut(usize)) {
        // As deep as in `nearest`.
        let mut waiting = [0_u32; 40];
        let mut depth = 0;
        let mut node = 0_usize;
        loop {
            if let Some(n) = self.nodes.get(node)
                && pyramid.may_meet(&n.extent.center(), &((n.extent.max - n.extent.min) * 0.5))
            {
                if n.count == 0 {
                    waiting[depth] = n.start;
                    depth += 1;
                    node += 1;
                    continue;
                }
                let leaf = &self.order[n.start as usize..(n.start + n.count) as usize];
                leaf.iter().for_each(|&i| found(i as usize));
            }
            if depth == 0 {
                return;
            }
            depth -= 1;
            node = waiting[depth] as usize;
        }
    }

    /// The nearest shape that a ray meets before `limit`: its index and `t`.
    pub(crate) fn nearest(
        &self,
        shapes: &[Shape],
        origin: &Vector3<f64>,
        direction: &Vector3<f64>,
        mut limit: f64,
    ) -> Option<(usize, f64)> {
        let inverse = direction.map(|d| 1.0 / d);
        let mut best = None;
        // Median splits of 2³² shapes are 32 deep, and at most one node waits per level.
        let mut waiting = [0_u32; 40];
        let mut depth = 0;
        let mut node = 0_usize;
        loop {
            if let Some(n) = self.nodes.get(node)
                && enters(&n.extent, origin, &inverse, limit)
            {
                if n.count == 0 {
                    let (first, second) = (node as u32 + 1, n.start);
                    let forward = direction[n.axis as usize] >= 0.0;
                    waiting[depth] = if forward { second } else { first };
                    depth += 1;
                    node = if forward { first } else { second } as usize;
                    continue;
                }
                for &i in &self.order[n.start as usize..(n.start + n.count) as usize] {
                    if let Some(t) = shapes[i as usize].intersect(origin, direction, limit) {
                        limit = t;
                        best = Some((i as usize, t));
                    }
                }
            }
            if depth == 0 {
                return best;
            }
            depth -= 1;
            node = waiting[depth] as usize;
        }
    }
}

/// Slab test; a NaN (0 · ∞ on a slab's plane) is ignored by `max` and `min`.
#[inline]
fn enters(extent: &Extent, origin: &Vector3<f64>, inverse: &Vector3<f64>, limit: f64) -> bool {
    let (mut enter, mut leave) = (0.0_f64, limit);
    for k in 0..3 {
        let a = (extent.min[k] - origin[k]) * inverse[k];
        let b = (extent.max[k] - origin[k]) * inverse[k];
        enter = enter.max(a.min(b));
        leave = leave.min(a.max(b));
    }
    enter <= leave
}
