//! Sampling grey levels between pixels.

use vidar_core::Image;

/// The four weights of bilinear interpolation and the corner they belong to.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Bilinear {
    /// Column of the upper left pixel.
    pub x: usize,
    /// Row of the upper left pixel.
    pub y: usize,
    /// Weights of upper left, upper right, lower left, lower right.
    pub weights: [f32; 4],
}

impl Bilinear {
    /// Weights for `(x, y)`; `None` unless all samples of an `extent` × `extent` patch from there lie in the image.
    #[inline(always)]
    pub fn for_patch(image: &Image<u8>, x: f64, y: f64, extent: usize) -> Option<Self> {
        // Written so that NaN fails. The last interpolated pixel needs a right and a lower neighbour.
        let (limit_x, limit_y) =
            (image.width() as f64 - extent as f64, image.height() as f64 - extent as f64);
        if !(x >= 0.0 && y >= 0.0 && x < limit_x && y < limit_y) {
            return None;
        }
        let (left, top) = (x as usize, y as usize);
        let (fx, fy) = ((x - left as f64) as f32, (y - top as f64) as f32);
        let weights = [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy];
        Some(Self { x: left, y: top, weights })
    }

    /// Interpolates `N` neighbouring places of row `row` of the patch.
    #[inline(always)]
    pub fn row<const N: usize>(&self, image: &Image<u8>, row: usize) -> [f32; N] {
        let start = (self.y + row) * image.width() + self.x;
        let (top, bottom) =
            (&image.data()[start..][..N + 1], &image.data()[start + image.width()..][..N + 1]);
        let [a, b, c, d] = self.weights;
        let mut out = [0.0; N];
        for (i, o) in out.iter_mut().enumerate() {
            let upper = a * f32::from(top[i]) + b * f32::from(top[i + 1]);
            let lower = c * f32::from(bottom[i]) + d * f32::from(bottom[i + 1]);
            *o = upper + lower;
        }
        out
    }
}

/// Grey levels at `N` places; the caller has checked that each and its right and lower neighbours are inside.
///
/// In three loops: places and weights become vectors, only the pixels are fetched one by one.
#[inline(always)]
pub(crate) fn sample<const N: usize>(image: &Image<u8>, x: &[f32; N], y: &[f32; N]) -> [f32; N] {
    let (mut left, mut top) = ([0_i32; N], [0_i32; N]);
    for k in 0..N {
        (left[k], top[k]) = (x[k] as i32, y[k] as i32);
    }
    let (width, data) = (image.width(), image.data());
    let mut corners = [[0_u8; N]; 4];
    for k in 0..N {
        let start = top[k] as usize * width + left[k] as usize;
        let (upper, lower) = (&data[start..start + 2], &data[start + width..start + width + 2]);
        (corners[0][k], corners[1][k], corners[2][k], corners[3][k]) =
            (upper[0], upper[1], lower[0], lower[1]);
    }
    let mut out = [0.0; N];
    for k in 0..N {
        let (fx, fy) = (x[k] - left[k] as f32, y[k] - top[k] as f32);
        let gray = |corner: usize| f32::from(corners[corner][k]);
        let a = gray(0) + fx * (gray(1) - gray(0));
        let b = gray(2) + fx * (gray(3) - gray(2));
        out[k] = a + fy * (b - a);
    }
    out
}

/// Sum of eight lanes in an order that no compiler changes.
#[inline(always)]
pub(crate) fn sum8(v: &[f32; 8]) -> f32 {
    ((v[0] + v[4]) + (v[2] + v[6])) + ((v[1] + v[5]) + (v[3] + v[7]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_tilted_plane_is_interpolated_exactly() {
        let image = Image::from_fn(20, 15, |x, y| (3 * x + 5 * y) as u8);
        let at = Bilinear::for_patch(&image, 4.25, 6.5, 8).unwrap();
        for row in 0..8 {
            let values: [f32; 8] = at.row(&image, row);
            for (column, v) in values.iter().enumerate() {
                let expected = 3.0 * (4.25 + column as f32) + 5.0 * (6.5 + row as f32);
                assert!((v - expected).abs() < 1e-4);
            }
        }
        assert!((sample(&image, &[4.25], &[6.5])[0] - 45.25).abs() < 1e-4);
    }

    #[test]
    fn patches_that_leave_the_image_are_refused() {
        let image = Image::filled(20, 15, 7_u8);
        assert!(Bilinear::for_patch(&image, 11.999, 6.999, 8).is_some());
        for (x, y) in [(12.0, 0.0), (0.0, 7.0), (-0.001, 1.0), (f64::NAN, 1.0), (1.0, f64::INFINITY)] {
            assert!(Bilinear::for_patch(&image, x, y, 8).is_none(), "{x} {y}");
        }
    }
}
