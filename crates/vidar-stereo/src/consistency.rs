//! Geometric consistency of the views' depths (Schönberger 2016, section 4.3).
//!
//! A pixel is projected into a neighbour with its depth, and the neighbour's depth there is projected back. The two agree
//! if this forward-backward reprojection error is small and the depths are similar. The inverse depths of agreeing
//! views are averaged, which reduces noise.
//!
//! Between four pixels of one surface the neighbour's inverse depth is interpolated, which is exact on a plane (`warp`);
//! across an edge the nearest of the four counts, at its own position.

use crate::chunk::ViewDepth;
use crate::config::StereoConfig;
use crate::warp::{MIN_DEPTH_RATIO, Warp, neighbour_from_reference};
use rayon::prelude::*;
use vidar_core::simd::kernel;

/// Largest forward-backward reprojection error, working pixels.
const REPROJECTION_LIMIT_PX: f32 = 1.5;
/// Adjacent inverse depths that differ by less than this ratio are of one surface. At 0.1 the same pixels agree, to a
/// thousandth (HoloLens keyframes 0 to 15).
const SAME_SURFACE_RATIO: f32 = 0.05;
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
                compare(&mut row, other, y, config.agreement_ratio as f32, &mut totals);
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
    /// Index of the upper left of the four pixels around the projection, its position, and that of the projection from there.
    index: Vec<u32>,
    corner: [Vec<f32>; 2],
    offset: [Vec<f32>; 2],
    /// The inverse depth that the point would have there; NaN outside the view.
    expected: Vec<f32>,
    /// The inverse depths that the view has at the four: left and right above, left and right below.
    found: [Vec<f32>; 4],
}

kernel! {
    fn compare(row: &mut Row, other: &Other<'_>, y: f32, agreement: f32, totals: &mut Totals<'_>) {
        row.compare(other, y, agreement, totals);
    }
}

impl Row {
    fn new(width: usize) -> Self {
        let blank = || vec![0.0; width];
        Self {
            own: blank(),
            index: vec![0; width],
            corner: [blank(), blank()],
            offset: [blank(), blank()],
            expected: blank(),
            found: std::array::from_fn(|_| blank()),
        }
    }

    #[inline(always)]
    fn compare(&mut self, other: &Other<'_>, y: f32, agreement: f32, totals: &mut Totals<'_>) {
        self.project(other, y);
        let n = self.own.len();
        let [a, b, c, d] = &mut self.found;
        let (a, b, c, d) = (&mut a[..n], &mut b[..n], &mut c[..n], &mut d[..n]);
        for (x, &index) in self.index[..n].iter().enumerate() {
            let around = &other.rho[index as usize..][..other.width + 2];
            (a[x], b[x]) = (around[0], around[1]);
            (c[x], d[x]) = (around[other.width], around[other.width + 1]);
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
        let [uc, vc] = &mut self.corner;
        let [du, dv] = &mut self.offset;
        let (uc, vc, du, dv) = (&mut uc[..n], &mut vc[..n], &mut du[..n], &mut dv[..n]);
        for x in 0..n {
            let (fx, rho) = (x as i32 as f32, own[x]);
            let ratio = base[2] + a[2][0] * fx + rho * b[2];
            let inverse = 1.0 / ratio;
            let u = (base[0] + a[0][0] * fx + rho * b[0]) * inverse;
            let v = (base[1] + a[1][0] * fx + rho * b[1]) * inverse;
            let (column, row) = (nearest(u - 0.5, last_u - 1.0), nearest(v - 0.5, last_v - 1.0));
            (uc[x], vc[x]) = (column as i32 as f32, row as i32 as f32);
            (du[x], dv[x]) = (u - uc[x], v - vc[x]);
            index[x] = row.wrapping_mul(width).wrapping_add(column);
            // Up to the outer edge of the first and the last pixel.
            let inside = (u >= -0.5)
                & (v >= -0.5)
                & (u <= last_u + 0.5)
                & (v <= last_v + 0.5)
                & (ratio > MIN_DEPTH_RATIO)
                & (rho > 0.0);
            expected[x] = if inside { rho * inverse } else { f32::NAN };
        }
    }

    #[inline(always)]
    fn return_to(&self, other: &Other<'_>, y: f32, agreement: f32, totals: &mut Totals<'_>) {
        let (a, b) = (&other.backward.a, &other.backward.b);
        let n = self.own.len();
        let (own, expected) = (&self.own[..n], &self.expected[..n]);
        let [uc, vc] = &self.corner;
        let [du, dv] = &self.offset;
        let (uc, vc, du, dv) = (&uc[..n], &vc[..n], &du[..n], &dv[..n]);
        let [upper_left, upper_right, lower_left, lower_right] = &self.found;
        let (upper_left, upper_right) = (&upper_left[..n], &upper_right[..n]);
        let (lower_left, lower_right) = (&lower_left[..n], &lower_right[..n]);
        let (sum, agreeing) = (&mut totals.sum[..n], &mut totals.agreeing[..n]);
        let (compared, squares) = (&mut totals.compared[..n], &mut totals.squares[..n]);
        let nearer = 1.0 + 3.0 * agreement;
        for x in 0..n {
            let four = [upper_left[x], upper_right[x], lower_left[x], lower_right[x]];
            let (rho, across, down) = inverse_depth_at(four, du[x], dv[x]);
            let (ui, vi) = (uc[x] + across, vc[x] + down);
            let at = |r: usize| a[r][0] * ui + a[r][1] * vi + a[r][2] + rho * b[r];
            let ratio = at(2);
            let inverse = 1.0 / ratio;
            let again = rho * inverse;
            let difference = (again - own[x]) / own[x];
            let (ex, ey) =
                (at(0) * inverse - x as i32 as f32 - (across - du[x]), at(1) * inverse - y - (down - dv[x]));
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

/// The inverse depth at an offset from the first of `four` pixels, and where it holds: interpolated on one surface, otherwise
/// that of the nearest pixel.
#[inline(always)]
fn inverse_depth_at(four: [f32; 4], across: f32, down: f32) -> (f32, f32, f32) {
    let [a, b, c, d] = four;
    let less = |p: f32, q: f32| if p < q { p } else { q };
    let more = |p: f32, q: f32| if p > q { p } else { q };
    let (least, most) = (less(less(a, b), less(c, d)), more(more(a, b), more(c, d)));
    // A NaN fails every comparison.
    let all = (a > 0.0) & (b > 0.0) & (c > 0.0) & (d > 0.0);
    let one_surface = all & (most - least < SAME_SURFACE_RATIO * most);
    let (top, bottom) = (a + (b - a) * across, c + (d - c) * across);
    let interpolated = top + (bottom - top) * down;
    let (right, below) = (across >= 0.5, down >= 0.5);
    let (upper, lower) = (if right { b } else { a }, if right { d } else { c });
    let nearest = if below { lower } else { upper };
    let at = |half: bool| if half { 1.0 } else { 0.0 };
    if one_surface { (interpolated, across, down) } else { (nearest, at(right), at(below)) }
}

/// The pixel nearest to a position, within 0…`last`; 0 for NaN.
#[inline(always)]
fn nearest(position: f32, last: f32) -> u32 {
    let position = if position > 0.0 { position } else { 0.0 };
    let position = if position < last { position } else { last };
    // Adding 2²³ leaves the rounded value in the mantissa.
    (position + 8_388_608.0).to_bits().wrapping_sub(0x4b00_0000)
}
