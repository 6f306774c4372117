//! Short groups of overlapping colour views of one place, with exact depth and poses: what networks are trained on.
//!
//! A [`ClipRoom`] is a place drawn from a split (training, validation or test rooms never share a seed); its clips are
//! numbered, and every clip follows from the room's seed and its number alone. The views lie along a built-in flight or
//! along a hand-held path ([`paths`]); a camera of random focal length, exposure, contrast, colour, motion blur and
//! noise looks through an undistorted pinhole.

mod colour;
mod paths;

pub use colour::Palette;

use crate::config::{FlightKind, SceneKind, Start, SynthConfig, Variety};
use crate::error::SynthError;
use crate::random::{Gaussian, Purpose, stream};
use crate::render::{ExposedChannels, RayTable, expose_hits};
use crate::simulation::Simulation;
use crate::world::{Hit, World};
use nalgebra::Vector3;
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use vidar_core::{CameraModel, Image, LieGroup, Pinhole, Se3};

/// Which rooms: the three share none, nor any with the seeds (below a million) that examples and tests use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Split {
    /// Rooms to learn from.
    Train,
    /// Rooms to watch the learning with.
    Validation,
    /// Rooms to report on.
    Test,
}

impl Split {
    /// Seed of the split's room `index`.
    pub fn seed(self, index: u32) -> u64 {
        let first = match self {
            Self::Train => 1 << 40,
            Self::Validation => 2 << 40,
            Self::Test => 3 << 40,
        };
        first + u64::from(index)
    }
}

/// What the clips of a room are like.
#[derive(Clone, Debug, PartialEq)]
pub struct ClipSettings {
    /// Views per clip, 1…256.
    pub views: usize,
    /// Columns of a view, 16…8192.
    pub width: usize,
    /// Rows of a view, 16…8192.
    pub height: usize,
    /// Rays per pixel, 1…64.
    pub samples: usize,
}

/// One view of a clip.
#[derive(Clone, Debug)]
pub struct ClipView {
    /// What the camera recorded, sRGB-like.
    pub image: Image<[u8; 3]>,
    /// Exact z-depth at the pixel centres, m; NaN where a pixel sees nothing.
    pub depth: Image<f32>,
    /// Exact pose of the camera (x right, y down, z forward) at the middle of the exposure.
    pub world_from_camera: Se3,
}

/// Views of one place that overlap, taken by one camera.
#[derive(Clone, Debug)]
pub struct Clip {
    /// The camera; its principal point is the image's centre.
    pub camera: Pinhole,
    /// The views, in the order in which they were taken.
    pub views: Vec<ClipView>,
}

/// A place of which clips are taken.
pub struct ClipRoom {
    seed: u64,
    simulation: Simulation,
    /// Whether the room is a home: seen at close range, in richer colours.
    is_home: bool,
}

/// Paths that are tried before a clip is taken as it comes.
const TRIES: u32 = 12;

impl ClipRoom {
    /// Builds room `index` of `split`; textures are made for views `width` pixels wide.
    ///
    /// # Errors
    /// A width that no camera has.
    pub fn new(split: Split, index: u32, width: usize) -> Result<Self, SynthError> {
        Self::with_homes(split, index, width, 0.0)
    }

    /// As [`ClipRoom::new`], but `share` (0…1) of the rooms are [`Variety::Home`], of which clips are taken as by
    /// a person who inspects objects: at close range, often from above. The other rooms are the same as without them.
    ///
    /// # Errors
    /// A width that no camera has, a share outside 0…1.
    pub fn with_homes(split: Split, index: u32, width: usize, share: f64) -> Result<Self, SynthError> {
        crate::bounds::ensure((0.0..=1.0).contains(&share), "share", "0 to 1", share)?;
        let seed = split.seed(index);
        let mut rng = stream(seed, Purpose::ClipRoom);
        let mut config = SynthConfig {
            seed,
            scene: match rng.random_range(0..10) {
                0..6 => SceneKind::Room,
                6..8 => SceneKind::Hall,
                _ => SceneKind::Corridor,
            },
            variety: if rng.random::<f64>() < 0.8 { Variety::Randomized } else { Variety::Standard },
            flight: match rng.random_range(0..3) {
                0 => FlightKind::Sweep,
                1 => FlightKind::Orbit,
                _ => FlightKind::Aggressive,
            },
            start: Start::InFlight,
            duration_secs: 12.0,
            clutter: rng.random_range(12..70),
            width,
            height: (width * 5 / 8).max(16),
            ..SynthConfig::default()
        };
        let is_home = rng.random::<f64>() < share;
        if is_home {
            // No flight leads through a home: what it has may stand anywhere.
            config =
                SynthConfig { variety: Variety::Home, scene: SceneKind::Room, duration_secs: 0.1, ..config };
        }
        Ok(Self { seed, simulation: Simulation::new(&config, None)?, is_home })
    }

