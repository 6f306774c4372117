//! Space: axis-aligned boxes, and the size of the place that a configuration asks for.

use crate::config::{SceneKind, SynthConfig, Variety};
use crate::random::{Purpose, between, stream};
use nalgebra::Vector3;

/// An axis-aligned box of space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Extent {
    /// Smallest coordinates, m.
    pub min: Vector3<f64>,
    /// Largest coordinates, m.
    pub max: Vector3<f64>,
}

impl Extent {
    /// The smallest box around `points`; inverted and infinite without points.
    pub fn around(points: &[Vector3<f64>]) -> Self {
        let empty = Self { min: Vector3::repeat(f64::INFINITY), max: Vector3::repeat(f64::NEG_INFINITY) };
        points.iter().fold(empty, |e, p| Self { min: e.min.inf(p), max: e.max.sup(p) })
    }

    /// The box around both.
    pub fn union(&self, other: &Self) -> Self {
        Self { min: self.min.inf(&other.min), max: self.max.sup(&other.max) }
    }

    /// The box grown by `margin_m` on every side.
    pub fn grown(&self, margin_m: f64) -> Self {
        Self { min: self.min.add_scalar(-margin_m), max: self.max.add_scalar(margin_m) }
    }

    /// Distance from `point` to the box, 0 inside, m.
    pub fn distance(&self, point: &Vector3<f64>) -> f64 {
        (self.min - point).sup(&(point - self.max)).sup(&Vector3::zeros()).norm()
    }

    /// Whether the two boxes share space.
    pub fn overlaps(&self, other: &Self) -> bool {
        (0..3).all(|k| self.min[k] < other.max[k] && other.min[k] < self.max[k])
    }

    /// Whether `other` lies within this box.
    pub fn holds(&self, other: &Self) -> bool {
        (0..3).all(|k| self.min[k] <= other.min[k] && other.max[k] <= self.max[k])
    }

    /// The middle.
    pub fn center(&self) -> Vector3<f64> {
        (self.min + self.max) * 0.5
    }
}

/// Size of the place that `config` asks for, m.
pub(crate) fn room_size(config: &SynthConfig) -> Vector3<f64> {
    let usual = match config.scene {
        SceneKind::Room => Vector3::new(8.0, 8.0, 4.0),
        SceneKind::Hall => Vector3::new(20.0, 15.0, 7.0),
        SceneKind::Corridor => Vector3::new(30.0, 3.0, 3.0),
    };
    if config.variety == Variety::Home {
        let mut rng = stream(config.seed, Purpose::Size);
        return [(2.6, 6.8), (2.6, 6.0), (2.3, 3.0)].map(|(low, high)| between(&mut rng, low, high)).into();
    }
    if config.variety == Variety::Standard {
        return usual;
    }
    let mut rng = stream(config.seed, Purpose::Size);
    // A corridor's width leaves little to shrink.
    let across = if config.scene == SceneKind::Corridor { (0.85, 1.5) } else { (0.55, 1.35) };
    let factors =
        [between(&mut rng, 0.55, 1.35), between(&mut rng, across.0, across.1), between(&mut rng, 0.65, 1.25)];
    let size = usual.component_mul(&Vector3::from(factors));
    Vector3::new(size.x, size.y, size.z.max(2.3))
}
