//! Exact nearest neighbours among millions of points.
//!
//! Points lie in a tree of tight boxes. Queries are sorted along a Morton curve, so that successive queries visit nodes
//! that are in the processor's cache; this more than halves the time. The
//! tree compares squared distances in `f32`; the distance of the nearest is then computed again in `f64`. What remains is
//! the `f32` choice among near-ties, a relative error below 3e-7. Why this tree, and comparison with libraries:
//! `docs/decisions/0025-tight-boxes.md`.
//!
//! Memory: 20 bytes per point for the tree, 36 while it is built, 16 bytes per query.

mod follow;
mod tree;

pub(crate) use follow::Followed;

use crate::error::EvalError;
use rayon::prelude::*;
use tree::{Found, Tree};

/// Queries that follow one another on the curve within one task.
const QUERY_CHUNK: usize = 4096;

/// Queries sorted at a time, which bounds the extra memory.
const QUERY_BLOCK: usize = 1 << 24;

/// The place in the tree of no point: there are fewer.
const NOWHERE: u32 = u32::MAX;

/// The point nearest to a query.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Neighbour {
    /// Index into the points that the index was built from.
    pub index: u32,
    /// Its position, metres.
    pub position: [f32; 3],
    /// Distance, metres.
    pub distance_m: f64,
}

/// A search structure over points; see the module's head for the method.
#[derive(Debug)]
pub struct NearestIndex {
    /// None without points.
    tree: Option<Tree>,
    dropped: usize,
}

impl NearestIndex {
    /// Builds the index; points with a coordinate that is not finite are left out and counted.
    ///
    /// Fails only for more than 2³²−2 points. An index without points gives `None` for every query.
    pub fn build(points: &[[f32; 3]]) -> Result<Self, EvalError> {
        let limit = u32::MAX as usize - 1;
        if points.len() > limit {
            return Err(EvalError::TooManyPoints { found: points.len(), limit });
        }
        let items: Vec<_> = points.iter().copied().zip(0_u32..).filter(|(p, _)| usable(p)).collect();
        let dropped = points.len() - items.len();
        Ok(Self { tree: Tree::new(items), dropped })
    }

    /// Number of points in the index.
    pub fn len(&self) -> usize {
        self.tree.as_ref().map_or(0, Tree::len)
    }

    /// Whether the index has no point.
    pub fn is_empty(&self) -> bool {
        self.tree.is_none()
    }

    /// Points that were left out because a coordinate was not finite.
    pub fn dropped(&self) -> usize {
        self.dropped
    }

    /// Smallest and largest coordinates of the points; `None` without points.
    pub fn bounds(&self) -> Option<([f32; 3], [f32; 3])> {
        self.tree.as_ref().map(Tree::bounds)
    }

    /// The point nearest to `query`; `None` for an empty index, a query that is not finite, or nothing within
    /// `max_distance_m` (strictly).
    pub fn nearest(&self, query: &[f32; 3], max_distance_m: Option<f32>) -> Option<Neighbour> {
        let tree = self.tree.as_ref().filter(|_| usable(query))?;
        let limit = max_distance_m.unwrap_or(f32::INFINITY);
        let found = tree.nearest(query, Found { place: NOWHERE, squared: limit * limit });
        if found.place == NOWHERE {
            return None;
        }
        let position = tree.position(found.place);
        Some(Neighbour { index: tree.id(found.place), position, distance_m: distance_m(query, &position) })
    }

    /// The nearest point of each query, in their order; `None` as in [`nearest`](Self::nearest).
    pub fn nearest_all(&self, queries: &[[f32; 3]], max_distance_m: Option<f32>) -> Vec<Option<Neighbour>> {
        self.map_nearest(queries, max_distance_m, None, |neighbour| neighbour)
    }

