//! Places that people live in: kitchens, set tables, desks, beds, wardrobes, and the small objects that stand on them.
//!
//! A camera in the hand looks down on such objects from near, where the standard and the randomized places have little. The
//! furniture's own frame has x along the wall or the longer side, y into the room and z up.

mod small_objects;

use super::material::{Kind, Material};
use super::piece::{Piece, WallPlace, material, on_floor, pick, plain};
use super::shape::Shape;
use crate::extent::Extent;
use crate::random::between;
use nalgebra::{Rotation3, Vector3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use small_objects::SmallObject;
use std::f64::consts::PI;

/// What bodies of cupboards and fronts are made of.
const FRONTS: [Kind; 6] = [Kind::Plain, Kind::Plain, Kind::Door, Kind::Door, Kind::Planks, Kind::Metal];

/// Furniture on which small objects stand.
const TOPS: [Kind; 6] = [Kind::Planks, Kind::Plain, Kind::Plain, Kind::Concrete, Kind::Tiles, Kind::Plaster];

/// A random group of furniture.
pub(super) fn furniture(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    match rng.random_range(0..20) {
        0..5 => kitchen(room, rng),
        5..9 => set_table(room, rng),
        9..12 => desk(room, rng),
        12..14 => island(room, rng),
        14..16 => sideboard(room, rng),
        16 => wardrobe(room, rng),
        17 => bed(room, rng),
        _ => low_table(room, rng),
    }
}

/// A group under construction: where it stands and what it has so far.
struct Build {
    foot: Vector3<f64>,
    yaw: f64,
    pieces: Vec<Piece>,
}

impl Build {
    /// On the floor, turned anyhow, `margin` from the walls.
    fn free(room: &Extent, margin: f64, rng: &mut ChaCha8Rng) -> Self {
        let quarter = 0.5 * PI * f64::from(rng.random_range(0..4));
        let yaw = if rng.random::<f64>() < 0.6 { quarter } else { between(rng, -PI, PI) };
        let size = room.max - room.min;
        let margin = margin.min(0.45 * size.x.min(size.y));
        Self { foot: on_floor(room, margin, rng), yaw, pieces: Vec::new() }
    }

    /// With its back to a wall of which it takes `width`.
    fn at_wall(room: &Extent, width: f64, rng: &mut ChaCha8Rng) -> Self {
        let wall = WallPlace::random(room, 0.5 * width, rng);
        let yaw = (-wall.inward.x).atan2(wall.inward.y);
        Self { foot: wall.foot, yaw, pieces: Vec::new() }
    }

    fn at(&self, [x, y, z]: [f64; 3]) -> Vector3<f64> {
        self.foot + Rotation3::from_axis_angle(&Vector3::z_axis(), self.yaw) * Vector3::new(x, y, z)
    }

    fn put(&mut self, shape: Shape, of: Material) {
        self.pieces.push(Piece { shape, surface: plain(of) });
    }

    /// A block whose foot's middle is `place`, turned by `turn`.
    fn block(&mut self, place: [f64; 3], size: [f64; 3], turn: f64, of: Material) {
        self.put(Shape::block(self.at(place), size, self.yaw + turn), of);
    }

    /// A standing cylinder.
    fn round(&mut self, place: [f64; 3], radius: f64, height: f64, of: Material) {
        self.put(Shape::cylinder(self.at(place), Vector3::z(), radius, height), of);
    }

    fn ball(&mut self, [x, y, z]: [f64; 3], radius: f64, of: Material) {
        let center = self.at([x, y, z + radius]);
        self.put(Shape::Ball { center, radius }, of);
    }

    /// Four legs under a top of `size`, whose middle is at `x`, `y`.
    fn legs(&mut self, [x, y]: [f64; 2], [length, width]: [f64; 2], height: f64, of: Material) {
        for (sx, sy) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
            let place = [x + sx * (0.5 * length - 0.04), y + sy * (0.5 * width - 0.04), 0.0];
            self.block(place, [0.05, 0.05, height], 0.0, of);
        }
    }

    /// Up to `count` objects that stand in the rectangle of half sides `half` about `middle`, apart from each other.
    fn small_objects(&mut self, middle: [f64; 3], half: [f64; 2], count: usize, rng: &mut ChaCha8Rng) {
        let mut taken: Vec<[f64; 3]> = Vec::new();
        for _ in 0..3 * count {
            let object = SmallObject::random(rng);
            let reach = object.reach();
            if taken.len() == count || reach > half[0].min(half[1]) {
                continue;
            }
            let [x, y] = [0, 1].map(|k| middle[k] + between(rng, reach - half[k], half[k] - reach));
            if taken.iter().any(|t| (t[0] - x).hypot(t[1] - y) < t[2] + reach) {
                continue;
            }
            taken.push([x, y, reach]);
            object.stand(self, [x, y, middle[2]], rng);
        }
    }
}

