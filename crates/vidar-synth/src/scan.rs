//! The reference cloud: points spread evenly over the surface that the camera saw, as a laser scanner would give.

use crate::error::SynthError;
use crate::random::{Gaussian, Purpose, stream};
use crate::world::World;
use nalgebra::Vector3;
use rayon::prelude::*;
use vidar_core::{CameraModel, LieGroup, Se3};

/// A point of the reference cloud.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct ScanPoint {
    /// In the world, m.
    pub position: Vector3<f64>,
    /// Grey level without noise, exposure 1.
    pub gray: u8,
}

/// Pixels per side of the blocks over which the farthest depth is kept.
const BLOCK: usize = 8;

/// Candidates at most: bounds memory and time.
const MAX_CANDIDATES: f64 = 60e6;

/// Rows of candidates that one task works through.
const BAND: usize = 32;

/// Points seen flatter than this (cosine to the normal) do not count as seen.
const MIN_COSINE: f64 = 0.03;

/// A frame with what decides whether it observed a point: its pose and coarse depth.
pub(crate) struct ObservingFrame {
    camera_from_world: Se3,
    position: Vector3<f64>,
    columns: usize,
    /// Farthest depth of each block of pixels; spares casting rays at what is certainly hidden.
    farthest: Vec<f32>,
}

impl ObservingFrame {
    pub(crate) fn new(world_from_camera: &Se3, depth: &[f32], width: usize) -> Self {
        let height = depth.len() / width.max(1);
        let (columns, rows) = (width.div_ceil(BLOCK), height.div_ceil(BLOCK));
        let mut farthest = vec![0.0_f32; columns * rows];
        for (i, &z) in depth.iter().enumerate() {
            let block = &mut farthest[(i / width / BLOCK) * columns + (i % width) / BLOCK];
            // NaN (no depth) leaves the maximum as it is.
            *block = block.max(z);
        }
        let position = world_from_camera.translation;
        Self { camera_from_world: world_from_camera.inverse(), position, columns, farthest }
    }

    fn sees(&self, world: &World, camera: &CameraModel, point: &Vector3<f64>, normal: &Vector3<f64>) -> bool {
        let to_point = point - self.position;
        if normal.dot(&to_point).abs() < MIN_COSINE * to_point.norm() {
            return false;
        }
        let in_camera = self.camera_from_world * *point;
        if in_camera.z < 0.05 {
            return false;
        }
        let Some(pixel) = camera.project(&in_camera).filter(|p| camera.contains(p, 0.5)) else {
            return false;
        };
        let block = (pixel.y.round() as usize / BLOCK) * self.columns + pixel.x.round() as usize / BLOCK;
        // Between pixel centres a surface may be somewhat farther than at them.
        if in_camera.z > f64::from(self.farthest[block]) * 1.05 + 0.02 {
            return false;
        }
        world.cast(&self.position, &to_point).is_some_and(|hit| hit.t > 1.0 - 1e-6)
    }
}

/// Points about `spacing_m` apart on every surface that any of the frames `observing` saw, `noise_m` off along the normal.
pub(crate) fn scan_observed_surface(
    world: &World,
    camera: &CameraModel,
    observing: &[ObservingFrame],
    scan: &Scan,
) -> Result<Vec<ScanPoint>, SynthError> {
    let mut bands = Vec::new();
    let mut candidates = 0.0;
    for (shape, solid) in world.shapes().iter().enumerate() {
        for face in 0..solid.face_count() {
            let [u, v] = solid.face_size(face);
            candidates += (u / scan.spacing_m) * (v / scan.spacing_m);
            let rows = (v / scan.spacing_m).ceil() as usize;
            bands.extend((0..rows).step_by(BAND).map(|row| (shape, face, row)));
        }
    }
    if candidates > MAX_CANDIDATES {
        return Err(SynthError::BadConfig {
            key: "scan_spacing_m",
            expected: "wide enough for at most 60 million points on all surfaces",
            found: format!("{} m, {candidates:.0} points", scan.spacing_m),
        });
    }
    let bands: Vec<Vec<ScanPoint>> = bands
        .into_par_iter()
        .enumerate()
        .map(|(index, band)| scan_band(world, camera, observing, scan, band, index))
        .collect();
    Ok(bands.concat())
}

/// How densely and how well to scan.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Scan {
    pub seed: u64,
    pub spacing_m: f64,
    pub noise_m: f64,
}

fn scan_band(
    world: &World,
    camera: &CameraModel,
    observing: &[ObservingFrame],
    scan: &Scan,
    (shape, face, first_row): (usize, usize, usize),
    index: usize,
) -> Vec<ScanPoint> {
    let mut rng = Gaussian::new(stream(scan.seed, Purpose::Scan(index)));
    let solid = &world.shapes()[shape];
    let [width, height] = solid.face_size(face);
    let number = world.face_number(shape, face);
    let columns = (width / scan.spacing_m).ceil() as usize;
    let mut points = Vec::new();
    // Neighbouring points are mostly seen by the same frame: try the frame of the last point first.
    let mut last = 0;
    for row in first_row..first_row + BAND {
        for column in 0..columns {
            let (du, dv) = (rng.uniform(), rng.uniform());
            let noise = rng.next() * scan.noise_m;
            // One point per cell of the grid; what falls off the face's end is dropped, so that the density is even.
            let uv = [(column as f64 + du) * scan.spacing_m, (row as f64 + dv) * scan.spacing_m];
            if uv[0] > width || uv[1] > height {
                continue;
            }
            let Some((position, normal)) = solid.at(face, uv) else {
                continue;
            };
            let n = observing.len();
            let frame_view = (0..n)
                .map(|k| (last + k) % n)
                .find(|&k| observing[k].sees(world, camera, &position, &normal));
            if let Some(k) = frame_view {
                last = k;
                let gray = (world.face_radiance(number, uv, scan.spacing_m) * 255.0).round() as u8;
                points.push(ScanPoint { position: position + normal * noise, gray });
            }
        }
    }
    points
}
