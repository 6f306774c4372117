//! Exact nearest neighbours among millions of points.
//!
//! A balanced k-d tree over full buckets: points are split at the median of the widest side until [`BUCKET`] are
//! left, so the depth is ⌈log₂(n/BUCKET)⌉ whatever the points are — planes, lines and duplicates too, since points
//! are split by rank and not by coordinate. Each inner node keeps the tight boxes of its two children side by side;
//! a bucket keeps x, y and z in separate rows, which the compiler turns into vector instructions.
//!
//! Queries go along a Morton curve, and each starts from the answer of the one before it: on surfaces that bound is
//! already tight, so few buckets are opened. Distances are exact minima: boxes and points are compared in `f32`
//! with the same operations, whose rounding is monotone, so no nearer point is pruned; the winner's distance is
//! then computed again in `f64`. What remains is the `f32` choice among near-ties, a relative error below 3e-7.
//!
//! Memory: 19 bytes per point for the tree, 16 more while it is built, 16 bytes per query.

use crate::error::EvalError;
use rayon::prelude::*;

/// Points in a bucket: four SSE registers a row; 8 and 32 measured slower.
const BUCKET: usize = 16;

/// Subtrees with fewer buckets are built by one thread; joins cost more below.
const PARALLEL_BUCKETS: usize = 256;

/// Queries that follow one another on the curve within one task. Fixed, so results do not depend on threads.
const QUERY_CHUNK: usize = 4096;

/// Queries sorted at a time, which bounds the extra memory.
const QUERY_BLOCK: usize = 1 << 24;

#[derive(Clone, Copy, Debug)]
struct Bounds {
    min: [f32; 3],
    max: [f32; 3],
}

impl Bounds {
    const EMPTY: Self = Self { min: [f32::INFINITY; 3], max: [f32::NEG_INFINITY; 3] };

    fn grow(&mut self, p: &[f32; 3]) {
        for k in 0..3 {
            self.min[k] = self.min[k].min(p[k]);
            self.max[k] = self.max[k].max(p[k]);
        }
    }

    fn union(&self, other: &Self) -> Self {
        let mut both = *self;
        both.grow(&other.min);
        both.grow(&other.max);
        both
    }

    fn distance_squared(&self, q: &[f32; 3]) -> f32 {
        let mut d = [0.0_f32; 3];
        for k in 0..3 {
            d[k] = (self.min[k] - q[k]).max(q[k] - self.max[k]).max(0.0);
        }
        d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    }

    fn widest_axis(&self) -> usize {
        let side = |k: usize| self.max[k] - self.min[k];
        let xy = if side(1) > side(0) { 1 } else { 0 };
        if side(2) > side(xy) { 2 } else { xy }
    }
}

/// Sixteen points in rows; places without a point are infinitely far.
#[derive(Clone, Copy, Debug)]
struct Bucket {
    rows: [[f32; BUCKET]; 3],
    ids: [u32; BUCKET],
}

impl Bucket {
    const EMPTY: Self = Self { rows: [[f32::INFINITY; BUCKET]; 3], ids: [u32::MAX; BUCKET] };

    /// Squared distance and place of the nearest point.
    fn nearest(&self, q: &[f32; 3]) -> (f32, usize) {
        let mut d = [0.0_f32; BUCKET];
        for i in 0..BUCKET {
            let (x, y, z) = (self.rows[0][i] - q[0], self.rows[1][i] - q[1], self.rows[2][i] - q[2]);
            d[i] = x * x + y * y + z * z;
        }
        let least = d.iter().fold(f32::INFINITY, |a, &b| if b < a { b } else { a });
        (least, d.iter().position(|&v| v == least).unwrap_or(0))
    }

    fn point(&self, place: usize) -> [f32; 3] {
        [self.rows[0][place], self.rows[1][place], self.rows[2][place]]
    }
}

/// An answer: which point, and how far.
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
#[derive(Clone, Debug)]
pub struct NearestIndex {
    /// Boxes of the two children of each inner node, in preorder: with buckets `[a, b)` and `m = (a+b)/2`, the left
    /// child of inner node `i` is `i + 1` and the right one `i + m − a`.
    nodes: Vec<[Bounds; 2]>,
    buckets: Vec<Bucket>,
    bounds: Bounds,
    len: usize,
    dropped: usize,
}

type Tagged = ([f32; 3], u32);