    /// `f` of each query's neighbour, in the queries' order.
    fn map_nearest<T: Copy + Send + Sync>(
        &self,
        queries: &[[f32; 3]],
        max_distance_m: Option<f32>,
        blank: T,
        f: impl Fn(Option<Neighbour>) -> T + Sync,
    ) -> Vec<T> {
        let mut out = vec![blank; queries.len()];
        for (block, out) in queries.chunks(QUERY_BLOCK).zip(out.chunks_mut(QUERY_BLOCK)) {
            let order = morton_order(block);
            let search = |&key: &u64| f(self.nearest(&block[key as u32 as usize], max_distance_m));
            let along_curve: Vec<T> = order.par_iter().with_min_len(QUERY_CHUNK).map(search).collect();
            for (&key, value) in order.iter().zip(along_curve) {
                out[key as u32 as usize] = value;
            }
        }
        out
    }
}

/// The points in the order of a Morton curve: neighbours in the list are neighbours in space.
pub(crate) fn along_curve(points: &[[f32; 3]]) -> Vec<[f32; 3]> {
    morton_order(points).iter().map(|&key| points[key as u32 as usize]).collect()
}

/// Distance in metres from each query to its nearest point of `index`, in the queries' order.
///
/// `f32::INFINITY` where nothing lies within `max_distance_m` (strictly) or the index is empty; NaN for a query that
/// is not finite. The result does not depend on the number of threads.
pub fn nearest_distances(
    queries: &[[f32; 3]],
    index: &NearestIndex,
    max_distance_m: Option<f32>,
) -> Vec<f32> {
    let mut distances = index.map_nearest(queries, max_distance_m, f32::INFINITY, |neighbour| {
        neighbour.map_or(f32::INFINITY, |n| n.distance_m as f32)
    });
    for (distance, query) in distances.iter_mut().zip(queries) {
        if !query.iter().all(|c| c.is_finite()) {
            *distance = f32::NAN;
        }
    }
    distances
}

/// Whether a point can be searched for: the tree requires numbers, and reserves the largest one.
fn usable(p: &[f32; 3]) -> bool {
    // Comparisons with NaN are false.
    p.iter().all(|c| c.abs() < f32::MAX)
}

/// Distance between two points in double precision.
fn distance_m(a: &[f32; 3], b: &[f32; 3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum::<f64>().sqrt()
}

/// Smallest and largest coordinates.
fn bounds_of<'a>(points: impl Iterator<Item = &'a [f32; 3]>) -> ([f32; 3], [f32; 3]) {
    points.fold(([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]), |(min, max), p| {
        ([0, 1, 2].map(|k| min[k].min(p[k])), [0, 1, 2].map(|k| max[k].max(p[k])))
    })
}

/// The queries along a Morton curve of 2¹⁰ steps a side: sorted keys whose low 32 bits are the query's index.
fn morton_order(queries: &[[f32; 3]]) -> Vec<u64> {
    let (min, max) = bounds_of(queries.iter().filter(|q| usable(q)));
    let side = (0..3).map(|k| max[k] - min[k]).fold(f32::MIN_POSITIVE, f32::max);
    let steps = 1023.0 / side;
    let mut keys: Vec<u64> = queries
        .par_iter()
        .enumerate()
        .map(|(i, q)| {
            // Casts saturate and turn NaN into zero: the order of such queries is irrelevant, as they have no neighbour.
            let cell = |k: usize| ((q[k] - min[k]) * steps) as u32 & 1023;
            let code = interleave(cell(0)) | interleave(cell(1)) << 1 | interleave(cell(2)) << 2;
            u64::from(code) << 32 | i as u64
        })
        .collect();
    keys.par_sort_unstable();
    keys
}

/// Puts two zero bits between the ten low bits of `v`.
fn interleave(v: u32) -> u32 {
    let v = (v | v << 16) & 0x0300_00ff;
    let v = (v | v << 8) & 0x0300_f00f;
    let v = (v | v << 4) & 0x030c_30c3;
    (v | v << 2) & 0x0924_9249
}

#[cfg(test)]
mod tests;
