//! Light that does not depend on the viewer: Lambert's law under ceiling lamps with shadows, and occluded ambient.
//!
//! It is computed once on a coarse grid of every face and baked into the textures, so that all views agree.

use super::Bvh;
use super::noise::cell;
use super::shape::Shape;
use crate::extent::Extent;
use nalgebra::Vector3;

/// Spacing of the grid on which light is computed, m; coarser where textures are coarse.
const GRID_M: f64 = 0.15;

/// Texels between points of the grid at least.
const TEXELS_PER_POINT: f64 = 6.0;

/// Rays per grid point that look for occluders of the ambient light.
const AMBIENT_RAYS: u32 = 10;

/// Occluders further away than this do not darken, m.
const AMBIENT_REACH_M: f64 = 1.2;

/// A lamp under the ceiling.
#[derive(Clone, Copy, Debug)]
pub(super) struct Lamp {
    pub position: Vector3<f64>,
    /// Radiant intensity, arbitrary unit · m².
    pub power: f64,
}

/// How a place is lit.
#[derive(Clone, Copy, Debug)]
pub(super) struct Lighting {
    /// Distance between lamps, m.
    pub spacing_m: f64,
    /// Power of the weakest lamp, and what the strongest one has more, per square metre of height.
    pub least_power: f64,
    pub power_range: f64,
    /// Lamps hang this far below the ceiling, m.
    pub drop_m: f64,
    /// Light from everywhere.
    pub ambient: f64,
    /// Factor on the exposure.
    pub gain: f32,
}

impl Lighting {
    pub const USUAL: Self =
        Self { spacing_m: 4.5, least_power: 0.12, power_range: 0.1, drop_m: 0.25, ambient: 0.22, gain: 1.0 };
}

/// A grid of lamps under the ceiling, of different power.
pub(super) fn lamps(room: &Extent, lighting: &Lighting, seed: u32) -> Vec<Lamp> {
    let size = room.max - room.min;
    let [nx, ny] = [size.x, size.y].map(|s| (s / lighting.spacing_m).round().clamp(1.0, 8.0) as i32);
    let mut lamps = Vec::new();
    for i in 0..nx {
        for j in 0..ny {
            let x = room.min.x + size.x * (f64::from(i) + 0.5) / f64::from(nx);
            let y = room.min.y + size.y * (f64::from(j) + 0.5) / f64::from(ny);
            let power =
                size.z * size.z * (lighting.least_power + lighting.power_range * f64::from(cell(i, j, seed)));
            lamps.push(Lamp { position: Vector3::new(x, y, room.max.z - lighting.drop_m), power });
        }
    }
    lamps
}

/// Irradiance on a grid over one face.
pub(super) struct LightMap {
    columns: usize,
    rows: usize,
    size: [f64; 2],
    values: Vec<f32>,
}

impl LightMap {
    pub(super) fn new(scene: &Scene<'_>, shape: usize, face: usize, texel_m: f64) -> Self {
        let solid = &scene.shapes[shape];
        let size = solid.face_size(face);
        let spacing = GRID_M.max(TEXELS_PER_POINT * texel_m);
        let [columns, rows] = size.map(|s| (s / spacing).ceil().max(1.0) as usize + 1);
        let mut values = Vec::with_capacity(columns * rows);
        for y in 0..rows {
            for x in 0..columns {
                // Stay off the very edge, where neighbouring shapes touch.
                let at = |k: usize, n: usize, s: f64| {
                    let inset = (0.25 * s).min(0.02);
                    (s * k as f64 / (n - 1) as f64).clamp(inset, s - inset)
                };
                let uv = [at(x, columns, size[0]), at(y, rows, size[1])];
                let middle = [0.5 * size[0], 0.5 * size[1]];
                let place = solid.at(face, uv).or_else(|| solid.at(face, middle));
                let key = (shape * 8 + face) as u32;
                values.push(place.map_or(0.0, |(p, n)| {
                    let index = (y * columns + x) as u32;
                    let lit = scene.irradiance(&p, &n, key ^ index.wrapping_mul(0x9E37));
                    // A sheet is thin: both sides are lit alike, by the brighter.
                    let back = matches!(solid, Shape::Sheet { .. });
                    if back { lit.max(scene.irradiance(&p, &-n, key ^ index)) } else { lit }
                }));
            }
        }
        Self { columns, rows, size, values }
    }

