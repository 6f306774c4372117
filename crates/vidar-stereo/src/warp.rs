//! Projection of a reference pixel into a neighbour, as a function of its inverse depth.
//!
//! With `p = (x, y, 1)` and inverse depth `ρ = 1/z`, the point `z K_r⁻¹ p` projects to
//! `p_n ~ K_n (R K_r⁻¹ p + ρ t) = A p + ρ b`, where `R, t` are `neighbour_from_reference`.
//! For fixed ρ this is the plane-induced homography of Collins 1996; on a plane in space ρ is affine in (x, y),
//! so slanted planes are homographies as well.

use crate::prepare::Level;
use crate::window::{HIDDEN, RADIUS};
use nalgebra::{Matrix3, Vector3};
use vidar_core::{LieGroup, Pinhole, Se3};

/// `p_n ~ A p + ρ b`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Warp {
    pub a: [[f32; 3]; 3],
    pub b: [f32; 3],
}

impl Warp {
    /// From the two cameras and their relative motion.
    pub fn new(reference: &Pinhole, neighbour: &Pinhole, neighbour_from_reference: &Se3) -> Self {
        let k_inverse = Matrix3::new(
            1.0 / reference.fx,
            0.0,
            -reference.cx / reference.fx,
            0.0,
            1.0 / reference.fy,
            -reference.cy / reference.fy,
            0.0,
            0.0,
            1.0,
        );
        let k = neighbour.matrix();
        let a: Matrix3<f64> = k * neighbour_from_reference.rotation.matrix() * k_inverse;
        let b: Vector3<f64> = k * neighbour_from_reference.translation;
        let row = |i: usize| [a[(i, 0)] as f32, a[(i, 1)] as f32, a[(i, 2)] as f32];
        Self { a: [row(0), row(1), row(2)], b: [b[0] as f32, b[1] as f32, b[2] as f32] }
    }

    /// Homogeneous position in the neighbour of reference pixel `(x, y)` at inverse depth `rho`.
    /// The third entry is `z_n · ρ`: depth in the neighbour over depth in the reference.
    #[inline(always)]
    pub fn apply(&self, x: f32, y: f32, rho: f32) -> [f32; 3] {
        let row = |i: usize| self.a[i][0] * x + self.a[i][1] * y + self.a[i][2] + rho * self.b[i];
        [row(0), row(1), row(2)]
    }

    /// Pixel of the neighbour, and its depth there over the reference's; `None` behind the camera.
    #[inline(always)]
    pub fn project(&self, x: f32, y: f32, rho: f32) -> Option<(f32, f32, f32)> {
        let [u, v, w] = self.apply(x, y, rho);
        if w > MIN_DEPTH_RATIO {
            let iw = 1.0 / w;
            Some((u * iw, v * iw, w))
        } else {
            None
        }
    }
}

/// Points nearer to the neighbour than this share of their depth in the reference are not matched.
pub(crate) const MIN_DEPTH_RATIO: f32 = 0.1;

/// `neighbour_from_reference` from two poses.
pub(crate) fn neighbour_from_reference(neighbour: &Se3, reference: &Se3) -> Se3 {
    neighbour.inverse() * *reference
}

/// Positions are rounded to this part of a pixel.
const POSITION_STEPS: f32 = 64.0;

/// Bilinear samples of a neighbour along one row of the reference.
///
/// Three passes: positions and weights, fetches of the four pixels around each, and their blend. The first and the last
/// are plain arithmetic over the row, which vectorises; only the fetches are done one by one.
pub(crate) struct RowSamples {
    /// Index of the upper left of the four pixels.
    index: Vec<u32>,
    /// Its weights in 64ths: across in the lower half, down in the upper.
    weights: Vec<u32>,
    /// The upper two pixels, and the lower two: the left one in the lower half.
    upper: Vec<u32>,
    lower: Vec<u32>,
}

impl RowSamples {
    pub fn new(width: usize) -> Self {
        let blank = || vec![0; width];
        Self { index: blank(), weights: blank(), upper: blank(), lower: blank() }
    }