    /// Seed of the room.
    pub fn seed(&self) -> u64 {
        self.seed
    }

    /// Clip `number` of the room.
    ///
    /// # Errors
    /// Settings outside their domain.
    pub fn clip(&self, number: u32, settings: &ClipSettings) -> Result<Clip, SynthError> {
        use crate::bounds::ensure;
        let ClipSettings { views, width, height, samples } = *settings;
        ensure((1..=256).contains(&views), "views", "1 to 256", views)?;
        ensure((1..=64).contains(&samples), "samples", "1 to 64", samples)?;
        ensure((16..=8192).contains(&width), "width", "16 to 8192 pixels", width)?;
        ensure((16..=8192).contains(&height), "height", "16 to 8192 pixels", height)?;
        let mut rng = stream(self.seed, Purpose::Clip(number));
        let camera = camera(width, height, &mut rng)?;
        let world = self.simulation.world();
        let path = if self.is_home { paths::home_path } else { paths::path };
        let nearest = if self.is_home { [0.15, 0.45] } else { [0.25, 0.7] };
        let mut poses = path(&self.simulation, views, &mut rng);
        for _ in 0..TRIES {
            if poses.iter().all(|pose| is_worth_a_look(world, &camera, pose, nearest)) {
                break;
            }
            poses = path(&self.simulation, views, &mut rng);
        }
        let sensor = Sensor::new(&mut rng);
        let colours = if self.is_home { Palette::of_a_home } else { Palette::new };
        let palette = colours(self.seed, &mut rng);
        let table = RayTable::new(&CameraModel::Pinhole(camera), samples);
        let mut noise = Gaussian::new(stream(self.seed, Purpose::ClipNoise(number)));
        let tint = |hit: &Hit, radiance: f32| palette.tint(world, hit).map(|t| radiance * t);
        let exposed: Vec<ExposedChannels<3>> = (0..poses.len())
            .map(|k| {
                let shutter = sensor.shutter(&poses, k, samples);
                expose_hits(world, &table, |sample, _| shutter[sample], tint)
            })
            .collect();
        let gain = sensor.metered(&exposed);
        let views = exposed
            .into_iter()
            .zip(&poses)
            .map(|(exposed, pose)| ClipView {
                image: sensor.develop(&exposed, [width, height], gain, palette.is_grey(), &mut noise),
                depth: Image::from_fn(width, height, |x, y| exposed.depth[y * width + x]),
                world_from_camera: *pose,
            })
            .collect();
        Ok(Clip { camera, views })
    }
}

/// A pinhole of 48° to 95° across the longer side.
fn camera(width: usize, height: usize, rng: &mut ChaCha8Rng) -> Result<Pinhole, SynthError> {
    let angle = (48.0 + 47.0 * rng.random::<f64>()).to_radians();
    let focal = 0.5 * width.max(height) as f64 / (0.5 * angle).tan();
    let squeeze = 1.0 + 0.03 * (rng.random::<f64>() - 0.5);
    let [cx, cy] = [width, height].map(|s| 0.5 * (s as f64 - 1.0));
    Pinhole::new(focal, focal * squeeze, cx, cy, width, height).map_err(|e| SynthError::BadConfig {
        key: "width",
        expected: "a size that a camera can have",
        found: e.to_string(),
    })
}

