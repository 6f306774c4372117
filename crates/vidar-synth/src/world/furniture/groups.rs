//! Groups of shapes that belong together: a table with what lies on it, shelves, pipes.

use crate::config::SceneKind;
use crate::extent::Extent;
use crate::random::between;
use crate::world::material::{Decal, Kind, Material, Surface};
use crate::world::piece::{Piece, WallPlace, material, on_floor, pick, piece, plain};
use crate::world::shape::Shape;
use nalgebra::{Rotation3, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use std::f64::consts::{FRAC_PI_2, PI};

/// Groups of shapes that belong together.
#[derive(Clone, Copy)]
pub(super) enum Group {
    Crates,
    Table,
    Shelf,
    Cabinet,
    Barrel,
    Ball,
    StandingPipe,
    LyingPipe,
    Curtain,
    Picture,
    Chair,
    Pillar,
    Duct,
}

impl Group {
    pub(super) fn random(scene: SceneKind, rng: &mut ChaCha8Rng) -> Self {
        use Group::*;
        let choice: &[Self] = match scene {
            SceneKind::Room => &[
                Crates,
                Crates,
                Crates,
                Table,
                Table,
                Shelf,
                Shelf,
                Shelf,
                Cabinet,
                Barrel,
                Ball,
                StandingPipe,
                LyingPipe,
                Curtain,
                Curtain,
                Picture,
                Picture,
                Picture,
                Chair,
                Chair,
                Duct,
            ],
            SceneKind::Hall => &[
                Crates,
                Crates,
                Crates,
                Crates,
                Table,
                Shelf,
                Shelf,
                Cabinet,
                Barrel,
                Barrel,
                Ball,
                StandingPipe,
                StandingPipe,
                LyingPipe,
                LyingPipe,
                Picture,
                Pillar,
                Pillar,
                Duct,
                Duct,
            ],
            SceneKind::Corridor => &[
                Crates,
                Crates,
                Shelf,
                Cabinet,
                Barrel,
                StandingPipe,
                StandingPipe,
                LyingPipe,
                LyingPipe,
                Picture,
                Picture,
                Picture,
                Picture,
                Pillar,
                Chair,
                Duct,
                Curtain,
            ],
        };
        pick(choice, rng)
    }

    pub(super) fn build(self, room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
        match self {
            Self::Crates => crates(room, rng),
            Self::Table => table(room, rng),
            Self::Shelf => shelf(room, rng),
            Self::Cabinet => cabinet(room, rng),
            Self::Barrel => barrel(room, rng),
            Self::Ball => ball(room, rng),
            Self::StandingPipe => standing_pipe(room, rng),
            Self::LyingPipe => lying_pipe(room, rng),
            Self::Curtain => curtain(room, rng),
            Self::Picture => picture(room, rng),
            Self::Chair => chair(room, rng),
            Self::Pillar => pillar(room, rng),
            Self::Duct => duct(room, rng),
        }
    }
}

fn crates(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    let mut foot = on_floor(room, 0.5, rng);
    let mut pieces = Vec::new();
    let mut side = between(rng, 0.35, 0.85);
    for _ in 0..rng.random_range(1..=3) {
        let size = [side * between(rng, 0.8, 1.3), side, side * between(rng, 0.6, 1.0)];
        let kind = match rng.random_range(0..8) {
            0 => Kind::Metal,
            1 => Kind::Hazard,
            2 | 3 => Kind::Planks,
            _ => Kind::Cardboard,
        };
        let shape = Shape::block(foot, size, between(rng, 0.0, PI));
        pieces.push(piece(shape, kind, 0.45, rng));
        foot.z += size[2];
        side *= between(rng, 0.6, 0.9);
    }
    pieces
}

fn table(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    let foot = on_floor(room, 0.8, rng);
    let yaw = if rng.random::<bool>() { 0.0 } else { between(rng, 0.0, PI) };
    let turn = Rotation3::from_axis_angle(&Vector3::z_axis(), yaw);
    let (length, width, height) = (between(rng, 1.0, 1.6), between(rng, 0.6, 0.8), between(rng, 0.68, 0.8));
    let at = |x: f64, y: f64, z: f64| foot + turn * Vector3::new(x, y, z);
    let top = Shape::block(at(0.0, 0.0, height - 0.04), [length, width, 0.04], yaw);
    let mut pieces = vec![piece(top, Kind::Planks, 0.5, rng)];
    for (sx, sy) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
        let place = at(sx * (0.5 * length - 0.05), sy * (0.5 * width - 0.05), 0.0);
        pieces.push(piece(Shape::block(place, [0.06, 0.06, height - 0.04], yaw), Kind::Metal, 0.35, rng));
    }
    // Things on the table, one per stretch of its length.
    let n = rng.random_range(2..=4);
    for k in 0..n {
        let x = length * ((f64::from(k) + 0.5) / f64::from(n) - 0.5);
        let place = at(x, between(rng, -0.15, 0.15) * width, height);
        let reach = (0.4 * length / f64::from(n)).min(0.3 * width);
        pieces.push(match rng.random_range(0..4) {
            0 => {
                let radius = reach * between(rng, 0.4, 0.7);
                piece(
                    Shape::cylinder(place, Vector3::z(), radius, between(rng, 0.1, 0.35)),
                    Kind::Poster,
                    0.5,
                    rng,
                )
            }
            1 => {
                let radius = reach * between(rng, 0.4, 0.6);
                let center = place + Vector3::z() * radius;
                piece(Shape::Ball { center, radius }, Kind::Fabric, 0.5, rng)
            }
            2 => piece(
                Shape::block(place, [0.05, reach * 1.4, between(rng, 0.25, 0.4)], yaw + FRAC_PI_2),
                Kind::Poster,
                0.5,
                rng,
            ),
            _ => {
                let size = [reach, reach, between(rng, 0.08, 0.3)];
                piece(Shape::block(place, size, yaw + between(rng, -0.4, 0.4)), Kind::Cardboard, 0.5, rng)
            }
        });
    }
    pieces
}