/// A material of any of `kinds`, from dark to bright.
fn any(kinds: &[Kind], rng: &mut ChaCha8Rng) -> Material {
    let kind = pick(kinds, rng);
    let tone = between(rng, 0.12, 0.85);
    material(kind, tone, rng)
}

/// Things for a top of this area: from nearly none to crowded.
fn crowd(area: f64, rng: &mut ChaCha8Rng) -> usize {
    (area * between(rng, 1.0, 22.0)).round() as usize
}

/// A row of fronts from `from` to `to` along x, of bodies `depth` deep and `tall`, from `bottom` up.
fn units(build: &mut Build, [from, to]: [f64; 2], depth: f64, bottom: f64, tall: f64, rng: &mut ChaCha8Rng) {
    let front = any(&FRONTS, rng);
    let count = ((to - from) / between(rng, 0.4, 0.65)).round().max(1.0);
    let wide = (to - from) / count;
    let handle = material(Kind::Metal, 0.3, rng);
    let has_handles = rng.random::<bool>();
    for k in 0..count as i32 {
        let x = from + wide * (f64::from(k) + 0.5);
        // Every cupboard has its own grain, all have one colour.
        let own = Material { seed: front.seed.wrapping_add(k as u32), ..front };
        build.block([x, 0.5 * depth, bottom], [wide - 0.006, depth, tall], 0.0, own);
        if has_handles {
            let z = bottom + if bottom > 1.0 { 0.06 } else { tall - 0.1 };
            build.block([x, depth + 0.012, z], [0.14_f64.min(0.6 * wide), 0.024, 0.012], 0.0, handle);
        }
    }
}

