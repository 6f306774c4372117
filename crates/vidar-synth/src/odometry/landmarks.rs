//! Points that keyframes see again.

use super::OdometryErrors;
use crate::predict::TrueView;
use crate::random::{Gaussian, Purpose, stream};
use nalgebra::{Vector2, Vector3};
use rand_chacha::ChaCha8Rng;
use vidar_core::{LandmarkId, LieGroup, SparseLandmark};

/// A point is hidden where the surface is nearer or farther than it by this share.
const SAME_SURFACE: f64 = 0.02;

/// Points keep this far from the image's border, pixels.
const BORDER_PX: f64 = 3.0;

/// Depths of neighbouring pixels may differ by this share where a point is set: corners on edges are not tracked.
const SMOOTH: f32 = 0.05;

struct Point {
    id: LandmarkId,
    in_world: Vector3<f64>,
    /// ln(reported depth/true depth), the same in each keyframe.
    log_error: f64,
}

/// The points that are alive.
pub(super) struct Landmarks<'a> {
    errors: &'a OdometryErrors,
    random: Gaussian<ChaCha8Rng>,
    alive: Vec<Point>,
    next: u32,
}

impl<'a> Landmarks<'a> {
    pub(super) fn new(errors: &'a OdometryErrors, seed: u64) -> Self {
        Self { errors, random: Gaussian::new(stream(seed, Purpose::Landmarks)), alive: Vec::new(), next: 0 }
    }

    /// Landmarks that the keyframe `view` reports, on a track whose lengths are `scale` true ones.
    pub(super) fn seen(&mut self, view: &TrueView, scale: f64) -> Vec<SparseLandmark> {
        self.alive.retain(|p| project(view, &p.in_world).is_some());
        self.refill(view);
        let of_keyframe = self.errors.landmark_frame_sigma * self.random.next();
        let sigma = self.errors.landmark_sigma.hypot(self.errors.landmark_frame_sigma).max(1e-3);
        let observe = |point: &Point| {
            let (pixel, z) = project(view, &point.in_world)?;
            let inverse_depth = 1.0 / (z * scale * (point.log_error + of_keyframe).exp());
            let inverse_depth_std = sigma * inverse_depth;
            Some(SparseLandmark { id: point.id, pixel, inverse_depth, inverse_depth_std })
        };
        self.alive.iter().filter_map(observe).collect()
    }

    fn refill(&mut self, view: &TrueView) {
        let (width, height) = (view.intrinsics.width, view.intrinsics.height);
        // A view without depth takes no points, however often one tries.
        for _ in 0..20 * self.errors.landmarks {
            if self.alive.len() >= self.errors.landmarks {
                return;
            }
            let span = |size: usize| (size as f64 - 1.0 - 2.0 * BORDER_PX).max(0.0);
            let (x, y) = (self.random.uniform(), self.random.uniform());
            let pixel =
                Vector2::new(BORDER_PX + x * span(width), BORDER_PX + y * span(height)).map(f64::round);
            let Some(z) = smooth_depth(view, &pixel) else { continue };
            let in_world = view.world_from_camera.act(&(view.intrinsics.ray(pixel.x, pixel.y) * z));
            let outlier = self.random.uniform() < self.errors.landmark_outliers;
            // An outlier is anywhere between half and twice as far.
            let far_off = std::f64::consts::LN_2 * (2.0 * self.random.uniform() - 1.0);
            let usual = self.errors.landmark_sigma * self.random.next();
            let log_error = if outlier { far_off } else { usual };
            self.alive.push(Point { id: LandmarkId(self.next), in_world, log_error });
            self.next = self.next.wrapping_add(1);
        }
    }
}

/// z-depth at a whole pixel if its neighbours lie on the same surface.
fn smooth_depth(view: &TrueView, pixel: &Vector2<f64>) -> Option<f64> {
    let (x, y) = (pixel.x as usize, pixel.y as usize);
    let depth = view.depth.image();
    let z = *depth.get(x, y)?;
    let near = |x: usize, y: usize| depth.get(x, y).is_some_and(|n| (n / z - 1.0).abs() < SMOOTH);
    let smooth = near(x + 1, y) && near(x, y + 1) && near(x.wrapping_sub(1), y) && near(x, y.wrapping_sub(1));
    (z.is_finite() && smooth).then_some(f64::from(z))
}

/// Where a view sees a point, and its z-depth; `None` where it is outside or hidden.
fn project(view: &TrueView, in_world: &Vector3<f64>) -> Option<(Vector2<f64>, f64)> {
    let in_camera = view.world_from_camera.inverse().act(in_world);
    let pixel = view.intrinsics.project(&in_camera)?;
    let inside = |v: f64, size: usize| v >= BORDER_PX && v <= size as f64 - 1.0 - BORDER_PX;
    if !inside(pixel.x, view.intrinsics.width) || !inside(pixel.y, view.intrinsics.height) {
        return None;
    }
    let z = smooth_depth(view, &pixel.map(f64::round))?;
    // On a slanted surface the depth changes within the pixel.
    ((z / in_camera.z - 1.0).abs() < SAME_SURFACE).then_some((pixel, in_camera.z))
}
