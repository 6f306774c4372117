//! The gradient tensor of a patch: how well it can be aligned, and along which direction.
//!
//! The mean gradient is taken out first: alignment frees the offset of the exposure, and a ramp shifted is a ramp offset.

use super::super::feature::eigen;
use nalgebra::{Matrix2, Vector2};
use vidar_core::Image;
use vidar_core::simd::kernel;

/// Half of the window's side; 8 × 8 pixels, as alignment uses.
const HALF: usize = 4;

/// Texture around a pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Structure {
    /// Root of the larger eigenvalue of the mean gradient tensor, grey levels per pixel.
    pub strong: f64,
    /// Root of the smaller eigenvalue (Shi & Tomasi 1994).
    pub weak: f64,
    /// Unit direction of the larger one.
    pub direction: Vector2<f64>,
}

impl Structure {
    /// Of the window with upper left corner `(x − 4, y − 4)`; the caller keeps 5 pixels from the border.
    pub fn around(image: &Image<u8>, x: usize, y: usize) -> Self {
        let [sx, sy, xx, xy, yy] = tensor(image, x, y).map(f64::from);
        let n = (2 * HALF * 2 * HALF) as f64;
        // Differences are not halved in the sums: (2·g)² over the pixels.
        let (xx, xy, yy) = (xx - sx * sx / n, xy - sx * sy / n, yy - sy * sy / n);
        let mean = Matrix2::new(xx, xy, xy, yy) / (4.0 * n);
        let [strong, weak, angle] = eigen(&mean);
        Self {
            strong: strong.max(0.0).sqrt(),
            weak: weak.max(0.0).sqrt(),
            direction: Vector2::new(angle.cos(), angle.sin()),
        }
    }
}

kernel! {
    fn tensor(image: &Image<u8>, x: usize, y: usize) -> [i32; 5] {
        sum_gradients(image, x, y)
    }
}

#[inline(always)]
fn sum_gradients(image: &Image<u8>, x: usize, y: usize) -> [i32; 5] {
    let (width, data) = (image.width(), image.data());
    let (mut sx, mut sy) = ([0_i32; 8], [0_i32; 8]);
    let (mut xx, mut xy, mut yy) = ([0_i32; 8], [0_i32; 8], [0_i32; 8]);
    for row in y - HALF..y + HALF {
        let start = row * width + x - HALF;
        let here = &data[start - 1..][..10];
        let (above, below) = (&data[start - width..][..8], &data[start + width..][..8]);
        for i in 0..8 {
            let gx = i32::from(here[i + 2]) - i32::from(here[i]);
            let gy = i32::from(below[i]) - i32::from(above[i]);
            sx[i] += gx;
            sy[i] += gy;
            xx[i] += gx * gx;
            xy[i] += gx * gy;
            yy[i] += gy * gy;
        }
    }
    [sx.iter().sum(), sy.iter().sum(), xx.iter().sum(), xy.iter().sum(), yy.iter().sum()]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_edge_is_strong_one_way_and_weak_the_other() {
        let image = Image::from_fn(20, 20, |x, y| {
            let across = (2.0 * x as f64 + y as f64 - 30.0) / 5.0_f64.sqrt();
            (90.0 + 50.0 * (across / 1.5).tanh()) as u8
        });
        let s = Structure::around(&image, 10, 10);
        assert!(s.strong > 8.0 && s.weak < 0.2 * s.strong, "{s:?}");
        let expected = Vector2::new(2.0, 1.0).normalize();
        assert!(s.direction.dot(&expected).abs() > 0.99, "{s:?}");
    }

    #[test]
    fn a_ramp_has_nothing_to_hold_on_to() {
        let image = Image::from_fn(20, 20, |x, y| (6 * x + 3 * y) as u8);
        let s = Structure::around(&image, 10, 10);
        assert!(s.strong < 1e-6 && s.weak < 1e-6, "{s:?}");
    }

    #[test]
    fn a_checkerboard_corner_is_strong_both_ways() {
        let image = Image::from_fn(20, 20, |x, y| if (x < 10) == (y < 10) { 200_u8 } else { 50 });
        let s = Structure::around(&image, 10, 10);
        assert!(s.weak > 20.0 && s.weak > 0.8 * s.strong, "{s:?}");
    }
}
