//! The world: a furnished room as analytic shapes with baked, band-limited textures.

mod bare;
mod bvh;
mod furniture;
mod home;
mod light;
mod material;
mod noise;
mod piece;
mod randomized;
mod shape;
mod texture;
mod tile;

pub(crate) use shape::Shape;
pub(crate) use tile::{TileBounds, TileHits};

use crate::config::{SceneKind, SynthConfig};
use crate::error::SynthError;
use crate::extent::{Extent, room_size};
use crate::flight::FlightPath;
use bvh::Bvh;
use light::{LightMap, Lighting};
use material::Surface;
use nalgebra::Vector3;
use rayon::prelude::*;
use texture::Texture;

/// Where a ray meets the world.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Multiples of the ray's direction from its origin; metres for a unit direction, z-depth for one of unit z.
    pub t: f64,
    /// The point, in the world.
    pub point: Vector3<f64>,
    /// Unit normal of the surface, toward the ray's origin.
    pub normal: Vector3<f64>,
    /// Which face of the world, for reading its texture.
    face: u32,
    uv: [f64; 2],
}

impl Hit {
    /// Which of the world's faces was met.
    pub(crate) fn face_number(&self) -> u32 {
        self.face
    }
}

/// A furnished place through which a flight passes freely.
pub struct World {
    /// Shape 0 is the room's shell, seen from inside.
    shapes: Vec<Shape>,
    bvh: Bvh,
    /// Boxes around the shapes after the shell.
    extents: Vec<Extent>,
    /// Index of each shape's first face.
    first_face: Vec<u32>,
    textures: Vec<Texture>,
    /// Of each face, a number that faces of one material share.
    materials: Vec<u32>,
}

/// Texels of all faces together at most: bounds memory (about 3 bytes each) and the time to bake.
const TEXEL_BUDGET: f64 = 18e6;

/// Albedo 0.5 under the mean light on the room's faces gives a radiance of 1 − exp(−0.5 · 1.4) = 0.50.
const EXPOSURE: f32 = 1.4;

/// Distance at which a texel is about as wide as a pixel, m.
const SHARP_DISTANCE_M: f64 = 1.3;

impl World {
    /// Builds `config.scene` around `flight`, with furniture that stays at least 0.4 m away from it.
    ///
    /// # Errors
    /// A key outside its domain; a flight wider than 500 m, for which no room is built.
    pub fn build(config: &SynthConfig, flight: &FlightPath) -> Result<Self, SynthError> {
        config.validate()?;
        let room = room_around(config, &flight.extent())?;
        let mut furnished = furniture::furnish(config, &room, &flight.positions(0.02));
        bare::strip_textures(&mut furnished, &room, config);
        let mut shapes = vec![Shape::Shell { min: room.min, max: room.max }];
        let mut surfaces = furnished.shell;
        for piece in furnished.pieces {
            surfaces.extend(std::iter::repeat_n(piece.surface, piece.shape.face_count()));
            shapes.push(piece.shape);
        }
        let focal = config.camera()?.intrinsics().fx;
        let lighting = randomized::lighting(config);
        Ok(Self::bake(shapes, &surfaces, SHARP_DISTANCE_M / focal, &lighting, config.seed as u32))
    }

    fn bake(
        shapes: Vec<Shape>,
        surfaces: &[Surface],
        wanted_texel_m: f64,
        lighting: &Lighting,
        seed: u32,
    ) -> Self {
        let bvh = Bvh::new(&shapes[1..]);
        let mut first_face = Vec::with_capacity(shapes.len());
        let mut faces = Vec::new();
        for (i, shape) in shapes.iter().enumerate() {
            first_face.push(faces.len() as u32);
            faces.extend((0..shape.face_count()).map(|f| (i, f)));
        }
        let area: f64 = faces.iter().map(|&(i, f)| shapes[i].face_size(f)).map(|[u, v]| u * v).sum();
        let texel_m = wanted_texel_m.max((area / TEXEL_BUDGET).sqrt());
        let lamps = light::lamps(&room_of(&shapes), lighting, seed);
        let scene = light::Scene { shapes: &shapes, bvh: &bvh, lamps: &lamps, ambient: lighting.ambient };
        let light: Vec<LightMap> =
            faces.par_iter().map(|&(i, f)| LightMap::new(&scene, i, f, texel_m)).collect();
        let exposure = lighting.gain * EXPOSURE / light::mean(&light[..shapes[0].face_count()]);
        let textures = faces
            .par_iter()
            .zip(&light)
            .zip(surfaces)
            .map(|((&(i, f), light), surface)| {
                paint(surface, light, exposure, shapes[i].face_size(f), texel_m)
            })
            .collect();
        let extents = shapes[1..].iter().map(Shape::extent).collect();
        let materials = surfaces.iter().map(|s| s.base.number()).collect();
        Self { shapes, bvh, extents, first_face, textures, materials }
    }

    /// The room's own box.
    pub fn extent(&self) -> Extent {
        room_of(&self.shapes)
    }

    /// Number of shapes, the room's shell included.
    pub fn shape_count(&self) -> usize {
        self.shapes.len()
    }

