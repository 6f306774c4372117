//! Worlds that differ in everything that a seed can change: size, light, materials, furniture.
//!
//! A network that is to work in places it never saw must be trained on many that have little in common. Where the standard
//! places keep their size and style, [`crate::Variety::Randomized`] draws them anew for each seed, and adds furniture that
//! the standard places lack: stairs, sofas, lamps, plants, rugs, windows that shine.

use super::light::Lighting;
use super::material::{Decal, Kind, Material, Surface};
use super::piece::{Piece, WallPlace, material, on_floor, pick, piece, plain};
use super::shape::Shape;
use crate::config::{SynthConfig, Variety};
use crate::extent::Extent;
use crate::random::{Purpose, between, stream};
use nalgebra::Vector3;
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use std::f64::consts::PI;

/// Light of the place that `config` asks for.
pub(super) fn lighting(config: &SynthConfig) -> Lighting {
    if config.variety == Variety::Standard {
        return Lighting::USUAL;
    }
    let mut rng = stream(config.seed, Purpose::Light);
    Lighting {
        spacing_m: between(&mut rng, 2.5, 8.0),
        least_power: between(&mut rng, 0.0, 0.12),
        power_range: between(&mut rng, 0.05, 0.4),
        drop_m: between(&mut rng, 0.1, 0.9),
        ambient: between(&mut rng, 0.06, 0.4),
        // From dim to washed out.
        gain: (0.55 * (2.0 * rng.random::<f32>() - 1.0)).exp(),
    }
}