/// A worktop with cupboards under and perhaps above it.
fn kitchen(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    let size = room.max - room.min;
    let width = between(rng, 1.2, 3.6).min(0.9 * size.x.min(size.y));
    let mut build = Build::at_wall(room, width, rng);
    let (depth, tall) = (between(rng, 0.52, 0.64), between(rng, 0.82, 0.92));
    let mut ends = [-0.5 * width, 0.5 * width];
    if width > 1.8 && rng.random::<f64>() < 0.45 {
        let fridge = any(&[Kind::Plain, Kind::Metal, Kind::Door], rng);
        build.block([ends[1] - 0.3, 0.31, 0.0], [0.59, 0.62, between(rng, 1.2, 2.1)], 0.0, fridge);
        ends[1] -= 0.61;
    }
    let (middle, long) = (0.5 * (ends[0] + ends[1]), ends[1] - ends[0]);
    units(&mut build, ends, depth, 0.0, tall, rng);
    let slab = between(rng, 0.025, 0.045);
    build.block([middle, 0.5 * depth + 0.01, tall], [long, depth + 0.02, slab], 0.0, any(&TOPS, rng));
    let top = tall + slab;
    if rng.random::<f64>() < 0.5 {
        let splash = any(&[Kind::Tiles, Kind::Plain, Kind::Metal, Kind::Brick], rng);
        build.block([middle, 0.005, top], [long, 0.01, between(rng, 0.3, 0.55)], 0.0, splash);
    }
    let ceiling = room.max.z - room.min.z;
    let (hung, wall_tall) = (top + between(rng, 0.42, 0.6), between(rng, 0.45, 0.8));
    if rng.random::<f64>() < 0.7 && hung + wall_tall < ceiling - 0.05 {
        let until = if rng.random::<bool>() { ends[1] } else { ends[0] + long * between(rng, 0.4, 0.8) };
        units(&mut build, [ends[0], until], between(rng, 0.28, 0.38), hung, wall_tall, rng);
    }
    if rng.random::<f64>() < 0.6 {
        // A hob or a sink: a dark or a bright field, with a tap.
        let x = between(rng, ends[0] + 0.3, ends[1] - 0.3);
        let field = any(&[Kind::Plain, Kind::Metal], rng);
        build.block([x, 0.5 * depth, top], [0.52, 0.42, 0.006], 0.0, field);
        build.round([x, 0.07, top], 0.014, 0.26, material(Kind::Metal, 0.6, rng));
        build.block([x, 0.15, top + 0.25], [0.022, 0.2, 0.022], 0.0, material(Kind::Metal, 0.6, rng));
    }
    let half = [0.5 * long, 0.5 * depth - 0.03];
    build.small_objects([middle, 0.5 * depth, top + 0.006], half, crowd(long * depth, rng), rng);
    build.pieces
}

/// A chair whose sitter would look along its own y, turned by `turn`.
fn chair(build: &mut Build, [x, y]: [f64; 2], turn: f64, of: [Material; 2]) {
    let (sin, cos) = turn.sin_cos();
    let at = |u: f64, v: f64, z: f64| [x + cos * u - sin * v, y + sin * u + cos * v, z];
    build.block(at(0.0, 0.0, 0.43), [0.42, 0.42, 0.04], turn, of[0]);
    build.block(at(0.0, -0.2, 0.47), [0.4, 0.035, 0.42], turn, of[0]);
    for (u, v) in [(-0.18, -0.18), (-0.18, 0.18), (0.18, -0.18), (0.18, 0.18)] {
        build.round(at(u, v, 0.0), 0.017, 0.43, of[1]);
    }
}

/// A table, square or round, with chairs about it and objects on it.
fn set_table(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    let (length, width, tall) = (between(rng, 0.8, 2.0), between(rng, 0.65, 1.0), between(rng, 0.68, 0.78));
    let mut build = Build::free(room, 0.5 * width + 0.2, rng);
    let (top, legs) = (any(&TOPS, rng), any(&[Kind::Metal, Kind::Planks, Kind::Plain], rng));
    let is_round = rng.random::<f64>() < 0.25;
    let (length, thick) = (if is_round { width } else { length }, between(rng, 0.02, 0.05));
    if is_round {
        build.round([0.0, 0.0, tall - thick], 0.5 * width, thick, top);
        build.round([0.0; 3], 0.05, tall - thick, legs);
    } else {
        build.block([0.0, 0.0, tall - thick], [length, width, thick], 0.0, top);
        build.legs([0.0; 2], [length, width], tall - thick, legs);
    }
    let inner = if is_round { 0.68 } else { 0.97 };
    let half = [0.5 * inner * length, 0.5 * inner * width];
    build.small_objects([0.0, 0.0, tall], half, crowd(length * width, rng), rng);
    let seat = [any(&[Kind::Fabric, Kind::Planks, Kind::Plain], rng), legs];
    for side in [-1.0, 1.0] {
        for k in 0..rng.random_range(0..=2) {
            let x = if k == 0 { -0.25 } else { 0.25 } * length;
            let away = 0.5 * width + between(rng, -0.05, 0.2);
            let turn = if side < 0.0 { 0.0 } else { PI } + between(rng, -0.25, 0.25);
            if k == 0 || length > 1.1 {
                chair(&mut build, [x, side * away], turn, seat);
            }
        }
    }
    build.pieces
}

