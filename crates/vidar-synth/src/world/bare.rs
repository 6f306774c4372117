//! Surfaces without texture, as painted walls and plain furniture have them.

use super::furniture::RoomContents;
use super::material::{Decal, Kind, Material};
use crate::config::SynthConfig;
use crate::extent::Extent;
use crate::random::{Purpose, stream};
use rand::Rng;
use rand::seq::SliceRandom;

/// Makes `config.bare_share` of the shell's area and of the furniture uniform.
///
/// Faces of the shell are drawn in random order until the area is reached; the last one is bare on one side only.
pub(super) fn strip_textures(furnished: &mut RoomContents, room: &Extent, config: &SynthConfig) {
    if config.bare_share <= 0.0 {
        return;
    }
    let mut rng = stream(config.seed, Purpose::BareSurfaces);
    let size = room.max - room.min;
    // Sizes (u, v) of the faces −x, +x, −y, +y, floor, ceiling.
    let sizes = [
        [size.y, size.z],
        [size.y, size.z],
        [size.x, size.z],
        [size.x, size.z],
        [size.x, size.y],
        [size.x, size.y],
    ];
    let area = |face: usize| sizes[face][0] * sizes[face][1];
    let mut left = config.bare_share * (0..sizes.len()).map(area).sum::<f64>();
    let mut order: Vec<usize> = (0..sizes.len()).collect();
    order.shuffle(&mut rng);
    for face in order {
        let share = (left / area(face)).clamp(0.0, 1.0);
        left -= share * area(face);
        let paint =
            Material { kind: Kind::Uniform, seed: rng.random(), tone: 0.35 + 0.45 * rng.random::<f32>() };
        let surface = &mut furnished.shell[face];
        if share >= 1.0 {
            surface.base = paint;
            // Lamps and windows stay: they light the room.
            surface.decals.retain(|d| d.glow > 0.0);
        } else if share > 0.0 {
            let [u, v] = sizes[face].map(|s| s as f32);
            let width = share as f32 * u;
            let left_side = if rng.random::<bool>() { 0.0 } else { u - width };
            let decal =
                Decal { corner: [left_side, 0.0], size: [width, v], material: paint, frame: 0.0, glow: 0.0 };
            surface.decals.push(decal);
        }
    }
    for piece in &mut furnished.pieces {
        if rng.random::<f64>() < config.bare_share {
            piece.surface.base.kind = Kind::Uniform;
            piece.surface.decals.clear();
        }
    }
}
