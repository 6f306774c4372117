//! Projection of a reference pixel into a neighbour, as a function of its inverse depth.
//!
//! With `p = (x, y, 1)` and inverse depth `ρ = 1/z`, the point `z K_r⁻¹ p` projects to
//! `p_n ~ K_n (R K_r⁻¹ p + ρ t) = A p + ρ b`, where `R, t` are `neighbour_from_reference`.
//! For fixed ρ this is the plane-induced homography of Collins 1996; on a plane in space ρ is affine in (x, y),
//! so slanted planes are homographies as well.

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

/// Bilinear sample of a row-major image; NaN outside the centres of its border pixels.
#[inline(always)]
pub(crate) fn sample(gray: &[f32], width: usize, height: usize, u: f32, v: f32) -> f32 {
    // A NaN position fails the comparisons and so counts as outside.
    if !(u >= 0.0 && v >= 0.0 && u < (width - 1) as f32 && v < (height - 1) as f32) {
        return f32::NAN;
    }
    let (x, y) = (u as i32 as usize, v as i32 as usize);
    let (ax, ay) = (u - x as f32, v - y as f32);
    let p = &gray[y * width + x..][..width + 2];
    let top = p[0] + ax * (p[1] - p[0]);
    let bottom = p[width] + ax * (p[width + 1] - p[width]);
    top + ay * (bottom - top)
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
    fn sampling_is_bilinear_inside_and_nan_outside() {
        let gray: Vec<f32> = (0..12).map(|i| (i % 4) as f32 + 10.0 * (i / 4) as f32).collect();
        assert!((sample(&gray, 4, 3, 1.25, 0.5) - 6.25).abs() < 1e-6);
        for (u, v) in [(-0.01, 1.0), (1.0, -0.01), (3.0, 1.0), (1.0, 2.0), (f32::NAN, 1.0)] {
            assert!(sample(&gray, 4, 3, u, v).is_nan(), "{u} {v}");
        }
    }
}