/// A desk with screens, a keyboard and what lies about.
fn desk(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    let (length, width, tall) = (between(rng, 1.0, 1.8), between(rng, 0.55, 0.8), between(rng, 0.7, 0.76));
    let mut build = Build::at_wall(room, length, rng);
    let y = 0.5 * width;
    build.block([0.0, y, tall - 0.03], [length, width, 0.03], 0.0, any(&TOPS, rng));
    let legs = any(&[Kind::Metal, Kind::Plain], rng);
    build.legs([0.0, y], [length, width], tall - 0.03, legs);
    let (screens, wide) = (rng.random_range(1..=2), between(rng, 0.4, 0.62));
    let dark = material(Kind::Plain, 0.12, rng);
    for k in 0..screens {
        let x = 0.68 * (f64::from(k) - 0.5 * f64::from(screens - 1));
        if x.abs() + 0.5 * wide > 0.5 * length {
            continue;
        }
        let shown = if rng.random::<bool>() { dark } else { any(&[Kind::Poster, Kind::Board], rng) };
        build.round([x, 0.2, tall], 0.1, 0.012, dark);
        build.round([x, 0.2, tall], 0.02, 0.2, dark);
        build.block([x, 0.22, tall + 0.1], [wide, 0.03, 0.6 * wide], between(rng, -0.2, 0.2), shown);
    }
    build.block([0.0, 0.62 * width, tall], [0.44, 0.14, 0.02], 0.0, any(&[Kind::Books, Kind::Plain], rng));
    let half = [0.25 * length - 0.12, 0.28 * width];
    for side in [-1.0, 1.0] {
        let count = crowd(0.5 * length * width, rng);
        build.small_objects([side * (0.25 * length + 0.1), 0.68 * width, tall], half, count, rng);
    }
    if rng.random::<f64>() < 0.4 {
        let (shelf, z) = (any(&TOPS, rng), tall + between(rng, 0.5, 0.8));
        build.block([0.0, 0.12, z], [length, 0.24, 0.025], 0.0, shelf);
        build.small_objects([0.0, 0.12, z + 0.025], [0.5 * length, 0.11], crowd(0.5 * length, rng), rng);
    }
    if rng.random::<f64>() < 0.7 {
        let seat = [any(&[Kind::Fabric, Kind::Plain], rng), legs];
        let (x, turn) = (between(rng, -0.2, 0.2), PI + between(rng, -0.5, 0.5));
        chair(&mut build, [x, width + between(rng, 0.05, 0.35)], turn, seat);
    }
    build.pieces
}

/// Cupboards that stand free, with a worktop and stools.
fn island(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    let (long, depth, tall) = (between(rng, 0.9, 2.2), between(rng, 0.55, 0.95), between(rng, 0.82, 1.05));
    let mut build = Build::free(room, 0.5 * depth + 0.1, rng);
    units(&mut build, [-0.5 * long, 0.5 * long], depth, 0.0, tall, rng);
    let over = between(rng, 0.02, 0.2);
    let top = [long + 2.0 * over, depth + 2.0 * over, 0.035];
    build.block([0.0, 0.5 * depth, tall], top, 0.0, any(&TOPS, rng));
    let half = [0.5 * long, 0.5 * depth];
    build.small_objects([0.0, 0.5 * depth, tall + 0.035], half, crowd(long * depth, rng), rng);
    let (seat, leg) = (any(&[Kind::Fabric, Kind::Planks], rng), any(&[Kind::Metal], rng));
    for k in 0..rng.random_range(0..=3) {
        let place = [0.5 * (f64::from(k) - 1.0), -0.3 - over, 0.0];
        build.round(place, 0.025, 0.62, leg);
        build.round([place[0], place[1], 0.62], 0.17, 0.05, seat);
    }
    build.pieces
}

