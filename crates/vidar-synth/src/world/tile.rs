//! Many rays from one place at once: a tile of an image.
//!
//! Neighbouring pixels see the same few shapes. These are found once for the whole tile, by a pyramid that holds all of
//! its rays, and then each is met with every ray in a row. Each ray gets the very number that [`World::cast`] gives.

use super::shape::Shape;
use super::{Hit, World};
use nalgebra::Vector3;

/// The rays of a tile start at one place and have z = 1 in their camera; `low` and `high` bound their x and y there.
#[derive(Clone, Copy, Debug)]
pub(crate) struct TileBounds {
    /// Smallest x and y.
    pub low: [f64; 2],
    /// Largest x and y; below `low` in a tile without rays.
    pub high: [f64; 2],
}

impl TileBounds {
    /// No rays yet.
    pub(crate) const EMPTY: Self = Self { low: [f64::INFINITY; 2], high: [f64::NEG_INFINITY; 2] };

    /// Makes room for a ray; a NaN is no ray.
    pub(crate) fn add(&mut self, ray: [f64; 2]) {
        for k in 0..2 {
            self.low[k] = self.low[k].min(ray[k]);
            self.high[k] = self.high[k].max(ray[k]);
        }
    }
}

/// The four planes through a place that bound a tile's rays, and the direction in which depth is counted.
pub(super) struct Pyramid {
    pub origin: Vector3<f64>,
    /// Normals toward the inside.
    pub planes: [Vector3<f64>; 4],
    pub forward: Vector3<f64>,
}

impl Pyramid {
    fn new(bounds: &TileBounds, origin: &Vector3<f64>, axes: &[Vector3<f64>; 3]) -> Self {
        let [x, y, z] = axes;
        // A hair wider, so that rounding does not lose a shape that a border ray just meets.
        let wide = 1e-9;
        let planes = [
            x - z * (bounds.low[0] - wide),
            z * (bounds.high[0] + wide) - x,
            y - z * (bounds.low[1] - wide),
            z * (bounds.high[1] + wide) - y,
        ];
        Self { origin: *origin, planes, forward: *z }
    }

    /// Whether a box of `half` sizes around `center` may reach into the pyramid.
    #[inline]
    pub(super) fn may_meet(&self, center: &Vector3<f64>, half: &Vector3<f64>) -> bool {
        let to = center - self.origin;
        let reach = |n: &Vector3<f64>| n.dot(&to) + n.abs().dot(half);
        reach(&self.forward) > 0.0 && self.planes.iter().all(|n| reach(n) >= 0.0)
    }
}

/// What a tile's rays meet; memory is kept from tile to tile.
#[derive(Default)]
pub(crate) struct TileHits {
    /// Directions of the rays, z = 1 in their camera.
    pub directions: Vec<Vector3<f64>>,
    /// z-depth of each ray's hit; infinite where there is none.
    t: Vec<f64>,
    shape: Vec<u32>,
    candidates: Vec<Candidate>,
}

struct Candidate {
    /// The ray cannot meet it before this z-depth.
    from: f64,
    shape: u32,
}

impl World {
    /// Casts all of `hits.directions` from `origin`; `axes` are the camera's in the world.
    pub(crate) fn cast_tile(
        &self,
        bounds: &TileBounds,
        origin: &Vector3<f64>,
        axes: &[Vector3<f64>; 3],
        hits: &mut TileHits,
    ) {
        let TileHits { directions, t, shape, candidates } = hits;
        let pyramid = Pyramid::new(bounds, origin, axes);
        candidates.clear();
        self.bvh.within(&pyramid, |i| {
            let extent = &self.extents[i];
            let (center, half) = (extent.center(), (extent.max - extent.min) * 0.5);
            if pyramid.may_meet(&center, &half) {
                let n = &pyramid.forward;
                let from = n.dot(&(center - origin)) - n.abs().dot(&half);
                candidates.push(Candidate { from, shape: i as u32 + 1 });
            }
        });
        candidates.sort_unstable_by(|a, b| a.from.total_cmp(&b.from).then(a.shape.cmp(&b.shape)));

        t.clear();
        t.resize(directions.len(), f64::INFINITY);
        shape.clear();
        shape.resize(directions.len(), 0);
        self.shapes[0].meet(origin, directions, 0, t, shape);
        let mut farthest = t.iter().copied().fold(0.0, f64::max);
        for candidate in candidates.iter() {
            if candidate.from >= farthest {
                break;
            }
            self.shapes[candidate.shape as usize].meet(origin, directions, candidate.shape, t, shape);
            farthest = t.iter().copied().fold(0.0, f64::max);
        }
    }

    /// The hit of ray `i` of a tile that was cast from `origin`.
    pub(crate) fn tile_hit(&self, hits: &TileHits, i: usize, origin: &Vector3<f64>) -> Option<Hit> {
        let t = hits.t[i];
        t.is_finite().then(|| self.hit(hits.shape[i] as usize, t, origin, &hits.directions[i]))
    }

    /// z-depth of ray `i`'s hit.
    pub(crate) fn tile_depth(hits: &TileHits, i: usize) -> Option<f64> {
        Some(hits.t[i]).filter(|t| t.is_finite())
    }
}

impl Shape {
    /// Lowers `t` where a ray meets this shape before, and names it there by `number`.
    fn meet(
        &self,
        origin: &Vector3<f64>,
        directions: &[Vector3<f64>],
        number: u32,
        t: &mut [f64],
        shape: &mut [u32],
    ) {
        match self {
            // What most furniture is made of: as `intersect`, with what does not depend on the ray found once.
            Self::Block { center, axes, half } => {
                let o = origin - center;
                let local = [0, 1, 2].map(|k| -axes[k].dot(&o));
                for ((direction, t), shape) in directions.iter().zip(t).zip(shape) {
                    let (mut enter, mut leave) = (f64::NEG_INFINITY, f64::INFINITY);
                    for k in 0..3 {
                        let inverse = 1.0 / axes[k].dot(direction);
                        let at = local[k] * inverse;
                        let reach = half[k] * inverse.abs();
                        enter = enter.max(at - reach);
                        leave = leave.min(at + reach);
                    }
                    let met = (enter <= leave) & (enter > super::shape::MIN_T) & (enter < *t);
                    *t = if met { enter } else { *t };
                    *shape = if met { number } else { *shape };
                }
            }
            _ => {
                for ((direction, t), shape) in directions.iter().zip(t).zip(shape) {
                    if let Some(nearer) = self.intersect(origin, direction, *t) {
                        (*t, *shape) = (nearer, number);
                    }
                }
            }
        }
    }
}