    /// The nearest surface along a ray (`direction` need not be of unit length); `None` from outside the room.
    pub fn cast(&self, origin: &Vector3<f64>, direction: &Vector3<f64>) -> Option<Hit> {
        let (shape, t) = nearest_hit(&self.shapes, &self.bvh, origin, direction)?;
        Some(self.hit(shape, t, origin, direction))
    }

    /// The place at `t` on a ray that meets `shape` there.
    fn hit(&self, shape: usize, t: f64, origin: &Vector3<f64>, direction: &Vector3<f64>) -> Hit {
        let point = origin + direction * t;
        let place = self.shapes[shape].resolve(&point, direction);
        let face = self.first_face[shape] + place.face as u32;
        Hit { t, point, normal: place.normal, face, uv: place.uv }
    }

    /// A number that faces of one kind and brightness of material share.
    pub(crate) fn material_number(&self, hit: &Hit) -> u32 {
        self.materials[hit.face as usize]
    }

    /// Radiance (0…1, exposure 1) of a hit, averaged over about `footprint_m` of surface.
    pub fn radiance(&self, hit: &Hit, footprint_m: f64) -> f32 {
        self.textures[hit.face as usize].read(hit.uv, footprint_m as f32)
    }

    /// Distance from `point` to the nearest surface, m.
    pub fn clearance_m(&self, point: &Vector3<f64>) -> f64 {
        self.shapes.iter().map(|s| s.distance(point)).fold(f64::INFINITY, f64::min)
    }

    /// All shapes.
    pub(crate) fn shapes(&self) -> &[Shape] {
        &self.shapes
    }

    /// Number of a shape's face among all faces.
    pub(crate) fn face_number(&self, shape: usize, face: usize) -> usize {
        self.first_face[shape] as usize + face
    }

    /// Radiance of a face at `uv`.
    pub(crate) fn face_radiance(&self, face_number: usize, uv: [f64; 2], footprint_m: f64) -> f32 {
        self.textures[face_number].read(uv, footprint_m as f32)
    }
}

fn room_of(shapes: &[Shape]) -> Extent {
    shapes[0].extent()
}

/// The nearest shape on a ray and `t`; the shell, which nearly every ray would meet last, bounds the search.
fn nearest_hit(
    shapes: &[Shape],
    bvh: &Bvh,
    origin: &Vector3<f64>,
    direction: &Vector3<f64>,
) -> Option<(usize, f64)> {
    let wall = shapes[0].intersect(origin, direction, f64::INFINITY);
    let piece = bvh.nearest(&shapes[1..], origin, direction, wall.unwrap_or(f64::INFINITY));
    piece.map(|(i, t)| (i + 1, t)).or(wall.map(|t| (0, t)))
}

/// Bakes albedo and light of one face into a texture, through a soft shoulder so that highlights keep their structure.
fn paint(surface: &Surface, light: &LightMap, exposure: f32, size: [f64; 2], texel_m: f64) -> Texture {
    let size32 = size.map(|s| s as f32);
    Texture::bake(size, texel_m, |v, us, out| {
        for (&u, texel) in us.iter().zip(out) {
            let albedo = surface.albedo(u as f32, v as f32, size32, texel_m as f32);
            let own = surface.glow(u as f32, v as f32);
            let radiance = 1.0 - (-exposure * albedo * light.at(u, v) - albedo * own).exp();
            *texel = (radiance.clamp(0.0, 1.0) * 65_535.0) as u16;
        }
    })
}

/// The room of its usual size, grown where the flight needs it.
fn room_around(config: &SynthConfig, flight: &Extent) -> Result<Extent, SynthError> {
    let span = flight.max - flight.min;
    if !(span.max() <= 500.0) {
        let reason = format!("it spans {:.1} m, rooms are built up to 500 m", span.max());
        return Err(SynthError::BadTrajectory { reason });
    }
    let (scene, usual) = (config.scene, room_size(config));
    // A corridor runs along the longer side of the flight.
    let along_y = scene == SceneKind::Corridor && span.y > span.x;
    let usual = if along_y { Vector3::new(usual.y, usual.x, usual.z) } else { usual };
    // A flight that fits the usual room about the origin is a built-in one and keeps it there.
    let centred = Extent {
        min: Vector3::new(-0.5 * usual.x, -0.5 * usual.y, 0.0),
        max: Vector3::new(0.5 * usual.x, 0.5 * usual.y, usual.z),
    };
    let free = Vector3::new(0.6, 0.6, 0.4);
    if centred.holds(&Extent { min: flight.min - free, max: flight.max + free }) {
        return Ok(centred);
    }
    let middle = flight.center();
    let room = Vector3::new(1.4, if scene == SceneKind::Corridor { 1.0 } else { 1.4 }, 0.0);
    let half = (usual * 0.5).sup(&(span * 0.5 + room));
    let floor = flight.min.z - 0.6;
    Ok(Extent {
        min: Vector3::new(middle.x - half.x, middle.y - half.y, floor),
        max: Vector3::new(middle.x + half.x, middle.y + half.y, (floor + usual.z).max(flight.max.z + 1.0)),
    })
}

#[cfg(test)]
mod tests;