fn shelf(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    let (width, depth) = (between(rng, 0.9, 1.7), between(rng, 0.28, 0.42));
    let height = between(rng, 1.2, 2.1).min(room.max.z - room.min.z - 0.3);
    let wall = WallPlace::random(room, 0.5 * width, rng);
    let board = 0.03;
    let wood = material(Kind::Planks, 0.45, rng);
    let wooden = |shape| Piece { shape, surface: plain(wood) };
    let side = 0.5 * (width - board);
    let mut pieces = vec![
        wooden(wall.block(-side, 0.0, 0.0, [board, depth, height])),
        wooden(wall.block(side, 0.0, 0.0, [board, depth, height])),
    ];
    let levels = rng.random_range(3..=5);
    let gap = (height - board) / f64::from(levels);
    for level in 0..=levels {
        let z = gap * f64::from(level);
        pieces.push(wooden(wall.block(0.0, 0.0, z, [width - 2.0 * board, depth, board])));
        if level == levels {
            continue;
        }
        let mut x = -side + 0.5 * board;
        while x < side - 0.15 {
            let w = between(rng, 0.1, 0.45).min(side - 0.5 * board - x);
            if rng.random::<f64>() < 0.8 {
                let size =
                    [w - 0.01, depth * between(rng, 0.6, 0.95), (gap - board) * between(rng, 0.5, 0.95)];
                let kind = if rng.random::<f64>() < 0.6 { Kind::Books } else { Kind::Cardboard };
                pieces.push(piece(wall.block(x + 0.5 * w, 0.0, z + board, size), kind, 0.5, rng));
            }
            x += w;
        }
    }
    pieces
}

fn cabinet(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    let size = [between(rng, 0.6, 1.2), between(rng, 0.4, 0.6), between(rng, 0.8, 2.0)];
    let wall = WallPlace::random(room, 0.5 * size[0], rng);
    let kind = if rng.random::<bool>() { Kind::Metal } else { Kind::Door };
    let mut pieces = vec![piece(wall.block(0.0, 0.0, 0.0, size), kind, 0.5, rng)];
    if rng.random::<bool>() && size[2] < 1.6 {
        let top = [0.5 * size[0], 0.7 * size[1], between(rng, 0.2, 0.4)];
        pieces.push(piece(wall.block(0.1, 0.05, size[2], top), Kind::Cardboard, 0.5, rng));
    }
    pieces
}

fn barrel(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    let foot = on_floor(room, 0.4, rng);
    let (radius, height) = (between(rng, 0.2, 0.35), between(rng, 0.5, 1.0));
    let kind = if rng.random::<bool>() { Kind::Metal } else { Kind::Hazard };
    vec![piece(Shape::cylinder(foot, Vector3::z(), radius, height), kind, 0.45, rng)]
}

fn ball(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    let radius = between(rng, 0.12, 0.35);
    let center = on_floor(room, 0.4, rng) + Vector3::z() * radius;
    vec![piece(Shape::Ball { center, radius }, Kind::Fabric, 0.5, rng)]
}

fn standing_pipe(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    let wall = WallPlace::random(room, 0.3, rng);
    let height = room.max.z - room.min.z;
    (0..rng.random_range(1..=3))
        .map(|k| {
            let radius = between(rng, 0.03, 0.09);
            let base = wall.foot + wall.along * (0.2 * f64::from(k) - 0.2) + wall.inward * 0.12;
            piece(Shape::cylinder(base, Vector3::z(), radius, height), Kind::Metal, 0.5, rng)
        })
        .collect()
}