impl NearestIndex {
    /// Builds the index; points with a coordinate that is not finite are left out and counted.
    ///
    /// Fails only for more than 2³²−2 points. An index of no points answers every query with "nothing".
    pub fn build(points: &[[f32; 3]]) -> Result<Self, EvalError> {
        let limit = u32::MAX as usize - 1;
        if points.len() > limit {
            return Err(EvalError::TooManyPoints { found: points.len(), limit });
        }
        let mut tagged: Vec<Tagged> = (0_u32..)
            .zip(points)
            .filter(|(_, p)| p.iter().all(|c| c.is_finite()))
            .map(|(i, p)| (*p, i))
            .collect();
        let len = tagged.len();
        let mut bounds = Bounds::EMPTY;
        tagged.iter().for_each(|(p, _)| bounds.grow(p));
        let n_buckets = len.div_ceil(BUCKET);
        let mut buckets = vec![Bucket::EMPTY; n_buckets];
        let mut nodes = vec![[Bounds::EMPTY; 2]; n_buckets.saturating_sub(1)];
        if n_buckets > 0 {
            build_subtree(&mut tagged, &mut nodes, &mut buckets, bounds);
        }
        Ok(Self { nodes, buckets, bounds, len, dropped: points.len() - len })
    }

    /// Number of points in the index.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether the index has no point.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Points that were left out because a coordinate was not finite.
    pub fn dropped(&self) -> usize {
        self.dropped
    }

    /// Smallest and largest coordinates of the points; `None` without points.
    pub fn bounds(&self) -> Option<([f32; 3], [f32; 3])> {
        (self.len > 0).then_some((self.bounds.min, self.bounds.max))
    }

    /// The point nearest to `query`; `None` for an empty index, a query that is not finite, or nothing within
    /// `max_distance_m` (strictly).
    pub fn nearest(&self, query: &[f32; 3], max_distance_m: Option<f32>) -> Option<Neighbour> {
        let mut search = Search::new(max_distance_m);
        search.run(self, query);
        search.answer(self, query)
    }

    /// The nearest point of each query, in their order; `None` as in [`nearest`](Self::nearest).
    pub fn nearest_all(&self, queries: &[[f32; 3]], max_distance_m: Option<f32>) -> Vec<Option<Neighbour>> {
        self.map_nearest(queries, max_distance_m, None, |neighbour| neighbour)
    }

    /// `f` of each query's answer, in the queries' order.
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
            let mut along_curve = vec![blank; block.len()];
            order.par_chunks(QUERY_CHUNK).zip(along_curve.par_chunks_mut(QUERY_CHUNK)).for_each(
                |(order, answers)| {
                    let mut search = Search::new(max_distance_m);
                    for (&key, answer) in order.iter().zip(answers) {
                        let query = &block[key as u32 as usize];
                        search.run(self, query);
                        *answer = f(search.answer(self, query));
                    }
                },
            );
            for (&key, answer) in order.iter().zip(along_curve) {
                out[key as u32 as usize] = answer;
            }
        }
        out
    }
}

/// Distance in metres from each query to its nearest point of `index`, in the queries' order.
///
/// `f32::INFINITY` where nothing lies within `max_distance_m` (strictly) or the index is empty; NaN for a query that
/// is not finite. The answer does not depend on the number of threads.
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

/// Splits `points` among `buckets` and returns their tight bounds. `region` only serves to choose the axis.
fn build_subtree(
    points: &mut [Tagged],
    nodes: &mut [[Bounds; 2]],
    buckets: &mut [Bucket],
    region: Bounds,
) -> Bounds {
    let [node, nodes @ ..] = nodes else {
        return fill_bucket(points, &mut buckets[0]);
    };
    let middle = buckets.len() / 2;
    let axis = region.widest_axis();
    // Equal coordinates are ordered by index, so that the tree is the same on every run.
    points
        .select_nth_unstable_by(middle * BUCKET, |a, b| a.0[axis].total_cmp(&b.0[axis]).then(a.1.cmp(&b.1)));
    let cut = points[middle * BUCKET].0[axis];
    let (mut below, mut above) = (region, region);
    below.max[axis] = cut;
    above.min[axis] = cut;
    let parallel = buckets.len() >= PARALLEL_BUCKETS;
    let (left_points, right_points) = points.split_at_mut(middle * BUCKET);
    let (left_buckets, right_buckets) = buckets.split_at_mut(middle);
    let (left_nodes, right_nodes) = nodes.split_at_mut(middle - 1);
    let mut left = || build_subtree(left_points, left_nodes, left_buckets, below);
    let mut right = || build_subtree(right_points, right_nodes, right_buckets, above);
    let (left, right) = if parallel { rayon::join(left, right) } else { (left(), right()) };
    *node = [left, right];
    left.union(&right)
}