    /// Where row `y` at the inverse depths `rho + shift` lies in `level`. `hidden` becomes 0 where a window around the
    /// position is inside the image and [`HIDDEN`](crate::window::HIDDEN) elsewhere, also where `rho` is NaN.
    #[inline(always)]
    pub fn locate(
        &mut self,
        warp: &Warp,
        level: &Level,
        y: usize,
        rho: &[f32],
        shift: f32,
        hidden: &mut [f32],
    ) {
        let (a, b) = (&warp.a, &warp.b);
        let y = y as f32;
        let base = [0, 1, 2].map(|r| a[r][1] * y + a[r][2] + shift * b[r]);
        let margin = RADIUS as f32;
        let (last_u, last_v) = ((level.width - 1) as f32, (level.height - 1) as f32);
        // The greatest position whose four pixels are all inside.
        let (most_u, most_v) = (last_u - 1.0 / POSITION_STEPS, last_v - 1.0 / POSITION_STEPS);
        let (inner_u, inner_v) = (last_u - margin, last_v - margin);
        let width = level.width as u32;
        let n = rho.len();
        let (index, weights, hidden) = (&mut self.index[..n], &mut self.weights[..n], &mut hidden[..n]);
        for x in 0..n {
            // By way of i32, which vectorises.
            let fx = x as i32 as f32;
            let depth_ratio = base[2] + a[2][0] * fx + rho[x] * b[2];
            let inverse = 1.0 / depth_ratio;
            let u = (base[0] + a[0][0] * fx + rho[x] * b[0]) * inverse;
            let v = (base[1] + a[1][0] * fx + rho[x] * b[1]) * inverse;
            let inside = (u >= margin)
                & (v >= margin)
                & (u <= inner_u)
                & (v <= inner_v)
                & (depth_ratio > MIN_DEPTH_RATIO);
            hidden[x] = if inside { 0.0 } else { HIDDEN };
            let (u, v) = (in_steps(u, most_u), in_steps(v, most_v));
            index[x] = (v >> 6).wrapping_mul(width).wrapping_add(u >> 6);
            weights[x] = (u & 63) | (v & 63) << 16;
        }
    }

    /// Hides the positions that a mask of the level covers.
    #[inline(always)]
    pub fn hide_masked(&self, level: &Level, hidden: &mut [f32]) {
        if level.hidden.is_empty() {
            return;
        }
        for (h, &i) in hidden.iter_mut().zip(&self.index) {
            if level.hidden[i as usize] {
                *h = HIDDEN;
            }
        }
    }

    /// Reads the four pixels around each position.
    #[inline(always)]
    pub fn fetch(&mut self, level: &Level) {
        // Two slices, each with one comparison a fetch: half the instructions of one that spans both rows.
        let (top, bottom) = (level.gray.as_slice(), &level.gray[level.width..]);
        let fetched = self.upper.iter_mut().zip(&mut self.lower);
        for ((upper, lower), &i) in fetched.zip(&self.index) {
            let i = i as usize;
            *upper = pair(&top[i..i + 2]);
            *lower = pair(&bottom[i..i + 2]);
        }
    }

    /// The samples, rounded to [matched units](crate::window::UNITS).
    #[inline(always)]
    pub fn blend(&self, out: &mut [f32]) {
        let n = out.len();
        let (weights, upper, lower) = (&self.weights[..n], &self.upper[..n], &self.lower[..n]);
        for x in 0..n {
            let (across, down) = ((weights[x] & 0xffff) as i32, (weights[x] >> 16) as i32);
            let mixed = |pair: u32| {
                let (left, right) = ((pair << 16) as i32 >> 16, pair as i32 >> 16);
                left * 64 + (right - left) * across
            };
            let (top, bottom) = (mixed(upper[x]), mixed(lower[x]));
            // 64 · 64 weights, and four image units in a matched one.
            out[x] = ((top * 64 + (bottom - top) * down + (1 << 13)) >> 14) as f32;
        }
    }
}