fn lying_pipe(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    let length = between(rng, 1.5, 4.0);
    let wall = WallPlace::random(room, 0.5 * length, rng);
    let from_ceiling = rng.random::<f64>() < 0.7;
    let height = room.max.z - room.min.z;
    let z = if from_ceiling { height - between(rng, 0.2, 0.6) } else { between(rng, 0.15, 0.4) };
    let radius = between(rng, 0.04, 0.1);
    let base = wall.foot - wall.along * (0.5 * length) + wall.inward * (radius + 0.05) + Vector3::z() * z;
    vec![piece(Shape::cylinder(base, wall.along, radius, length), Kind::Metal, 0.55, rng)]
}

/// A hanging cloth: narrow sheets along a wave in front of a wall.
fn curtain(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    let width = between(rng, 1.0, 2.2);
    let wall = WallPlace::random(room, 0.5 * width + 0.05, rng);
    let top = (room.max.z - room.min.z - 0.3).min(2.6);
    let (strips, waves) = (28, (width / 0.24).round());
    let depth = between(rng, 0.03, 0.06);
    let place = |k: i32| {
        let share = f64::from(k) / f64::from(strips);
        let out = 0.12 + depth * (2.0 * PI * waves * share).sin();
        wall.foot + wall.along * (width * (share - 0.5)) + wall.inward * out + Vector3::z() * 0.08
    };
    let cloth = material(Kind::Fabric, 0.5, rng);
    (0..strips)
        .map(|k| {
            let (corner, next) = (place(k), place(k + 1));
            let u = next - corner;
            let size = [u.norm(), top - 0.08];
            let shape = Shape::Sheet { corner, u_axis: u.normalize(), v_axis: Vector3::z(), size };
            // Each strip has its own fold of cloth; the stripes differ, as woven ones seen in folds do.
            let own = Material { seed: cloth.seed.wrapping_add(k as u32), ..cloth };
            Piece { shape, surface: plain(own) }
        })
        .collect()
}

fn picture(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    let (width, tall) = (between(rng, 0.4, 1.5), between(rng, 0.4, 1.1));
    let wall = WallPlace::random(room, 0.5 * width, rng);
    let highest = room.max.z - room.min.z - tall - 0.2;
    let z = between(rng, 0.8_f64.min(highest), highest.min(2.6));
    let kind = if rng.random::<f64>() < 0.7 { Kind::Poster } else { Kind::Board };
    let base = material(kind, 0.5, rng);
    let shape = wall.block(0.0, 0.0, z, [width, between(rng, 0.02, 0.06), tall]);
    let framed =
        Decal { corner: [0.0; 2], size: [width as f32, tall as f32], material: base, frame: 0.03, glow: 0.0 };
    vec![Piece { shape, surface: Surface { base, decals: vec![framed] } }]
}

fn chair(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    let foot = on_floor(room, 0.5, rng);
    let yaw = between(rng, 0.0, 2.0 * PI);
    let turn = Rotation3::from_axis_angle(&Vector3::z_axis(), yaw);
    let at = |x: f64, y: f64, z: f64| foot + turn * Vector3::new(x, y, z);
    let fabric = material(Kind::Fabric, 0.45, rng);
    let metal = material(Kind::Metal, 0.4, rng);
    let of = |shape, m: Material| Piece { shape, surface: plain(m) };
    let mut pieces = vec![
        of(Shape::block(at(0.0, 0.0, 0.42), [0.44, 0.44, 0.06], yaw), fabric),
        of(Shape::block(at(-0.2, 0.0, 0.48), [0.04, 0.42, 0.45], yaw), fabric),
    ];
    for (x, y) in [(-0.19, -0.19), (-0.19, 0.19), (0.19, -0.19), (0.19, 0.19)] {
        pieces.push(of(Shape::cylinder(at(x, y, 0.0), Vector3::z(), 0.018, 0.42), metal));
    }
    pieces
}

fn pillar(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    let height = room.max.z - room.min.z;
    if rng.random::<bool>() {
        let side = between(rng, 0.25, 0.5);
        let wall = WallPlace::random(room, side, rng);
        return vec![piece(wall.block(0.0, 0.0, 0.0, [side, side, height]), Kind::Concrete, 0.5, rng)];
    }
    let radius = between(rng, 0.15, 0.3);
    let foot = on_floor(room, 0.5, rng);
    vec![piece(Shape::cylinder(foot, Vector3::z(), radius, height), Kind::Concrete, 0.5, rng)]
}

fn duct(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    let length = between(rng, 1.5, 4.0);
    let (side, drop) = (between(rng, 0.2, 0.4), between(rng, 0.0, 0.2));
    let foot = on_floor(room, 0.4, rng);
    let foot = Vector3::new(foot.x, foot.y, room.max.z - drop - side);
    let yaw = if rng.random::<bool>() { 0.0 } else { FRAC_PI_2 };
    vec![piece(Shape::block(foot, [length, side, side], yaw), Kind::Metal, 0.5, rng)]
}
