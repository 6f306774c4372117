//! Pieces of furniture, and how they are drawn at random: materials, places on the floor and along the walls.

use super::material::{Kind, Material, Surface};
use super::shape::Shape;
use crate::extent::Extent;
use crate::random::between;
use nalgebra::Vector3;
use rand::Rng;
use rand_chacha::ChaCha8Rng;

/// One shape and what it is made of.
pub(super) struct Piece {
    pub shape: Shape,
    pub surface: Surface,
}

pub(super) fn pick<T: Copy>(choice: &[T], rng: &mut ChaCha8Rng) -> T {
    choice[rng.random_range(0..choice.len())]
}

pub(super) fn material(kind: Kind, tone: f64, rng: &mut ChaCha8Rng) -> Material {
    Material { kind, seed: rng.random(), tone: (tone + between(rng, -0.08, 0.08)) as f32 }
}

pub(super) fn plain(material: Material) -> Surface {
    Surface { base: material, decals: Vec::new() }
}

pub(super) fn piece(shape: Shape, kind: Kind, tone: f64, rng: &mut ChaCha8Rng) -> Piece {
    Piece { shape, surface: plain(material(kind, tone, rng)) }
}

/// A random place on the floor, `margin` from the walls.
pub(super) fn on_floor(room: &Extent, margin: f64, rng: &mut ChaCha8Rng) -> Vector3<f64> {
    let axis = |k: usize, rng: &mut ChaCha8Rng| between(rng, room.min[k] + margin, room.max[k] - margin);
    Vector3::new(axis(0, rng), axis(1, rng), room.min.z)
}

/// A wall's own frame: a point on it at floor height, the direction along it and into the room.
pub(super) struct WallPlace {
    pub foot: Vector3<f64>,
    pub along: Vector3<f64>,
    pub inward: Vector3<f64>,
}

impl WallPlace {
    /// A random place on a random wall with `half_width` of wall on both sides; long walls are chosen more often.
    pub(super) fn random(room: &Extent, half_width: f64, rng: &mut ChaCha8Rng) -> Self {
        let size = room.max - room.min;
        let on_long_y = rng.random::<f64>() * (size.x + size.y) < size.x;
        let (axis, across) = if on_long_y { (0, 1) } else { (1, 0) };
        let mut foot = Vector3::new(0.0, 0.0, room.min.z);
        let reach = (0.5 * size[axis] - half_width).max(0.0);
        foot[axis] = 0.5 * (room.min[axis] + room.max[axis]) + between(rng, -reach, reach);
        let far = rng.random::<bool>();
        foot[across] = if far { room.max[across] } else { room.min[across] };
        let mut along = Vector3::zeros();
        along[axis] = 1.0;
        let mut inward = Vector3::zeros();
        inward[across] = if far { -1.0 } else { 1.0 };
        Self { foot, along, inward }
    }

    /// A block `offset` along the wall, its back `gap` from the wall and its foot `height` above the floor.
    pub(super) fn block(&self, offset: f64, gap: f64, height: f64, size: [f64; 3]) -> Shape {
        let [width, depth, tall] = size;
        let foot =
            self.foot + self.along * offset + self.inward * (gap + 0.5 * depth) + Vector3::z() * height;
        let size = if self.along.x != 0.0 { [width, depth, tall] } else { [depth, width, tall] };
        Shape::block(foot, size, 0.0)
    }
}
