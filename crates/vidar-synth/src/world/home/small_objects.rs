//! Small things that stand on tops.

use super::{Build, any};
use crate::random::between;
use crate::world::material::Kind;
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use std::f64::consts::PI;

/// Something small.
#[derive(Clone, Copy)]
pub(super) enum SmallObject {
    Plate { radius: f64 },
    Cup { radius: f64 },
    Bowl { radius: f64 },
    Bottle { radius: f64 },
    Pot { radius: f64 },
    Fruit { radius: f64 },
    Carton { width: f64, depth: f64, tall: f64 },
    Pile { width: f64 },
    Appliance { width: f64, depth: f64 },
    Picture { width: f64 },
}

impl SmallObject {
    pub(super) fn random(rng: &mut ChaCha8Rng) -> Self {
        match rng.random_range(0..12) {
            0 => Self::Plate { radius: between(rng, 0.08, 0.15) },
            1 | 2 => Self::Cup { radius: between(rng, 0.03, 0.05) },
            3 => Self::Bowl { radius: between(rng, 0.06, 0.13) },
            4 | 5 => Self::Bottle { radius: between(rng, 0.028, 0.05) },
            6 => Self::Pot { radius: between(rng, 0.08, 0.15) },
            7 => Self::Fruit { radius: between(rng, 0.03, 0.07) },
            8 => Self::Carton {
                width: between(rng, 0.06, 0.25),
                depth: between(rng, 0.04, 0.18),
                tall: between(rng, 0.04, 0.32),
            },
            9 => Self::Pile { width: between(rng, 0.15, 0.3) },
            10 => Self::Appliance { width: between(rng, 0.18, 0.48), depth: between(rng, 0.18, 0.34) },
            _ => Self::Picture { width: between(rng, 0.12, 0.4) },
        }
    }

    /// Radius of the circle that it needs.
    pub(super) fn reach(self) -> f64 {
        match self {
            Self::Plate { radius }
            | Self::Cup { radius }
            | Self::Bowl { radius }
            | Self::Bottle { radius }
            | Self::Pot { radius }
            | Self::Fruit { radius } => radius + 0.005,
            Self::Carton { width, depth, .. } | Self::Appliance { width, depth } => 0.52 * width.hypot(depth),
            Self::Pile { width } => 0.65 * width,
            Self::Picture { width } => 0.55 * width,
        }
    }

    /// Puts it at `place`.
    pub(super) fn stand(self, build: &mut Build, place: [f64; 3], rng: &mut ChaCha8Rng) {
        let [x, y, z] = place;
        let turn = if rng.random::<bool>() { between(rng, -0.2, 0.2) } else { between(rng, -PI, PI) };
        match self {
            Self::Plate { radius } => {
                let china = any(&[Kind::Plain, Kind::Plain, Kind::Poster], rng);
                build.round(place, radius, between(rng, 0.012, 0.03), china);
            }
            Self::Cup { radius } => {
                let china = any(&[Kind::Plain, Kind::Poster, Kind::Metal], rng);
                build.round(place, radius, between(rng, 0.07, 0.14), china);
            }
            Self::Bowl { radius } => {
                let china = any(&[Kind::Plain, Kind::Fabric, Kind::Metal], rng);
                build.round(place, 0.6 * radius, 0.02, china);
                build.round([x, y, z + 0.02], radius, between(rng, 0.04, 0.09), china);
            }
            Self::Bottle { radius } => {
                let glass = any(&[Kind::Plain, Kind::Poster], rng);
                let tall = between(rng, 0.12, 0.24);
                build.round(place, radius, tall, glass);
                build.round(
                    [x, y, z + tall],
                    0.4 * radius,
                    between(rng, 0.02, 0.1),
                    any(&[Kind::Plain], rng),
                );
            }
            Self::Pot { radius } => {
                let iron = any(&[Kind::Metal, Kind::Plain], rng);
                let tall = between(rng, 0.08, 0.2);
                build.round(place, radius, tall, iron);
                build.round([x, y, z + tall], 0.2 * radius, 0.03, iron);
            }
            Self::Fruit { radius } => build.ball(place, radius, any(&[Kind::Plain, Kind::Concrete], rng)),
            Self::Carton { width, depth, tall } => {
                let card = any(&[Kind::Cardboard, Kind::Poster, Kind::Poster, Kind::Plain], rng);
                build.block(place, [width, depth, tall], turn, card);
            }
            Self::Pile { width } => {
                let mut top = z;
                for _ in 0..rng.random_range(1..=5) {
                    let (tall, lean) = (between(rng, 0.008, 0.045), between(rng, -0.25, 0.25));
                    let size = [width * between(rng, 0.8, 1.0), 0.7 * width, tall];
                    let paper = any(&[Kind::Poster, Kind::Plain, Kind::Board], rng);
                    build.block([x, y, top], size, turn + lean, paper);
                    top += tall;
                }
            }
            Self::Appliance { width, depth } => {
                let tall = between(rng, 0.12, 0.42);
                let body = any(&[Kind::Plain, Kind::Metal, Kind::Plain], rng);
                build.block(place, [width, depth, tall], 0.1 * turn, body);
                if rng.random::<bool>() {
                    let lid = any(&[Kind::Plain, Kind::Metal], rng);
                    build.round([x, y, z + tall], 0.3 * depth, between(rng, 0.02, 0.12), lid);
                }
            }
            Self::Picture { width } => {
                let sheet = any(&[Kind::Poster, Kind::Board], rng);
                build.block(place, [width, 0.02, between(rng, 0.12, 0.35)], turn, sheet);
            }
        }
    }
}
