//! Multi-view consistency: the views of one chunk correct each other's depth.
//!
//! A small network predicts the same wall nearer in one view and farther in the next. Landmarks hold each view at a few pixels;
//! between them a pixel's point, projected into another view, must lie on that view's surface. Each view in turn is fitted to
//! its landmarks and to the surfaces of its neighbours, for several sweeps. Errors of one network in neighbouring views are
//! correlated, so all pixels of a neighbour together count as a few observations; with more weight they outweigh the landmarks.

use crate::depth_field::{DepthField, FieldConstraint, field_from};
use crate::landmark_scale::smooth_depth;
use nalgebra::Vector3;
use vidar_core::{LieGroup, ViewGeometry};

/// A view and its correction.
pub(super) struct ViewCorrection<'a> {
    pub view: &'a ViewGeometry,
    /// ln of what brings its depth into the unit of its pose.
    pub shift: f64,
    /// Corrections at landmarks beyond that.
    pub landmarks: Vec<FieldConstraint>,
    /// The correction so far.
    pub field: Option<DepthField>,
}

impl ViewCorrection<'_> {
    /// ln of the correction at a pixel, beyond the unit.
    fn log_factor(&self, x: f64, y: f64) -> f64 {
        let depth = self.view.depth.image();
        self.field.as_ref().map_or(0.0, |f| f.log_factor(x, y, depth.width(), depth.height()))
    }
}

/// Neighbours that a view is compared with, by their offset in the order of the chunk.
const NEIGHBOURS: [isize; 6] = [-4, -2, -1, 1, 2, 4];
/// Distance of the compared pixels along rows and columns.
const STRIDE: usize = 6;
/// σ of a neighbour's ln(depth).
const NEIGHBOUR_STD: f64 = 0.1;
/// A neighbour's pixels together count as this many observations.
const OBSERVATIONS: f64 = 16.0;
/// Beyond this difference of ln(depth) the neighbour shows another surface.
const OCCLUDED: f64 = 0.4;
const SWEEPS: usize = 8;

/// Changes the fields of a chunk's views so that their surfaces agree. `prior_scale` widens the prior of the fields.
pub(super) fn enforce_consistency(views: &mut [ViewCorrection<'_>], prior_scale: f64) {
    for _ in 0..SWEEPS {
        for i in 0..views.len() {
            let mut constraints = views[i].landmarks.clone();
            for step in NEIGHBOURS {
                let Some(j) = i.checked_add_signed(step).filter(|j| *j < views.len()) else { continue };
                let by_neighbour = constraints_by(&views[i], &views[j]);
                let share = OBSERVATIONS / by_neighbour.len().max(100) as f64;
                constraints.extend(by_neighbour.into_iter().map(|e| FieldConstraint { share, ..e }));
            }
            let size = (views[i].view.intrinsics.width, views[i].view.intrinsics.height);
            views[i].field = Some(field_from(&constraints, prior_scale, size));
        }
    }
}

/// Corrections of one view's pixels by another view's surface.
fn constraints_by(of: &ViewCorrection<'_>, by: &ViewCorrection<'_>) -> Vec<FieldConstraint> {
    let by_from_of = by.view.chunk_from_camera.inverse() * of.view.chunk_from_camera;
    let depth = of.view.depth.image();
    let (w, h) = (depth.width(), depth.height());
    let mut constraints = Vec::new();
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
            let in_neighbour = by_from_of.act(&point);
            let Some(observed) = surface(by, &in_neighbour) else { continue };
            let apart = (observed / in_neighbour.z).ln();
            if apart.is_finite() && apart.abs() < OCCLUDED {
                constraints.push(FieldConstraint {
                    pixel,
                    log_factor: now + apart,
                    std: NEIGHBOUR_STD,
                    share: 1.0,
                });
            }
        }
    }
    constraints
}

/// The corrected depth of a view where a point projects into it, unless a depth edge is there.
fn surface(view: &ViewCorrection<'_>, point: &Vector3<f64>) -> Option<f64> {
    let k = &view.view.intrinsics;
    if point.z <= 0.0 {
        return None;
    }
    let (x, y) = (k.fx * point.x / point.z + k.cx, k.fy * point.y / point.z + k.cy);
    let z = smooth_depth(view.view.depth.image(), x, y)?;
    Some(f64::from(z) * (view.shift + view.log_factor(x, y)).exp())
}