    /// Irradiance at `(u, v)`, bilinear.
    #[inline]
    pub(super) fn at(&self, u: f64, v: f64) -> f32 {
        let x = (u / self.size[0]).clamp(0.0, 1.0) * (self.columns - 1) as f64;
        let y = (v / self.size[1]).clamp(0.0, 1.0) * (self.rows - 1) as f64;
        let (x0, y0) = ((x as usize).min(self.columns - 2), (y as usize).min(self.rows - 2));
        let (ax, ay) = ((x - x0 as f64) as f32, (y - y0 as f64) as f32);
        let row = |y: usize| {
            let at = y * self.columns + x0;
            self.values[at] + ax * (self.values[at + 1] - self.values[at])
        };
        let (top, bottom) = (row(y0), row(y0 + 1));
        top + ay * (bottom - top)
    }
}

/// Mean light over some faces, each weighed by its number of grid points.
pub(super) fn mean(maps: &[LightMap]) -> f32 {
    let sum: f32 = maps.iter().map(|m| m.values.iter().sum::<f32>()).sum();
    let count: usize = maps.iter().map(|m| m.values.len()).sum();
    (sum / count.max(1) as f32).max(1e-6)
}

/// What light meets.
pub(super) struct Scene<'a> {
    pub shapes: &'a [Shape],
    pub bvh: &'a Bvh,
    pub lamps: &'a [Lamp],
    /// Light from everywhere.
    pub ambient: f64,
}

impl Scene<'_> {
    fn irradiance(&self, point: &Vector3<f64>, normal: &Vector3<f64>, key: u32) -> f32 {
        let from = point + normal * 1e-4;
        let mut direct = 0.0;
        for (i, lamp) in self.lamps.iter().enumerate() {
            let random = |n: i32| f64::from(cell(i as i32, n, key)) - 0.5;
            // Two points of the lamp's area soften the shadow.
            for s in 0..2 {
                let offset = Vector3::new(random(2 * s) * 0.8, random(2 * s + 1) * 0.8, 0.0);
                let to = lamp.position + offset - from;
                let cosine = normal.dot(&to) / to.norm();
                if cosine > 0.0 && self.first_hit(&from, &to, 1.0).is_none() {
                    direct += 0.5 * lamp.power * cosine / (to.norm_squared() + 0.3);
                }
            }
        }
        let mut open = 0.0;
        for k in 0..AMBIENT_RAYS {
            let ray = cosine_direction(normal, k, key);
            let hit = self.first_hit(&from, &ray, AMBIENT_REACH_M);
            open += hit.map_or(1.0, |t| (t / AMBIENT_REACH_M).sqrt());
        }
        // Light from above is stronger than light that the floor throws back.
        let ambient = self.ambient * (1.0 + 0.25 * normal.z) * (0.25 + 0.75 * open / f64::from(AMBIENT_RAYS));
        (direct + ambient) as f32
    }

    /// The nearest surface before `limit`; nothing beyond it is looked for.
    fn first_hit(&self, from: &Vector3<f64>, direction: &Vector3<f64>, limit: f64) -> Option<f64> {
        let wall = self.shapes[0].intersect(from, direction, f64::INFINITY).filter(|&t| t < limit);
        let piece = self.bvh.nearest(&self.shapes[1..], from, direction, wall.unwrap_or(limit));
        piece.map(|(_, t)| t).or(wall).filter(|&t| t < limit)
    }
}

/// The `k`-th of a stratified set of directions with density proportional to the cosine to `normal`.
fn cosine_direction(normal: &Vector3<f64>, k: u32, key: u32) -> Vector3<f64> {
    let (a, b) = (cell(k as i32, 1, key ^ 0xA0), cell(k as i32, 2, key ^ 0xB0));
    let radius = ((f64::from(k) + f64::from(a)) / f64::from(AMBIENT_RAYS)).sqrt();
    let angle = 2.0 * std::f64::consts::PI * (f64::from(k) * 0.618_034 + 0.3 * f64::from(b));
    let helper = if normal.z.abs() < 0.9 { Vector3::z() } else { Vector3::x() };
    let e1 = normal.cross(&helper).normalize();
    let e2 = normal.cross(&e1);
    e1 * (radius * angle.cos())
        + e2 * (radius * angle.sin())
        + normal * (1.0 - radius * radius).max(0.0).sqrt()
}
