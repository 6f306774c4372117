//! Furniture: groups of shapes placed at random where neither the flight nor other furniture is.

mod groups;

use super::material::{Decal, Kind, Surface};
use super::piece::{Piece, material, plain};
use super::{home, randomized};
use crate::config::{SceneKind, SynthConfig, Variety};
use crate::extent::Extent;
use crate::random::{Purpose, between, stream};
use groups::Group;
use nalgebra::Vector3;
use rand::Rng;
use rand_chacha::ChaCha8Rng;

/// Smallest distance between the flight and any furniture, m. A little more than promised, since the flight is
/// known at points that lie up to about 5 cm apart.
const CLEARANCE_M: f64 = 0.45;

/// Places tried for each group.
const ATTEMPTS: usize = 30;

/// The room's six faces and everything in it.
pub(super) struct RoomContents {
    pub shell: Vec<Surface>,
    pub pieces: Vec<Piece>,
}

/// Furnishes `room` for `config`, keeping clear of the flight's `positions`.
pub(super) fn furnish(config: &SynthConfig, room: &Extent, positions: &[Vector3<f64>]) -> RoomContents {
    let mut rng = stream(config.seed, Purpose::Furniture);
    let wild = config.variety != Variety::Standard;
    let shell =
        if wild { randomized::shell(room, &mut rng) } else { shell_surfaces(config.scene, room, &mut rng) };
    let mut space = Space { room: *room, positions, taken: Vec::new() };
    let mut pieces = Vec::new();
    for _ in 0..group_count(config, room) {
        // Randomized places hold what any standard place holds, and more.
        let scene =
            if wild { [SceneKind::Room, SceneKind::Hall][rng.random_range(0..2)] } else { config.scene };
        let own = wild && rng.random::<f64>() < 0.35;
        let from_home = config.variety == Variety::Home && rng.random::<f64>() < 0.6;
        let kind = Group::random(scene, &mut rng);
        for _ in 0..ATTEMPTS {
            let mut group = match (from_home, own) {
                (true, _) => home::furniture(room, &mut rng),
                (false, true) => randomized::furniture(room, &mut rng),
                (false, false) => kind.build(room, &mut rng),
            };
            // What belongs together in a home keeps its materials.
            if wild && !from_home {
                randomized::restyle(&mut group, &mut rng);
            }
            if space.take(&group) {
                pieces.extend(group);
                break;
            }
        }
    }
    RoomContents { shell, pieces }
}

/// `clutter` groups per 64 m² of floor, up to four times as many in large places.
fn group_count(config: &SynthConfig, room: &Extent) -> usize {
    let size = room.max - room.min;
    (config.clutter as f64 * (size.x * size.y / 64.0).clamp(1.0, 4.0)).round() as usize
}

/// What is free.
struct Space<'a> {
    room: Extent,
    positions: &'a [Vector3<f64>],
    /// Boxes around the groups that stand already.
    taken: Vec<Extent>,
}

impl Space<'_> {
    /// Takes the space of `group` if it is free.
    fn take(&mut self, group: &[Piece]) -> bool {
        let extents: Vec<Extent> = group.iter().map(|p| p.shape.extent()).collect();
        let Some(all) = extents.iter().copied().reduce(|a, b| a.union(&b)) else {
            return false;
        };
        // Shapes touch walls and floor up to rounding.
        let inside = self.room.grown(1e-6).holds(&all);
        if !inside || self.taken.iter().any(|t| t.overlaps(&all)) {
            return false;
        }
        let near = self.positions.iter().filter(|p| all.distance(p) < CLEARANCE_M);
        if near.into_iter().any(|p| extents.iter().any(|e| e.distance(p) < CLEARANCE_M)) {
            return false;
        }
        self.taken.push(all.grown(0.01));
        true
    }
}

/// Materials of the room's faces −x, +x, −y, +y, floor, ceiling, with doors, windows, posters and one plain stretch.
fn shell_surfaces(scene: SceneKind, room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Surface> {
    let size = room.max - room.min;
    let (walls, floor, ceiling): (&[Kind], Kind, Kind) = match scene {
        SceneKind::Room => (&[Kind::Plaster, Kind::Brick, Kind::Plaster], Kind::Planks, Kind::CeilingPanels),
        SceneKind::Hall => (&[Kind::Concrete, Kind::Brick], Kind::Concrete, Kind::Concrete),
        SceneKind::Corridor => {
            (&[Kind::Plaster, Kind::Brick, Kind::Concrete], Kind::Tiles, Kind::CeilingPanels)
        }
    };
    let bare = rng.random_range(0..4);
    let mut surfaces = Vec::with_capacity(6);
    for k in 0..4 {
        let width = if k < 2 { size.y } else { size.x };
        let kind = walls[rng.random_range(0..walls.len())];
        let tone = if kind == Kind::Plaster { 0.6 } else { 0.45 };
        let base = material(kind, tone, rng);
        let decals = wall_decals([width, size.z], k == bare, rng);
        surfaces.push(Surface { base, decals });
    }
    surfaces.push(plain(material(floor, 0.45, rng)));
    surfaces.push(plain(material(ceiling, 0.65, rng)));
    surfaces
}

fn wall_decals(size: [f64; 2], bare: bool, rng: &mut ChaCha8Rng) -> Vec<Decal> {
    let mut decals: Vec<Decal> = Vec::new();
    let mut put = |kind: Kind, tone: f64, wanted: [f64; 2], bottom: f64, frame: f32, rng: &mut ChaCha8Rng| {
        let [w, h] = [wanted[0].min(0.9 * size[0]), wanted[1].min(size[1] - bottom - 0.1)];
        let material = material(kind, tone, rng);
        for _ in 0..12 {
            let left = between(rng, 0.05, size[0] - w - 0.05);
            let corner = [left as f32, bottom as f32];
            let decal = Decal { corner, size: [w as f32, h as f32], material, frame, glow: 0.0 };
            let free = |d: &Decal| {
                (0..2).any(|k| d.corner[k] > corner[k] + decal.size[k] || corner[k] > d.corner[k] + d.size[k])
            };
            if decals.iter().all(free) {
                decals.push(decal);
                return;
            }
        }
    };
    if bare {
        put(Kind::Plain, 0.62, [0.3 * size[0], 0.6 * size[1]], 0.25 * size[1], 0.0, rng);
    }
    let stretches = (size[0] / 4.0).ceil() as usize;
    for _ in 0..stretches {
        put(Kind::Door, 0.4, [0.95, 2.05], 0.0, 0.06, rng);
        if rng.random::<bool>() {
            put(Kind::Window, 0.5, [between(rng, 0.9, 1.6), 1.1], 1.1, 0.07, rng);
        }
        for _ in 0..5 {
            let wanted = [between(rng, 0.3, 0.9), between(rng, 0.4, 0.9)];
            let kind = if rng.random::<f64>() < 0.8 { Kind::Poster } else { Kind::Board };
            let bottom = between(rng, 0.5, (size[1] - 1.1).max(0.6));
            put(kind, 0.5, wanted, bottom, 0.012, rng);
        }
    }
    decals
}