/// A low cupboard with objects, perhaps a large screen, on it.
fn sideboard(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    let (long, depth, tall) = (between(rng, 0.8, 2.2), between(rng, 0.32, 0.5), between(rng, 0.4, 1.1));
    let mut build = Build::at_wall(room, long, rng);
    units(&mut build, [-0.5 * long, 0.5 * long], depth, 0.0, tall, rng);
    build.block([0.0, 0.5 * depth, tall], [long, depth, 0.02], 0.0, any(&TOPS, rng));
    let half = [0.5 * long, 0.5 * depth - 0.02];
    if rng.random::<f64>() < 0.35 {
        let wide = between(rng, 0.5, 0.95) * long;
        let screen = material(Kind::Plain, 0.1, rng);
        build.block([0.0, 0.1, tall + 0.06], [wide, 0.04, 0.56 * wide], 0.0, screen);
        build.block([0.0, 0.1, tall + 0.02], [0.3 * wide, 0.12, 0.05], 0.0, screen);
    } else {
        build.small_objects([0.0, 0.5 * depth, tall + 0.02], half, crowd(1.5 * long * depth, rng), rng);
    }
    build.pieces
}

fn wardrobe(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    let tall = between(rng, 1.7, 2.4).min(room.max.z - room.min.z - 0.05);
    let (long, depth) = (between(rng, 0.8, 2.4), between(rng, 0.5, 0.65));
    let mut build = Build::at_wall(room, long, rng);
    units(&mut build, [-0.5 * long, 0.5 * long], depth, 0.0, tall, rng);
    build.pieces
}

fn bed(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    let (wide, long, tall) = (between(rng, 0.9, 1.8), between(rng, 1.9, 2.1), between(rng, 0.25, 0.5));
    let mut build = Build::at_wall(room, wide + 0.5, rng);
    let cloth = [Kind::Fabric, Kind::Fabric, Kind::Plain, Kind::Poster];
    build.block([0.0, 0.02, 0.0], [wide, 0.04, tall + between(rng, 0.3, 0.7)], 0.0, any(&FRONTS, rng));
    build.block(
        [0.0, 0.04 + 0.5 * long, 0.0],
        [wide, long, tall],
        0.0,
        any(&[Kind::Planks, Kind::Fabric], rng),
    );
    build.block([0.0, 0.04 + 0.5 * long, tall], [wide - 0.04, long - 0.04, 0.14], 0.0, any(&cloth, rng));
    let cover = [wide + 0.02, 0.65 * long, 0.05];
    build.block([0.0, 0.04 + 0.66 * long, tall + 0.12], cover, 0.0, any(&cloth, rng));
    for side in if wide > 1.3 { vec![-0.25, 0.25] } else { vec![0.0] } {
        let turn = between(rng, -0.3, 0.3);
        build.block([side * wide, 0.3, tall + 0.14], [0.55, 0.34, 0.12], turn, any(&cloth, rng));
    }
    build.pieces
}

fn low_table(room: &Extent, rng: &mut ChaCha8Rng) -> Vec<Piece> {
    let (length, width, tall) = (between(rng, 0.5, 1.2), between(rng, 0.45, 0.75), between(rng, 0.32, 0.5));
    let mut build = Build::free(room, 0.5 * width + 0.1, rng);
    build.block([0.0, 0.0, tall - 0.03], [length, width, 0.03], 0.0, any(&TOPS, rng));
    let legs = any(&[Kind::Metal, Kind::Planks], rng);
    build.legs([0.0; 2], [length, width], tall - 0.03, legs);
    build.small_objects([0.0, 0.0, tall], [0.5 * length, 0.5 * width], crowd(length * width, rng), rng);
    build.pieces
}