/// Whether a view is neither inside nor right in front of something: hardly anything is nearer than the first of
/// `nearest` and half of it is beyond the second, m.
fn is_worth_a_look(world: &World, camera: &Pinhole, world_from_camera: &Se3, nearest: [f64; 2]) -> bool {
    let origin = world_from_camera.translation;
    let (columns, rows) = (7, 5);
    let mut depths = Vec::with_capacity(columns * rows);
    for y in 0..rows {
        for x in 0..columns {
            let u = (x as f64 + 0.5) / columns as f64 * camera.width as f64 - 0.5;
            let v = (y as f64 + 0.5) / rows as f64 * camera.height as f64 - 0.5;
            let ray = Vector3::new((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0);
            let Some(hit) = world.cast(&origin, &(world_from_camera.rotation * ray)) else { return false };
            depths.push(hit.t);
        }
    }
    depths.sort_by(f64::total_cmp);
    depths[1] > nearest[0] && depths[depths.len() / 2] > nearest[1]
}

/// The camera's electronics during one clip.
struct Sensor {
    gain: f32,
    gamma: f32,
    noise: f32,
    vignetting: f32,
    flicker: f64,
    /// Share of the time between views during which the shutter is open.
    exposure: f64,
}

impl Sensor {
    fn new(rng: &mut ChaCha8Rng) -> Self {
        let mut uniform = |low: f64, high: f64| low + (high - low) * rng.random::<f64>();
        Self {
            gain: uniform(-0.35, 0.35).exp() as f32,
            gamma: uniform(-0.35, 0.25).exp() as f32,
            noise: uniform(0.0, 1.0).powi(2) as f32 * 5.0,
            vignetting: uniform(0.0, 0.3) as f32,
            flicker: uniform(0.0, 0.12),
            exposure: uniform(0.0, 1.0).powi(3) * 0.12,
        }
    }

    /// Poses of the rays of view `k` while the shutter is open; the middle one is the view's own.
    fn shutter(&self, poses: &[Se3], k: usize, samples: usize) -> Vec<Se3> {
        let neighbour = if k + 1 < poses.len() { k + 1 } else { k.saturating_sub(1) };
        let step = (poses[k].inverse() * poses[neighbour]).log() * (self.exposure / samples as f64);
        let at = |s: usize| poses[k] * Se3::exp(&(step * (s as f64 - (samples / 2) as f64)));
        (0..samples).map(at).collect()
    }

    /// The gain that an automatic exposure chooses for a clip.
    fn metered(&self, views: &[ExposedChannels<3>]) -> f32 {
        let sum: f32 = views.iter().flat_map(|v| v.radiance.as_flattened()).sum();
        let count = views.iter().map(|v| 3 * v.radiance.len()).sum::<usize>();
        let mean = sum / count.max(1) as f32;
        self.gain * (0.4 / mean.max(1e-3)).clamp(0.7, 8.0)
    }

    fn develop(
        &self,
        exposed: &ExposedChannels<3>,
        [width, height]: [usize; 2],
        gain: f32,
        is_grey: bool,
        noise: &mut Gaussian<ChaCha8Rng>,
    ) -> Image<[u8; 3]> {
        let gain = gain * (self.flicker * noise.next()).exp() as f32;
        let (cx, cy) = (0.5 * (width as f32 - 1.0), 0.5 * (height as f32 - 1.0));
        Image::from_fn(width, height, |x, y| {
            let off = ((x as f32 - cx).powi(2) + (y as f32 - cy).powi(2)) / (cx * cx + cy * cy);
            let shade = gain * (1.0 - self.vignetting * off);
            let radiance = exposed.radiance[y * width + x];
            let level = |r: f32, n: f32| {
                let level = 255.0 * (r * shade).max(0.0).powf(self.gamma);
                (level + self.noise * n).round().clamp(0.0, 255.0) as u8
            };
            if is_grey {
                [level(radiance[0], noise.next() as f32); 3]
            } else {
                radiance.map(|r| level(r, noise.next() as f32))
            }
        })
    }
}

#[cfg(test)]
mod tests;
