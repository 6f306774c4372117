//! Views of one chunk that correct each other's depth.
//!
//! A small network sees the same wall nearer in one view and farther in the next. Landmarks hold each view where they are;
//! between them the other views say more: a pixel's point, carried into a neighbour, must lie on the neighbour's surface.
//! Each view in turn is fitted to its landmarks and to what its neighbours say of its pixels, a few times round. Errors of
//! one network in neighbouring views are alike, so that all pixels of a neighbour count as a few observations only; with
//! more weight they drown the landmarks.

use crate::depth_field::{DepthField, Evidence, field_from};
use crate::landmark_scale::smooth_depth;
use nalgebra::Vector3;
use vidar_core::{LieGroup, ViewGeometry};

/// A view with what is known of its correction.
pub(super) struct Refined<'a> {
    pub view: &'a ViewGeometry,
    /// ln of what brings its depth into the unit of its pose.
    pub shift: f64,
    /// What landmarks ask for beyond that.
    pub landmarks: Vec<Evidence>,
    /// The correction so far.
    pub field: Option<DepthField>,
}

impl Refined<'_> {
    /// ln of the correction at a pixel, beyond the unit.
    fn log_factor(&self, x: f64, y: f64) -> f64 {
        let depth = self.view.depth.image();
        self.field.as_ref().map_or(0.0, |f| f.log_factor(x, y, depth.width(), depth.height()))
    }
}

/// Which neighbours a view is compared with, in places of the chunk's order.
const NEIGHBOURS: [isize; 6] = [-4, -2, -1, 1, 2, 4];
/// Every so many pixels along rows and columns are compared.
const STRIDE: usize = 6;
/// Error of a neighbour's depth, ln.
const NEIGHBOUR_STD: f64 = 0.1;
/// A neighbour's pixels together count as this many observations.
const OBSERVATIONS: f64 = 16.0;
/// Beyond this (ln) the neighbour sees something else.
const OCCLUDED: f64 = 0.4;
const SWEEPS: usize = 8;

/// Changes the fields of a chunk's views so that they agree.
pub(super) fn agree(views: &mut [Refined<'_>], prior_scale: f64) {
    for _ in 0..SWEEPS {
        for i in 0..views.len() {
            let mut evidence = views[i].landmarks.clone();
            for step in NEIGHBOURS {
                let Some(j) = i.checked_add_signed(step).filter(|j| *j < views.len()) else { continue };
                let said = by_neighbour(&views[i], &views[j]);
                let share = OBSERVATIONS / said.len().max(100) as f64;
                evidence.extend(said.into_iter().map(|e| Evidence { share, ..e }));
            }
            let size = (views[i].view.intrinsics.width, views[i].view.intrinsics.height);
            views[i].field = Some(field_from(&evidence, prior_scale, size));
        }
    }
}

/// What one view's surface asks of another's pixels.
fn by_neighbour(of: &Refined<'_>, by: &Refined<'_>) -> Vec<Evidence> {
    let by_from_of = by.view.chunk_from_camera.inverse() * of.view.chunk_from_camera;
    let depth = of.view.depth.image();
    let (w, h) = (depth.width(), depth.height());
    let mut said = Vec::new();
    for y in (STRIDE / 2..h).step_by(STRIDE) {
        for x in (STRIDE / 2..w).step_by(STRIDE) {
            let pixel = [x as f64, y as f64];
            let now = of.log_factor(pixel[0], pixel[1]);
            let z = f64::from(depth[(x, y)]) * (of.shift + now).exp();
            if !(z.is_finite() && z > 0.0) {
                continue;
            }
            let k = &of.view.intrinsics;
            let point = Vector3::new((pixel[0] - k.cx) / k.fx * z, (pixel[1] - k.cy) / k.fy * z, z);
            let there = by_from_of.act(&point);
            let Some(seen) = surface(by, &there) else { continue };
            let apart = (seen / there.z).ln();
            if apart.is_finite() && apart.abs() < OCCLUDED {
                said.push(Evidence { pixel, log_factor: now + apart, std: NEIGHBOUR_STD, share: 1.0 });
            }
        }
    }
    said
}

/// The corrected depth of a view where a point falls into it, unless an edge runs there.
fn surface(view: &Refined<'_>, point: &Vector3<f64>) -> Option<f64> {
    let k = &view.view.intrinsics;
    if point.z <= 0.0 {
        return None;
    }
    let (x, y) = (k.fx * point.x / point.z + k.cx, k.fy * point.y / point.z + k.cy);
    let z = smooth_depth(view.view.depth.image(), x, y)?;
    Some(f64::from(z) * (view.shift + view.log_factor(x, y)).exp())
}