fn fill_bucket(points: &[Tagged], bucket: &mut Bucket) -> Bounds {
    let mut bounds = Bounds::EMPTY;
    for (place, (p, id)) in points.iter().enumerate() {
        for k in 0..3 {
            bucket.rows[k][place] = p[k];
        }
        bucket.ids[place] = *id;
        bounds.grow(p);
    }
    bounds
}

/// State of a chain of searches: what is known of the best point so far, and where it lies.
struct Search {
    limit_squared: f32,
    best_squared: f32,
    best: Option<(usize, usize)>,
}

/// A part of the tree still to be seen: inner node, its buckets, and how near its box comes.
#[derive(Clone, Copy)]
struct Pending {
    node: usize,
    first: usize,
    end: usize,
    squared: f32,
}

impl Search {
    fn new(max_distance_m: Option<f32>) -> Self {
        let limit = max_distance_m.unwrap_or(f32::INFINITY);
        Self { limit_squared: limit * limit, best_squared: f32::INFINITY, best: None }
    }

    /// Finds the point nearest to `query`, starting from the bucket that answered last.
    fn run(&mut self, index: &NearestIndex, query: &[f32; 3]) {
        let start = self.best.take().map(|(bucket, _)| bucket);
        self.best_squared = self.limit_squared;
        if index.len == 0 || !query.iter().all(|c| c.is_finite()) {
            return;
        }
        if let Some(bucket) = start {
            self.open(index, bucket, query);
        }
        let root = Pending { node: 0, first: 0, end: index.buckets.len(), squared: 0.0 };
        // A balanced tree over at most 2³² points is less than 32 deep.
        let mut stack = [root; 40];
        let mut height = 1;
        while height > 0 {
            height -= 1;
            let mut part = stack[height];
            if !(part.squared < self.best_squared) {
                continue;
            }
            while part.end - part.first > 1 {
                let middle = part.first + (part.end - part.first) / 2;
                let [left, right] = &index.nodes[part.node];
                let (dl, dr) = (left.distance_squared(query), right.distance_squared(query));
                let left = Pending { node: part.node + 1, first: part.first, end: middle, squared: dl };
                let right = Pending {
                    node: part.node + (middle - part.first),
                    first: middle,
                    end: part.end,
                    squared: dr,
                };
                let (near, far) = if dl <= dr { (left, right) } else { (right, left) };
                if far.squared < self.best_squared {
                    stack[height] = far;
                    height += 1;
                }
                part = near;
                if !(part.squared < self.best_squared) {
                    break;
                }
            }
            if part.end - part.first == 1 && part.squared < self.best_squared {
                self.open(index, part.first, query);
            }
        }
    }

    fn open(&mut self, index: &NearestIndex, bucket: usize, query: &[f32; 3]) {
        let (squared, place) = index.buckets[bucket].nearest(query);
        if squared < self.best_squared {
            self.best_squared = squared;
            self.best = Some((bucket, place));
        }
    }

    fn answer(&self, index: &NearestIndex, query: &[f32; 3]) -> Option<Neighbour> {
        let (bucket, place) = self.best?;
        let bucket = &index.buckets[bucket];
        let position = bucket.point(place);
        let squared: f64 =
            position.iter().zip(query).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
        Some(Neighbour { index: bucket.ids[place], position, distance_m: squared.sqrt() })
    }
}

/// The queries along a Morton curve of 2¹⁰ steps a side: sorted keys whose low 32 bits are the query's index.
fn morton_order(queries: &[[f32; 3]]) -> Vec<u64> {
    let mut bounds = Bounds::EMPTY;
    queries.iter().filter(|q| q.iter().all(|c| c.is_finite())).for_each(|q| bounds.grow(q));
    let side = (0..3).map(|k| bounds.max[k] - bounds.min[k]).fold(f32::MIN_POSITIVE, f32::max);
    let steps = 1023.0 / side;
    let mut keys: Vec<u64> = queries
        .par_iter()
        .enumerate()
        .map(|(i, q)| {
            // Casts saturate and send NaN to zero: such queries sort somewhere and find nothing.
            let cell = |k: usize| ((q[k] - bounds.min[k]) * steps) as u32 & 1023;
            let code = spread(cell(0)) | spread(cell(1)) << 1 | spread(cell(2)) << 2;
            u64::from(code) << 32 | i as u64
        })
        .collect();
    keys.par_sort_unstable();
    keys
}

/// Puts two zero bits between the ten low bits of `v`.
fn spread(v: u32) -> u32 {
    let v = (v | v << 16) & 0x0300_00ff;
    let v = (v | v << 8) & 0x0300_f00f;
    let v = (v | v << 4) & 0x030c_30c3;
    (v | v << 2) & 0x0924_9249
}

#[cfg(test)]
mod tests;