/// Materials of the faces −x, +x, −y, +y, floor, ceiling.
pub(super) fn shell(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Surface> {
    let walls = [
        Kind::Plaster,
        Kind::Plain,
        Kind::Plain,
        Kind::Brick,
        Kind::Concrete,
        Kind::Planks,
        Kind::Tiles,
        Kind::Fabric,
    ];
    let floors = [Kind::Planks, Kind::Tiles, Kind::Concrete, Kind::Fabric, Kind::Plain, Kind::Plaster];
    let ceilings = [Kind::CeilingPanels, Kind::Plain, Kind::Plaster, Kind::Concrete, Kind::Planks];
    let size = room.max - room.min;
    // Real rooms mostly have one kind of wall, sometimes another on one side.
    let (common, other) = (pick(&walls, rng), pick(&walls, rng));
    let tone = between(rng, 0.3, 0.85);
    let odd = rng.random_range(0..8);
    let mut surfaces = Vec::with_capacity(6);
    for k in 0..4 {
        let kind = if k == odd { other } else { common };
        let width = if k < 2 { size.y } else { size.x };
        let base = material(kind, tone, rng);
        surfaces.push(Surface { base, decals: wall_decals([width, size.z], rng) });
    }
    let (floor, ceiling) = (pick(&floors, rng), pick(&ceilings, rng));
    let floor_tone = between(rng, 0.15, 0.7);
    surfaces.push(plain(material(floor, floor_tone, rng)));
    let mut above = plain(material(ceiling, between(rng, 0.4, 0.85), rng));
    above.decals = ceiling_lights([size.x, size.y], rng);
    surfaces.push(above);
    surfaces
}

fn wall_decals(size: [f64; 2], rng: &mut ChaCha8Rng) -> Vec<Decal> {
    let mut decals: Vec<Decal> = Vec::new();
    // From bare to crowded.
    let wanted = (rng.random::<f64>().powi(2) * 1.6 * size[0]).round() as usize;
    for _ in 0..wanted {
        let kind = pick(
            &[Kind::Door, Kind::Window, Kind::Window, Kind::Poster, Kind::Poster, Kind::Poster, Kind::Board],
            rng,
        );
        let (asked, bottom, frame, glow) = match kind {
            Kind::Door => ([between(rng, 0.8, 1.2), between(rng, 1.95, 2.3)], 0.0, 0.06, 0.0),
            // By day a window outshines the room, by night it is dark.
            Kind::Window => {
                let (w, h, sill) = (between(rng, 0.6, 2.4), between(rng, 0.7, 1.8), between(rng, 0.3, 1.2));
                ([w, h], sill, 0.07, rng.random::<f64>() * 3.0)
            }
            _ => ([between(rng, 0.25, 1.6), between(rng, 0.25, 1.2)], between(rng, 0.3, 1.6), 0.012, 0.0),
        };
        let [w, h] = [asked[0].min(0.8 * size[0]), asked[1].min(size[1] - bottom - 0.15)];
        if h < 0.2 {
            continue;
        }
        let left = between(rng, 0.05, (size[0] - w - 0.05).max(0.06));
        let corner = [left as f32, bottom as f32];
        let tone = between(rng, 0.2, 0.8);
        let material = material(kind, tone, rng);
        let decal = Decal { corner, size: [w as f32, h as f32], material, frame, glow: glow as f32 };
        let free = |d: &Decal| {
            (0..2).any(|k| d.corner[k] > corner[k] + decal.size[k] || corner[k] > d.corner[k] + d.size[k])
        };
        if decals.iter().all(free) {
            decals.push(decal);
        }
    }
    decals
}

/// Bright panels under the ceiling, in a row or none.
fn ceiling_lights(size: [f64; 2], rng: &mut ChaCha8Rng) -> Vec<Decal> {
    let count = rng.random_range(0..=4);
    let [w, h] = [between(rng, 0.15, 0.7), between(rng, 0.5, 1.4)];
    let glow = between(rng, 1.0, 5.0) as f32;
    let at = |k: usize| {
        let u = size[0] * (k as f64 + 0.5) / count as f64 - 0.5 * w;
        [u as f32, (0.5 * (size[1] - h)) as f32]
    };
    let base = material(Kind::Plain, 0.85, rng);
    (0..count)
        .map(|k| Decal { corner: at(k), size: [w as f32, h as f32], material: base, frame: 0.03, glow })
        .collect()
}

/// Furniture that only randomized places have.
pub(super) fn furniture(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    match rng.random_range(0..7) {
        0 => stairs(room, rng),
        1 => sofa(room, rng),
        2 => floor_lamp(room, rng),
        3 => plant(room, rng),
        4 => rug(room, rng),
        5 => partition(room, rng),
        _ => heap(room, rng),
    }
}

/// A new style for pieces that the standard places have: another material and brightness on each, now and then.
pub(super) fn restyle(pieces: &mut [Piece], rng: &mut ChaCha8Rng) {
    let kinds = [
        Kind::Plain,
        Kind::Planks,
        Kind::Fabric,
        Kind::Metal,
        Kind::Plaster,
        Kind::Tiles,
        Kind::Concrete,
        Kind::Poster,
    ];
    if rng.random::<f64>() < 0.4 {
        let (kind, tone) = (pick(&kinds, rng), between(rng, 0.08, 0.9));
        for piece in pieces.iter_mut().filter(|p| p.surface.decals.is_empty()) {
            let own: Material = material(kind, tone, rng);
            piece.surface = plain(own);
        }
    }
}

/// Steps that rise along a wall.
fn stairs(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    let steps = rng.random_range(3..=9);
    let (rise, run, width) = (between(rng, 0.14, 0.2), between(rng, 0.22, 0.32), between(rng, 0.7, 1.3));
    let length = run * f64::from(steps);
    let wall = WallPlace::random(room, 0.5 * length, rng);
    let kind = pick(&[Kind::Concrete, Kind::Planks, Kind::Tiles], rng);
    let tone = between(rng, 0.25, 0.7);
    (0..steps)
        .map(|k| {
            let offset = run * (f64::from(k) + 0.5) - 0.5 * length;
            piece(wall.block(offset, 0.0, 0.0, [run, width, rise * f64::from(k + 1)]), kind, tone, rng)
        })
        .collect()
}

fn sofa(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    let (width, depth, seat) = (between(rng, 1.0, 2.2), between(rng, 0.75, 0.95), between(rng, 0.35, 0.45));
    let wall = WallPlace::random(room, 0.5 * width, rng);
    let cloth = material(pick(&[Kind::Fabric, Kind::Plain], rng), between(rng, 0.15, 0.8), rng);
    let of = |shape| Piece { shape, surface: plain(cloth) };
    let (back, arm) = (between(rng, 0.3, 0.5), 0.16);
    let mut pieces = vec![
        of(wall.block(0.0, 0.0, 0.0, [width, depth, seat])),
        of(wall.block(0.0, 0.0, seat, [width, 0.2, back])),
        of(wall.block(0.5 * (width - arm), 0.2, seat, [arm, depth - 0.2, 0.2])),
        of(wall.block(0.5 * (arm - width), 0.2, seat, [arm, depth - 0.2, 0.2])),
    ];
    if rng.random::<bool>() {
        let radius = between(rng, 0.12, 0.2);
        let center = wall.foot + wall.inward * (0.2 + radius) + Vector3::z() * (seat + radius);
        pieces.push(piece(Shape::Ball { center, radius }, Kind::Fabric, 0.5, rng));
    }
    pieces
}

fn floor_lamp(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    let foot = on_floor(room, 0.35, rng);
    let (height, radius) =
        (between(rng, 1.0, 1.7).min(room.max.z - room.min.z - 0.5), between(rng, 0.1, 0.2));
    let base = Shape::cylinder(foot, Vector3::z(), 0.14, 0.03);
    let pole = Shape::cylinder(foot + Vector3::z() * 0.03, Vector3::z(), 0.015, height);
    let shade_at = foot + Vector3::z() * (height + 0.03);
    let round = rng.random::<bool>();
    let shade = if round {
        Shape::Ball { center: shade_at + Vector3::z() * radius, radius }
    } else {
        Shape::cylinder(shade_at, Vector3::z(), radius, 0.3)
    };
    let [u, v] = shade.face_size(0).map(|s| s as f32);
    let light = material(Kind::Plain, 0.8, rng);
    let shine = Decal {
        corner: [0.0; 2],
        size: [u, v],
        material: light,
        frame: 0.0,
        glow: between(rng, 0.5, 4.0) as f32,
    };
    vec![
        piece(base, Kind::Metal, 0.4, rng),
        piece(pole, Kind::Metal, 0.4, rng),
        Piece { shape: shade, surface: Surface { base: light, decals: vec![shine] } },
    ]
}

/// A pot with a crown of balls.
fn plant(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    let foot = on_floor(room, 0.5, rng);
    let (pot, height) = (between(rng, 0.12, 0.22), between(rng, 0.2, 0.4));
    let mut pieces = vec![piece(Shape::cylinder(foot, Vector3::z(), pot, height), Kind::Plaster, 0.45, rng)];
    let stem = between(rng, 0.3, 0.9);
    let top = foot + Vector3::z() * height;
    pieces.push(piece(Shape::cylinder(top, Vector3::z(), 0.02, stem), Kind::Planks, 0.25, rng));
    for _ in 0..rng.random_range(4..=12) {
        let away = Vector3::new(between(rng, -0.3, 0.3), between(rng, -0.3, 0.3), between(rng, -0.25, 0.25));
        let center = top + Vector3::z() * stem + away;
        let leaf = Shape::Ball { center, radius: between(rng, 0.06, 0.16) };
        pieces.push(piece(leaf, Kind::Concrete, 0.25, rng));
    }
    pieces
}

fn rug(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    let size = [between(rng, 1.0, 3.0), between(rng, 0.8, 2.0), 0.012];
    let kind = pick(&[Kind::Fabric, Kind::Poster, Kind::Fabric], rng);
    let (foot, yaw, tone) = (on_floor(room, 0.9, rng), between(rng, 0.0, PI), between(rng, 0.15, 0.8));
    vec![piece(Shape::block(foot, size, yaw), kind, tone, rng)]
}

/// A thin wall that stands in the room.
fn partition(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    let tall = (room.max.z - room.min.z - 0.05) * between(rng, 0.4, 1.0);
    let size = [between(rng, 0.8, 2.5), between(rng, 0.03, 0.15), tall];
    let kind = pick(&[Kind::Plain, Kind::Plaster, Kind::Brick, Kind::Poster, Kind::Planks], rng);
    let yaw = if rng.random::<f64>() < 0.7 {
        0.5 * PI * f64::from(rng.random_range(0..2))
    } else {
        between(rng, 0.0, PI)
    };
    let (foot, tone) = (on_floor(room, 0.6, rng), between(rng, 0.3, 0.85));
    vec![piece(Shape::block(foot, size, yaw), kind, tone, rng)]
}

/// Small objects of all shapes, close together.
fn heap(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    let middle = on_floor(room, 0.8, rng);
    let kinds =
        [Kind::Cardboard, Kind::Fabric, Kind::Metal, Kind::Poster, Kind::Books, Kind::Plain, Kind::Planks];
    (0..rng.random_range(4..=10))
        .map(|_| {
            let foot = middle + Vector3::new(between(rng, -0.6, 0.6), between(rng, -0.6, 0.6), 0.0);
            let s = between(rng, 0.08, 0.35);
            let shape = match rng.random_range(0..4) {
                0 => Shape::Ball { center: foot + Vector3::z() * s, radius: s },
                1 => Shape::cylinder(foot, Vector3::z(), 0.6 * s, 1.5 * s),
                2 => {
                    let along = Vector3::new(1.0, between(rng, -1.0, 1.0), 0.0).normalize();
                    Shape::cylinder(foot + Vector3::z() * (0.5 * s), along, 0.5 * s, 1.6 * s)
                }
                _ => Shape::block(foot, [s, 1.4 * s, between(rng, 0.3, 1.8) * s], between(rng, 0.0, PI)),
            };
            let (kind, tone) = (pick(&kinds, rng), between(rng, 0.1, 0.85));
            piece(shape, kind, tone, rng)
        })
        .collect()
}