/// Two pixels, the left one in the lower half.
#[inline(always)]
fn pair(pixels: &[i16]) -> u32 {
    u32::from(pixels[0] as u16) | u32::from(pixels[1] as u16) << 16
}

/// A position from 0 to `most` in 64ths of a pixel; 0 for NaN.
#[inline(always)]
fn in_steps(position: f32, most: f32) -> u32 {
    let position = if position > 0.0 { position } else { 0.0 };
    let position = if position < most { position } else { most };
    // Adding 2²³ leaves the rounded value in the mantissa.
    (position * POSITION_STEPS + 8_388_608.0).to_bits().wrapping_sub(0x4b00_0000)
}

#[cfg(test)]
mod tests {
    use super::*;
    use vidar_core::So3;

    #[test]
    fn the_warp_agrees_with_projecting_the_point() {
        let reference = Pinhole::new(290.0, 300.0, 158.0, 121.0, 320, 240).expect("valid");
        let neighbour = Pinhole::new(280.0, 275.0, 150.0, 118.0, 320, 240).expect("valid");
        let world_from_reference =
            Se3::new(So3::exp(&Vector3::new(0.3, -0.2, 0.9)), Vector3::new(1.0, 2.0, -0.5));
        let world_from_neighbour =
            Se3::new(So3::exp(&Vector3::new(0.35, -0.25, 0.8)), Vector3::new(1.2, 2.1, -0.4));
        let motion = neighbour_from_reference(&world_from_neighbour, &world_from_reference);
        let warp = Warp::new(&reference, &neighbour, &motion);
        let mut checked = 0;
        for (x, y, z) in [(10.0, 20.0, 1.5), (160.0, 120.0, 0.7), (300.0, 200.0, 4.0), (80.0, 230.0, 12.0)] {
            let point_in_world = world_from_reference * (reference.ray(x, y) * z);
            let point_in_neighbour = world_from_neighbour.inverse() * point_in_world;
            let Some(expected) = neighbour.project(&point_in_neighbour) else { continue };
            let (u, v, ratio) = warp.project(x as f32, y as f32, (1.0 / z) as f32).expect("in front");
            assert!((f64::from(u) - expected.x).abs() < 2e-3, "{u} {}", expected.x);
            assert!((f64::from(v) - expected.y).abs() < 2e-3, "{v} {}", expected.y);
            assert!((f64::from(ratio) - point_in_neighbour.z / z).abs() < 1e-5);
            checked += 1;
        }
        assert!(checked >= 3);
    }

    #[test]
    fn sampling_is_bilinear_inside_and_hidden_outside() {
        let (width, height) = (16, 12);
        // Grey levels x + 10 y, in image units.
        let gray = (0..width * height).map(|i| ((i % width + 10 * (i / width)) * 16) as i16 - 2048).collect();
        let intrinsics = Pinhole::new(10.0, 10.0, 7.5, 5.5, width, height).expect("valid");
        let level = Level { width, height, gray, intrinsics, hidden: Vec::new() };
        // Moves by (1.25, 0.5) per unit of inverse depth.
        let a = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let warp = Warp { a, b: [1.25, 0.5, 0.0] };
        let mut samples = RowSamples::new(width);
        let (mut hidden, mut out) = (vec![0.0; width], vec![0.0; width]);
        let mut rho = vec![1.0; width];
        rho[5] = f32::NAN;
        samples.locate(&warp, &level, 3, &rho, 0.0, &mut hidden);
        samples.fetch(&level);
        samples.blend(&mut out);
        for x in 0..width {
            let u = x as f32 + 1.25;
            let seen = (2.0..=13.0).contains(&u) && x != 5;
            assert_eq!(hidden[x] == 0.0, seen, "{x}");
            if seen {
                let expected = 4.0 * (u + 35.0 - 128.0);
                assert!((out[x] - expected).abs() <= 0.5, "{x}: {} {expected}", out[x]);
            }
        }
    }
}
