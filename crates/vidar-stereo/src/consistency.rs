//! Geometric consistency of the views' depths (Schönberger 2016, section 4.3).
//!
//! A pixel is projected into a neighbour with its depth, and the neighbour's depth there is projected back. The two agree
//! if this forward-backward reprojection error is small and the depths are similar. The inverse depths of agreeing
//! views are averaged, which reduces noise.

use crate::chunk::ViewDepth;
use crate::config::StereoConfig;
use crate::warp::{MIN_DEPTH_RATIO, Warp, neighbour_from_reference};
use rayon::prelude::*;

/// Largest forward-backward reprojection error, working pixels.
const REPROJECTION_LIMIT_PX: f32 = 1.5;
/// Rows of one task.
const ROWS: usize = 64;

/// Agreement of the views at every pixel.
pub(crate) struct Support {
    /// Inverse depth averaged over the views that agree, 1/m; NaN where the view itself has none.
    pub rho: Vec<f32>,
    /// Count of the views that agree.
    pub agreeing: Vec<f32>,
    /// Count of the views that have a depth at the point: agreeing, disagreeing, or occluded by a nearer surface.
    pub compared: Vec<f32>,
    /// Sum of the squared relative differences of those that agree.
    pub squares: Vec<f32>,
}

/// Another view's estimate, with the warps to it and back.
struct Other<'a> {
    rho: &'a [f32],
    width: usize,
    height: usize,
    forward: Warp,
    backward: Warp,
}

/// Compares a view's own depth with that of `others`.
pub(crate) fn support(own: &ViewDepth, others: &[&ViewDepth], config: &StereoConfig) -> Support {
    let others: Vec<Other<'_>> = others
        .iter()
        .map(|other| {
            let forward = neighbour_from_reference(&other.world_from_camera, &own.world_from_camera);
            let backward = neighbour_from_reference(&own.world_from_camera, &other.world_from_camera);
            Other {
                rho: &other.estimate.rho,
                width: other.intrinsics.width,
                height: other.intrinsics.height,
                forward: Warp::new(&own.intrinsics, &other.intrinsics, &forward),
                backward: Warp::new(&other.intrinsics, &own.intrinsics, &backward),
            }
        })
        .collect();
    let (width, rho) = (own.intrinsics.width, &own.estimate.rho);
    let blank = || vec![0.0f32; rho.len()];
    let mut support = Support { rho: rho.clone(), agreeing: blank(), compared: blank(), squares: blank() };
    let part = ROWS * width;
    let parts = (support.rho.par_chunks_mut(part).zip(support.agreeing.par_chunks_mut(part)))
        .zip(support.compared.par_chunks_mut(part).zip(support.squares.par_chunks_mut(part)));
    parts.enumerate().for_each(|(i, ((sum, agreeing), (compared, squares)))| {
        let mut row = Row::new(width);
        for y in 0..sum.len() / width {
            let (first, whole) = (y * width, (ROWS * i + y) * width);
            row.own.copy_from_slice(&rho[whole..][..width]);
            let mut totals = Totals {
                sum: &mut sum[first..][..width],
                agreeing: &mut agreeing[first..][..width],
                compared: &mut compared[first..][..width],
                squares: &mut squares[first..][..width],
            };
            let y = (ROWS * i + y) as f32;
            for other in &others {
                crate::simd::dispatch!(row.compare(other, y, config.agreement_ratio as f32, &mut totals));
            }
            totals.average();
        }
    });
    support
}

/// Sums over the views compared so far, of one row.
struct Totals<'a> {
    /// Sum of the inverse depths; in the end their mean.
    sum: &'a mut [f32],
    agreeing: &'a mut [f32],
    compared: &'a mut [f32],
    squares: &'a mut [f32],
}

impl Totals<'_> {
    fn average(&mut self) {
        for (sum, agreeing) in self.sum.iter_mut().zip(self.agreeing.iter()) {
            // NaN stays; what is behind the camera has no depth.
            *sum = if *sum > 0.0 { *sum / (agreeing + 1.0) } else { f32::NAN };
        }
    }
}

/// One row of pixels and where they lie in another view.
struct Row {
    own: Vec<f32>,
    /// Index of the nearest pixel, and its position; the projection differs from it by `offset`.
    index: Vec<u32>,
    position: [Vec<f32>; 2],
    offset: [Vec<f32>; 2],
    /// The inverse depth that the point would have there; NaN outside the view.
    expected: Vec<f32>,
    /// The inverse depth that the view has there.
    found: Vec<f32>,
}

impl Row {
    fn new(width: usize) -> Self {
        let blank = || vec![0.0; width];
        Self {
            own: blank(),
            index: vec![0; width],
            position: [blank(), blank()],
            offset: [blank(), blank()],
            expected: blank(),
            found: blank(),
        }
    }

