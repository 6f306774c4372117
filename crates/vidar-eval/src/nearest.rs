//! Exact nearest neighbours among millions of points.
//!
//! The search is kiddo's immutable k-d tree. Queries are sorted along a
//! Morton curve, so that successive queries visit nodes that are in the processor's cache; this more than halves the time. The
//! tree compares squared distances in `f32`; the distance of the nearest is then computed again in `f64`. What remains is
//! the `f32` choice among near-ties, a relative error below 3e-7. Comparison with other libraries:
//! `docs/decisions/0005-nearest-neighbours.md`.
//!
//! Memory: 20 bytes per point for the tree, as much again while it is built, 16 bytes per query.

use crate::error::EvalError;
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use rayon::prelude::*;

/// Queries that follow one another on the curve within one task.
const QUERY_CHUNK: usize = 4096;

/// Queries sorted at a time, which bounds the extra memory.
const QUERY_BLOCK: usize = 1 << 24;

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
    tree: Option<ImmutableKdTree<f32, 3>>,
    /// The points in the tree, in the order of its items (kiddo 6.3 visits every item to return one point).
    points: Vec<[f32; 3]>,
    /// The index among the points given of each point in the tree; empty when all points given are in it.
    ids: Vec<u32>,
    bounds: ([f32; 3], [f32; 3]),
    dropped: usize,
}

impl NearestIndex {
    /// Builds the index; points with a coordinate that is not finite are left out and counted.
    ///
    /// Fails only for more than 2³²−2 points. An index without points gives `None` for every query.
    pub fn build(points: &[[f32; 3]]) -> Result<Self, EvalError> {
        let limit = u32::MAX as usize - 1;
        let too_many = || EvalError::TooManyPoints { found: points.len(), limit };
        if points.len() > limit {
            return Err(too_many());
        }
        let dropped = points.iter().filter(|p| !usable(p)).count();
        let (ids, kept) = if dropped == 0 {
            (Vec::new(), points.to_vec())
        } else {
            (0_u32..).zip(points).filter(|(_, p)| usable(p)).unzip()
        };
        // The one error that a tree from a slice can give is that of too many points.
        let tree = if kept.is_empty() {
            None
        } else {
            Some(ImmutableKdTree::new_from_slice(&kept).map_err(|_| too_many())?)
        };
        Ok(Self { tree, ids, bounds: bounds_of(kept.iter()), points: kept, dropped })
    }

    /// Number of points in the index.
    pub fn len(&self) -> usize {
        self.points.len()
    }

    /// Whether the index has no point.
    pub fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    /// Points that were left out because a coordinate was not finite.
    pub fn dropped(&self) -> usize {
        self.dropped
    }

    /// Smallest and largest coordinates of the points; `None` without points.
    pub fn bounds(&self) -> Option<([f32; 3], [f32; 3])> {
        (!self.is_empty()).then_some(self.bounds)
    }

    /// The point nearest to `query`; `None` for an empty index, a query that is not finite, or nothing within
    /// `max_distance_m` (strictly).
    pub fn nearest(&self, query: &[f32; 3], max_distance_m: Option<f32>) -> Option<Neighbour> {
        let tree = self.tree.as_ref().filter(|_| usable(query))?;
        // A query this far from all points needs no search.
        if max_distance_m.is_some_and(|limit| self.squared_distance_to_bounds(query) > limit * limit) {
            return None;
        }
        let found = tree.query(query).nearest_one::<SquaredEuclidean<f32>>().execute();
        let limit = max_distance_m.unwrap_or(f32::INFINITY);
        if !(found.distance < limit * limit) {
            return None;
        }
        let index = self.ids.get(found.item as usize).copied().unwrap_or(found.item);
        let position = *self.points.get(found.item as usize)?;
        let squared: f64 =
            position.iter().zip(query).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
        Some(Neighbour { index, position, distance_m: squared.sqrt() })
    }

    /// Squared distance from `query` to the bounding box of the points, m²; 0 inside.
    fn squared_distance_to_bounds(&self, query: &[f32; 3]) -> f32 {
        let (min, max) = self.bounds;
        (0..3).map(|k| (min[k] - query[k]).max(query[k] - max[k]).max(0.0).powi(2)).sum()
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