    #[inline(always)]
    fn compare(&mut self, other: &Other<'_>, y: f32, agreement: f32, totals: &mut Totals<'_>) {
        self.project(other, y);
        for (found, &index) in self.found.iter_mut().zip(&self.index) {
            *found = other.rho[index as usize];
        }
        self.return_to(other, y, agreement, totals);
    }

    #[inline(always)]
    fn project(&mut self, other: &Other<'_>, y: f32) {
        let (a, b) = (&other.forward.a, &other.forward.b);
        let base = [0, 1, 2].map(|r| a[r][1] * y + a[r][2]);
        let (last_u, last_v) = ((other.width - 1) as f32, (other.height - 1) as f32);
        let width = other.width as u32;
        let n = self.own.len();
        let (own, index, expected) = (&self.own[..n], &mut self.index[..n], &mut self.expected[..n]);
        let [ui, vi] = &mut self.position;
        let [du, dv] = &mut self.offset;
        let (ui, vi, du, dv) = (&mut ui[..n], &mut vi[..n], &mut du[..n], &mut dv[..n]);
        for x in 0..n {
            let (fx, rho) = (x as i32 as f32, own[x]);
            let ratio = base[2] + a[2][0] * fx + rho * b[2];
            let inverse = 1.0 / ratio;
            let u = (base[0] + a[0][0] * fx + rho * b[0]) * inverse;
            let v = (base[1] + a[1][0] * fx + rho * b[1]) * inverse;
            let (column, row) = (nearest(u, last_u), nearest(v, last_v));
            (ui[x], vi[x]) = (column as i32 as f32, row as i32 as f32);
            (du[x], dv[x]) = (ui[x] - u, vi[x] - v);
            index[x] = row.wrapping_mul(width).wrapping_add(column);
            // Beyond the last pixel's outer edge the nearest pixel is more than half a pixel away.
            let inside =
                (du[x].abs() <= 0.5) & (dv[x].abs() <= 0.5) & (ratio > MIN_DEPTH_RATIO) & (rho > 0.0);
            expected[x] = if inside { rho * inverse } else { f32::NAN };
        }
    }

    #[inline(always)]
    fn return_to(&self, other: &Other<'_>, y: f32, agreement: f32, totals: &mut Totals<'_>) {
        let (a, b) = (&other.backward.a, &other.backward.b);
        let n = self.own.len();
        let (own, expected, found) = (&self.own[..n], &self.expected[..n], &self.found[..n]);
        let [ui, vi] = &self.position;
        let [du, dv] = &self.offset;
        let (ui, vi, du, dv) = (&ui[..n], &vi[..n], &du[..n], &dv[..n]);
        let (sum, agreeing) = (&mut totals.sum[..n], &mut totals.agreeing[..n]);
        let (compared, squares) = (&mut totals.compared[..n], &mut totals.squares[..n]);
        let nearer = 1.0 + 3.0 * agreement;
        for x in 0..n {
            let rho = found[x];
            let at = |r: usize| a[r][0] * ui[x] + a[r][1] * vi[x] + a[r][2] + rho * b[r];
            let ratio = at(2);
            let inverse = 1.0 / ratio;
            let again = rho * inverse;
            let difference = (again - own[x]) / own[x];
            let (ex, ey) = (at(0) * inverse - x as i32 as f32 - du[x], at(1) * inverse - y - dv[x]);
            // A NaN fails every comparison, so both views have a depth here.
            let has_depth = (rho > 0.0) & (expected[x] > 0.0);
            // A nearer surface in the neighbour: an occlusion or an error, so it counts as compared.
            let agrees = has_depth
                & (rho <= expected[x] * nearer)
                & (ratio > MIN_DEPTH_RATIO)
                & (difference.abs() <= agreement)
                & (ex * ex + ey * ey <= REPROJECTION_LIMIT_PX * REPROJECTION_LIMIT_PX);
            compared[x] += if has_depth { 1.0 } else { 0.0 };
            agreeing[x] += if agrees { 1.0 } else { 0.0 };
            sum[x] += if agrees { again } else { 0.0 };
            squares[x] += if agrees { difference * difference } else { 0.0 };
        }
    }
}

/// The pixel nearest to a position, within 0…`last`; 0 for NaN.
#[inline(always)]
fn nearest(position: f32, last: f32) -> u32 {
    let position = if position > 0.0 { position } else { 0.0 };
    let position = if position < last { position } else { last };
    // Adding 2²³ leaves the rounded value in the mantissa.
    (position + 8_388_608.0).to_bits().wrapping_sub(0x4b00_0000)
}
